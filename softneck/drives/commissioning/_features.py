"""Features of one motor's moves: hinge of slack and tension, directions, friction, lag and noise.

Pure functions of what was measured, in the drive's own counts and current units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from softneck.core import Matrix, Vector

from ._moves import PERIOD, PULLED, REST, SWEEP, WIGGLE, MotorMoves, counts_per_turn

# Candidates for where a hinge bends; samples over which a way counts as up or down.
_BENDS, _OVER = 60, 20
# The upper part of the way by which sign and direction are told.
_TOP_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class Features:
    """Of one motor that pulled its tendon.

    Attributes:
        pull: 1 where the tendon is pulled while counts rise, else -1.
        slack: counts from where the winch stood until the tendon is taut.
        gain: tilt for one count under tension, in the wiggle, which no drift of the sensor reaches [rad].
        error: of that, relative.
        direction: of that tilt, (outputs,), of length 1.
        force: units of current for one count under tension, without friction.
        rise: by so many units it rose.
        friction: units of current that turning alone takes, to either side.
        lag: of the tilt behind the counts at the wiggle's frequency [s]; NaN where it cannot be told.
        noise: standard deviation of the sensor at rest, each output's mean square [rad].
        turn: counts of one turn of the motor; 0 without index.
        residual: of the tilt on the slow way up to a hinge with the current's knee [rad], rms.
    """

    pull: int
    slack: float
    gain: float
    error: float
    direction: Vector
    force: float
    rise: float
    friction: float
    lag: float
    noise: float
    turn: int
    residual: float


def features(moved: MotorMoves) -> Features | None:
    """Return the features of a motor's moves; None if it did not pull its tendon, or for too few rows."""
    if moved.outcome != PULLED or not moved.rows(WIGGLE).any():
        return None
    rows = moved.rows(SWEEP) & np.isfinite(moved.outputs).all(axis=1)
    counts, current, outputs = moved.counts[rows], moved.current[rows], moved.outputs[rows]
    pull = _pull(counts, current)
    x = pull * (counts - moved.counts[0])
    level = np.mean(outputs[x < np.quantile(x, 0.3)], axis=0)
    away = np.mean(outputs[x > np.max(x) - _TOP_SHARE * np.ptp(x)], axis=0) - level
    direction = away / max(float(np.linalg.norm(away)), 1e-12)
    tilt = (outputs - level) @ direction
    passed = np.zeros(x.size)
    passed[_OVER:] = x[_OVER:] - x[:-_OVER]
    # At full speed all the time: what gets a motor going and lets it stand is left out.
    up, down = passed > 0.8 * np.max(passed), passed < 0.8 * np.min(passed)
    if min(up.sum(), down.sum()) < _OVER:
        return None
    # One knee for both: the tilt is noisy, the current comes in coarse units.
    knee = hinge(x[up], tilt[up], pull * current[up])
    (turning, force), (returning, held) = (staircase(x[way], pull * current[way], knee) for way in (up, down))
    _, _, residual = line(x[up], tilt[up], knee)
    wiggle = moved.rows(WIGGLE)
    followed, error = answer(moved.time[wiggle], moved.counts[wiggle], moved.outputs[wiggle])
    along = pull * complex(direction @ followed)
    lag = float(-np.angle(along) % (2.0 * math.pi)) * PERIOD / (2.0 * math.pi)
    rest = moved.rows(REST) & np.isfinite(moved.outputs).all(axis=1)
    noise = float(np.sqrt(np.mean(np.var(moved.outputs[rest], axis=0)))) if rest.any() else math.nan
    return Features(
        pull=pull, slack=knee, gain=abs(along), error=error, direction=direction, force=0.5 * (force + held),
        rise=0.5 * (force + held) * float(np.max(x) - knee),
        friction=0.5 * (turning - returning), lag=lag, noise=noise,
        turn=counts_per_turn(moved.captures), residual=residual,
    )  # fmt: skip


def _pull(counts: Vector, current: Vector) -> int:
    """Return with which sign of its counts the motor pulls.

    Friction acts against either way, a tendon to one side only: over the way up and down it is what remains.
    """
    order = np.argsort(counts)
    edge = max(int(_TOP_SHARE * counts.size), 1)
    ends = current[order[-edge:]].mean() + current[order[:edge]].mean()
    return 1 if ends > 0.0 else -1


def hinge(x: Vector, *signals: Vector) -> float:
    """Return the knee of `y = level + slope max(0, x - knee)` for all signals: the most probable under white noise."""

    def cost(knee: float) -> float:
        return sum(x.size * math.log(line(x, y, knee)[2] + 1e-12) for y in signals)

    return float(min(np.linspace(np.min(x), np.max(x) - 0.1 * np.ptp(x), _BENDS), key=cost))


def line(x: Vector, y: Vector, knee: float) -> tuple[float, float, float]:
    """Return level, slope and rms residual of `y = level + slope max(0, x - knee)`."""
    A: Matrix = np.column_stack([np.ones(x.size), np.maximum(0.0, x - knee)])
    fit, _, _, _ = np.linalg.lstsq(A, y, rcond=None)
    return float(fit[0]), float(fit[1]), float(np.sqrt(np.mean((y - A @ fit) ** 2)))


def staircase(x: Vector, y: Vector, knee: float) -> tuple[float, float]:
    """Return level and slope of `y = round(level + slope max(0, x - knee))`: the middle of those that fit best.

    A motor's current over these moves is two to ten units of a drive for 10 to 20 A, and their steps say more of the
    slope than a straight line through them.
    """
    level, slope, _ = line(x, y, knee)
    levels, slopes = level + np.linspace(-0.75, 0.75, 31), slope * np.linspace(0.4, 1.6, 61)
    above = np.maximum(0.0, x - knee)
    steps = np.round(levels[:, None, None] + slopes[None, :, None] * above)
    cost = np.mean((y - steps) ** 2, axis=2)
    best = np.argwhere(cost <= np.min(cost) * 1.02 + 1e-9)
    return float(levels[best[:, 0]].mean()), float(slopes[best[:, 1]].mean())


class Answer(NamedTuple):
    """The outputs' answer to the wiggle for one count, (outputs,) complex, and its error, relative."""

    gain: Vector
    error: float


def answer(time: Vector, counts: Vector, outputs: Matrix) -> Answer:
    """Return how the outputs (rows, outputs) follow the counts in a wiggle, period by period at its own frequency.

    What the periods differ by is the error of their mean: that of slow noise as well. The first period, in which the
    way in dies out, is left out.
    """
    whole = [np.flatnonzero((time - time[0] >= k * PERIOD - 1e-6) & (time - time[0] < (k + 1) * PERIOD - 1e-6))
             for k in range(1, int((time[-1] - time[0] + 1e-6 + time[1] - time[0]) / PERIOD))]  # fmt: skip
    ratios = []
    for k in whole:
        turning = np.exp(-2j * math.pi * time[k] / PERIOD)
        here = np.nansum(turning * (counts[k] - counts[k].mean()))
        there = np.nansum(turning[:, None] * (outputs[k] - np.nanmean(outputs[k], axis=0)), axis=0)
        if abs(here) > 0.0 and np.isfinite(there).all():
            ratios.append(there / here)
    if len(ratios) < 3:
        return Answer(np.full(outputs.shape[1], math.nan + 0j), math.inf)
    mean, spread = np.mean(ratios, axis=0), np.std(ratios, axis=0, ddof=1) / math.sqrt(len(ratios))
    return Answer(mean, float(np.linalg.norm(spread)) / max(float(np.linalg.norm(mean)), 1e-30))
