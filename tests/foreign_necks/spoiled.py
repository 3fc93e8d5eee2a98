"""What a filter has to bear: motions that a poor sensor saw, beside the true angles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix
from softneck.estimation import KalmanObserver, NonlinearObserver
from softneck.plant import settle
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, signal

NOISE = math.radians(0.25)
LOST, OUTLIERS, OUTLIER_STD = 0.2, 0.02, math.radians(20.0)
# One blackout a motion, [s].
BLACKOUT = 1.0
# A second for a filter to find its feet; a blackout begins later than this.
SCORED, EARLIEST = 50, 200


@dataclass(frozen=True, slots=True, eq=False)
class Spoiled:
    """A motion as a poor sensor saw it.

    Attributes:
        recording: `pitch_measured`, `roll_measured` with NaN where nothing came, beside the true `pitch`, `roll`.
        dark: (time,) rows of the blackout.
    """

    recording: Recording
    dark: np.ndarray


def motions() -> list[Excitation]:
    """Return what the neck does: the paper's tests, and all that it misses."""
    return [signal("steps"), signal("sine"), signal("rotation"), signal("mixed", duration=40.0)]


def moved(block: Block, excitation: Excitation, seed: int, noise: float = NOISE) -> Recording:
    """Return a run of a neck without noise of its own, with white noise of 0.25 deg on what is measured."""
    P = np.asarray(excitation.set_points, dtype=np.float64)
    state = settle(block, P[0])
    U = np.zeros((len(P) - 1, len(block.inputs)))
    U[:, :3] = P[:-1]
    Y = np.vstack([state.outputs, block.run(state, U)[1]])
    rows = dict(zip([port.name for port in block.outputs], Y.T, strict=True))
    rng = np.random.default_rng([seed, 0])
    kept = {f"motor_setpoint_{j + 1}": P[:, j] for j in range(3)}
    kept |= {f"motor_position_{j}": rows[f"motor_position_{j}"].copy() for j in (1, 2, 3)}
    for axis in ("pitch", "roll"):
        kept[axis] = rows[axis].copy()
        kept[f"{axis}_measured"] = rows[f"{axis}_measured"] + noise * rng.standard_normal(len(P))
    return Recording(excitation.time, excitation.sample_time, kept)


def logged(run: Recording) -> Recording:
    """Return the same as a log has it, to identify a model with: what was measured is pitch and roll."""
    names = [name for name in run.channels if name.startswith("motor")]
    channels = {name: run.channels[name] for name in names}
    channels |= {axis: run.channels[f"{axis}_measured"] for axis in ("pitch", "roll")}
    return Recording(run.time, run.sample_time, channels)


def spoiled(block: Block, excitation: Excitation, seed: int) -> Spoiled:
    """Return a motion with lost samples, outliers and a blackout, the same for each filter."""
    run = moved(block, excitation, seed)
    rng = np.random.default_rng([seed, 1])
    z = np.column_stack([run.channels["pitch_measured"], run.channels["roll_measured"]])
    outlier = rng.random(len(z)) < OUTLIERS
    z[outlier] += OUTLIER_STD * rng.standard_normal((int(outlier.sum()), 2))
    rows = round(BLACKOUT / run.sample_time)
    start = int(rng.integers(EARLIEST, len(z) - rows))
    dark = (np.arange(len(z)) >= start) & (np.arange(len(z)) < start + rows)
    z[dark | (rng.random(len(z)) < LOST)] = np.nan
    measured = {"pitch_measured": z[:, 0], "roll_measured": z[:, 1]}
    return Spoiled(Recording(run.time, run.sample_time, {**run.channels, **measured}), dark)


def filtered(observer: KalmanObserver | NonlinearObserver, run: Recording) -> Matrix:
    """Return what the filter's block makes of pitch and roll (time, 2), as in a loop [rad]."""
    block, P = observer.block(), run.set_points
    inputs = np.ones((len(P), 6))
    # The set-points of t_k are commanded after the measurement of t_k.
    inputs[:, :3] = P[np.maximum(np.arange(len(P)) - 1, 0)]
    inputs[:, 3:5] = np.column_stack([run.channels["pitch_measured"], run.channels["roll_measured"]])
    return block.run(block.initial_state(), inputs)[1][:, :2]


def errors_deg(runs: list[Spoiled], angles: list[Matrix]) -> tuple[float, float]:
    """Return the rms error against the true angles [deg]: over all, and in the blackouts."""
    errors = [told - run.recording.outputs for run, told in zip(runs, angles, strict=True)]
    dark = np.concatenate([error[run.dark] for run, error in zip(runs, errors, strict=True)])
    scored = np.concatenate([error[SCORED:] for error in errors])
    return math.degrees(np.sqrt(np.mean(scored**2))), math.degrees(np.sqrt(np.mean(dark**2)))
