"""Where the neck has been: ranges and coverage of (theta_i, phi_i, delta_i), and behaviours that never occurred."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix

from ..recording._channels import MOTORS
from ..recording._recording import Recording
from ..recording._redefinition import redefine
from ._channel_faults import true_stretches

# Cells of the map [rad]: at 5 deg of tilt per rad a cell is 5 deg wide; co-contraction in halves.
CELL, DELTA_CELL = 1.0, 0.5
# A tendon pulls from 1 rad on (past its slack), and is at rest below 0.5 rad; the same force means as near as that.
_PULLS, _RESTS = 1.0, 0.5
# Less than half a second of a behaviour teaches no model: the neck's time constant is 0.2 s.
_SEEN_SECONDS = 0.5
# Still: less than 0.02 rad/s, for a second at least.
_STILL_SPEED, _STILL_SECONDS = 0.02, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """What was visited, by measured motor positions (set-points where none were logged).

    Attributes:
        limit: motors reach from -limit to limit [rad]; coverage is of what follows from that.
        ranges: (3, 2) lowest and highest theta_i, phi_i, delta_i [rad].
        tilt_coverage: share of the reachable cells of 1 rad by 1 rad in theta_i, phi_i that were visited.
        delta_coverage: share of the cells of 0.5 rad along delta_i.
        behaviours: name -> seconds, of those that the paper names (sections 3.1 and 7.4.2).
    """

    limit: float
    ranges: Matrix
    tilt_coverage: float
    delta_coverage: float
    behaviours: dict[str, float]

    @property
    def never(self) -> tuple[str, ...]:
        """Return the behaviours that took less than half a second in all."""
        return tuple(name for name, seconds in self.behaviours.items() if seconds < _SEEN_SECONDS)

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON holds."""
        names = ("theta_i", "phi_i", "delta_i")
        return {
            "motor_limit_rad": self.limit,
            "ranges_rad": {name: self.ranges[i] for i, name in enumerate(names)},
            "tilt_coverage": self.tilt_coverage,
            "delta_coverage": self.delta_coverage,
            "behaviours_s": self.behaviours,
            "never_visited": self.never,
        }


def visited(recording: Recording, limit: float) -> Region:
    """Return the region that a recording visits; `limit` [rad] is how far a motor can go to either side."""
    P = positions(recording)
    if len(P) == 0:
        return Region(limit, np.full((3, 2), np.nan), 0.0, 0.0, _behaviours(P, np.zeros(0, int), 1.0))
    inputs = redefine(P)
    ranges = np.column_stack([inputs.min(axis=0), inputs.max(axis=0)])
    reachable = _cells(_all_tilts(limit), CELL)
    tilt = len(_cells(inputs[:, :2], CELL) & reachable) / len(reachable)
    lines = _cells(np.arange(-limit + DELTA_CELL / 2, limit, DELTA_CELL / 2)[:, None], DELTA_CELL)
    delta = len(_cells(inputs[:, 2:], DELTA_CELL) & lines) / len(lines)
    good = np.isfinite(recording.motor_positions).all(axis=1)
    return Region(limit, ranges, tilt, delta, _behaviours(P, recording.run[good], recording.sample_time))


def positions(recording: Recording) -> Matrix:
    """Return the motor positions (rows, 3) of the rows that have all three."""
    P = recording.motor_positions
    return P[np.isfinite(P).all(axis=1)]


def reachable_hexagon(limit: float) -> Matrix:
    """Return the corners (7, 2) of the theta_i, phi_i that motors between -limit and limit reach, closed."""
    corners = [(1, 1, -1), (-1, 1, -1), (-1, 1, 1), (-1, -1, 1), (1, -1, 1), (1, -1, -1), (1, 1, -1)]
    return redefine(limit * np.array(corners, dtype=np.float64))[:, :2]


def _all_tilts(limit: float) -> Matrix:
    """Return a grid of theta_i, phi_i inside the hexagon, four points to a cell's side."""
    axis = np.arange(-2.0 * limit, 2.0 * limit + CELL, CELL / 4.0) + CELL / 8.0
    theta, phi = (grid.ravel() for grid in np.meshgrid(axis, axis))
    # The projection of the cube of motors along delta_i: |phi_i| and its like at 60 deg are at most sqrt(3) limit.
    inside = np.ones(theta.size, dtype=bool)
    for angle in np.radians([30.0, 90.0, 150.0]):
        inside &= np.abs(theta * np.cos(angle) + phi * np.sin(angle)) <= np.sqrt(3.0) * limit
    return np.column_stack([theta, phi])[inside]


def _cells(points: Matrix, size: float) -> set[tuple[int, ...]]:
    return {tuple(cell) for cell in np.unique(np.floor(points / size).astype(int), axis=0).tolist()}


def _behaviours(P: Matrix, run: np.ndarray, sample_time: float) -> dict[str, float]:
    """Return for how long [s] each behaviour that the paper found missing took place."""
    rests, pulls = np.abs(P) < _RESTS, P > _PULLS
    seconds: dict[str, float] = {}
    for j in range(3):
        others = [i for i in range(3) if i != j]
        seconds[f"tendon {MOTORS[j]} alone"] = _seconds(pulls[:, j] & rests[:, others].all(axis=1), sample_time)
    same = np.ptp(P, axis=1) < _RESTS if len(P) else np.zeros(0, dtype=bool)
    seconds["co-contraction"] = _seconds(pulls.all(axis=1) & same, sample_time)
    seconds["holding still"] = _still_seconds(P, run, sample_time)
    return seconds


def _seconds(mask: np.ndarray, sample_time: float) -> float:
    return float(np.count_nonzero(mask) * sample_time)


def _still_seconds(P: Matrix, run: np.ndarray, sample_time: float) -> float:
    """Return the time in stretches of a second or more in which no motor moves; an encoder quantum is no move."""
    if len(P) < 2:
        return 0.0
    span = max(1, round(0.2 / sample_time))
    moved = np.full(len(P), np.inf)
    moved[span:] = np.abs(P[span:] - P[:-span]).max(axis=1)
    moved[span:][run[span:] != run[:-span]] = np.inf
    still = true_stretches(moved < _STILL_SPEED * span * sample_time, run)
    # The first `span` rows of a still stretch compare with rows before it.
    rows = (still[:, 1] - still[:, 0] + span).astype(np.float64)
    return float(rows[rows * sample_time >= _STILL_SECONDS].sum() * sample_time)
