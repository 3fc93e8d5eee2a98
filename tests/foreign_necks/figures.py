"""Five figures that say what a neck is like to identify: its best line, hysteresis, slack, bend and dead time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from softneck.core import Matrix, Vector
from softneck.signals import SAMPLE_TIME, Excitation, Recording, redefine, signal

# What a neck worth having shows (low, high).
RANGES = {
    "line_pct": (70.0, 90.0),
    "hysteresis_deg": (1.0, 3.0),
    "slack_pct": (20.0, 45.0),
    "bend_deg": (12.0, 18.0),
    "dead_time_s": (0.05, 0.12),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """What a neck does.

    Attributes:
        line_pct: fit in free run of the best one-pole line with dead time under Eq. 22, pitch and roll [%].
        hysteresis_deg: widest distance of pitch between the ways up and down, theta_i = 3 sin at a period of 60 s.
        slack_pct: time that a tendon is slack under Eq. 22, mean of the three [%].
        bend_deg: lean after 8 s of 3 rad on one tendon, mean of the three.
        dead_time_s: where the steepest tangent of a step of 0.3 rad on tendon 1 leaves the first value.
    """

    line_pct: tuple[float, float]
    hysteresis_deg: float
    slack_pct: float
    bend_deg: float
    dead_time_s: float


def figures(run: Callable[[Excitation], Recording]) -> Figures:
    """Return the figures of a neck; `run` records an excitation on it, without noise."""
    eq22 = run(signal("eq22", duration=100.0))
    tensions = np.column_stack([eq22.channels[f"tension_{j}"] for j in (1, 2, 3)])
    line = [best_line(u, y) for u, y in zip(redefine(eq22.set_points)[:, :2].T, eq22.outputs.T, strict=True)]
    return Figures(
        line_pct=(line[0], line[1]),
        hysteresis_deg=hysteresis(run),
        slack_pct=100.0 * float(np.mean(tensions <= 0.0)),
        bend_deg=float(np.mean([bend(run, motor) for motor in range(3)])),
        dead_time_s=dead_time(run),
    )


def best_line(u: Vector, y: Vector) -> float:
    """Return the best fit [%] of y = c + g exp(-d s) / (s + p) u in free run: all p and d of a grid, g and c by least
    squares."""
    best = -np.inf
    late = np.concatenate([np.full(10, u[0]), u])
    for pole in np.exp(-SAMPLE_TIME * np.geomspace(0.5, 30.0, 40)):
        response, _ = lfilter([0.0, 1.0 - pole], [1.0, -pole], late, zi=[late[0]])
        for delay in range(10):
            X = np.column_stack([response[10 - delay : response.size - delay], np.ones(y.size)])
            error = y - X @ np.linalg.lstsq(X, y)[0]
            best = max(best, 100.0 * (1.0 - np.linalg.norm(error) / np.linalg.norm(y - y.mean())))
    return float(best)


def hysteresis(run: Callable[[Excitation], Recording]) -> float:
    """Return the widest distance between the two branches of the second period [deg]."""
    t = np.arange(6_000) * SAMPLE_TIME
    theta = 3.0 * np.sin(2 * np.pi * t / 60.0)
    recording = run(Excitation("slow sine", t, theta[:, None] * np.array([2.0, -1.0, -1.0]) / 3.0))
    theta, pitch = theta[3_000:], np.degrees(recording.outputs[3_000:, 0])
    up, down = np.r_[2_250:3_000, 0:750], np.r_[2_249:750:-1]
    grid = np.linspace(-2.8, 2.8, 57)
    return float(np.max(np.abs(np.interp(grid, theta[up], pitch[up]) - np.interp(grid, theta[down], pitch[down]))))


def bend(run: Callable[[Excitation], Recording], motor: int) -> float:
    """Return the change of the lean after 8 s of 3 rad on one tendon [deg]."""
    y = np.degrees(run(_step(motor, 3.0, 450)).outputs)
    return float(np.hypot(*(y[-1] - y[0])))


def dead_time(run: Callable[[Excitation], Recording]) -> float:
    """Return the dead time of a small step, by the tangent of the process reaction curve [s]."""
    y = run(_step(0, 0.3, 150)).outputs[:, 0]
    at = int(np.argmax(np.diff(y)))
    middle = 0.5 * (y[at] + y[at + 1])
    return SAMPLE_TIME * float(at + 0.5 - 50 - (middle - y[50]) / (y[at + 1] - y[at]))


def _step(motor: int, height: float, rows: int) -> Excitation:
    P: Matrix = np.zeros((rows, 3))
    P[50:, motor] = height
    return Excitation("step", np.arange(rows) * SAMPLE_TIME, P)
