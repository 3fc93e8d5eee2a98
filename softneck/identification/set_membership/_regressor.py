"""What a set of form `paper_eq21`, `lags` or `residual` stands on: its regressor, its drives and its base.

Form `residual` is set membership on what a linear base leaves over: a regressor of simulated signals, so no feedback
to drift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector
from softneck.signals import Recording

from ..linear._arrays import no_base
from ..models._drive import DriveModel
from ..models._model import WARM_UP, Model
from ..models._regressors import history_length, motor_signals, regression
from ..models._scores import nrmse_fit
from ..models._state_space import history_array
from ._gamma import least_gammas
from ._trees import slant_frames, slant_nodes, slant_order

# How far back the neck's state shows in its inputs [s]: the newest sample, then about one, two and four of its
# time constants of 0.2 s. Denser or longer ones moved no free run by more than 2 points (virtual neck, `paper`).
_LOOKS_BACK = (0.02, 0.2, 0.4, 0.8)


# The longest lag is at most this part of a run: twice as long the base settles.
_RUNS_SHARE = 8


def residual_lags(sample_time: float, recording: Recording) -> tuple[int, ...]:
    """Return the lags [samples] of the motors and of the base's outputs, where none were asked for.

    Args:
        sample_time: in the time of a neck [s].
        recording: to learn from.
    """
    lags = {max(round(seconds / sample_time), 1) for seconds in _LOOKS_BACK}
    if not recording.robot.is_neck:  # a robot as slow as its record is long says nothing of what was so long ago
        most = max(len(run) for run in recording.runs()) // _RUNS_SHARE
        lags = {max(min(lag, most), 1) for lag in lags}
    return tuple(sorted(lags))


def residual_rows(
    recording: Recording,
    base: Model,
    table: Matrix,
    axis: int,
    *,
    measured: bool = False,
    offset: Vector | float = 0.0,
) -> tuple[Matrix, Vector]:
    """Return regressors (n, N) and y(k) less the base's free run (N,), no row of a run before the base settled.

    Args:
        recording: what the set is made of.
        base: the linear model.
        table: the regressor; source 3 is the base's free run, of other robots without the offset that the set adds.
        axis: place of the output.
        measured: take logged motor positions instead of the drive model's.
        offset: (outputs,) what is taken from the base's outputs.

    Raises:
        DataError: every run is too short.
    """
    parts, left = [], []
    outputs, both = recording.outputs.shape[1], recording.outputs.shape[1] + recording.set_points.shape[1]
    for run in recording.runs():
        # Its start is forgotten at the far end of the regressor: a base of 4 rad/s keeps 3 % of it after 0.8 s.
        settled = 2 * int(table[:, 2].max())
        if len(run) <= settled:
            continue
        simulated = base.simulate(run, warm_up=1)
        motors = run.motor_positions if measured else simulated[:, outputs:both]
        sources = {1: run.set_points, 2: motors, 3: simulated[:, :outputs] - offset}
        columns = np.array([sources[int(s)][settled - int(lag) : len(run) - int(lag), int(c)] for s, c, lag in table])
        target = run.outputs[settled:, axis] - sources[3][settled:, axis]
        there = np.isfinite(target) & np.isfinite(columns).all(axis=0)
        parts.append(columns[:, there])
        left.append(target[there])
    if sum(part.size for part in left) < 2:
        raise DataError("every run is too short for form `residual`; record runs of several seconds.")
    return np.concatenate(parts, axis=1), np.concatenate(left)


Data = Sequence[tuple[Matrix, Vector]]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """All of a set but its points and their scale.

    Attributes:
        table: the regressor, rows (source, channel, lag).
        drive: supplies motor positions in free run.
        base: the linear model of form `residual`, or None.
        measured: whether the set is made of logged motor positions, where there are any.
        units: (n,) of the regressor's components in the norm, see `regressor_units`.
    """

    table: Matrix
    drive: DriveModel
    base: Model | None
    measured: bool
    units: Vector

    def data(self, recording: Recording) -> Data:
        """Return each axis' regressors (n, N), not scaled, and targets (N,)."""
        axes = range(recording.outputs.shape[1])
        if self.base is not None:
            base, measured = self.base, self.measured and recording.has_motor_positions
            offset = base.arrays.get("offset", 0.0)  # of another robot; the values of the set hold it
            return [residual_rows(recording, base, self.table, axis, measured=measured, offset=offset) for axis in axes]
        recording = motor_signals(recording, self.drive, again=not self.measured)
        pairs = [regression(recording, self.table, axis) for axis in axes]
        return [(X.T, y) for X, y in pairs]

    def arrays(self, data: Data, scale: Vector, gamma: Vector, epsilon: Vector) -> dict[str, Matrix]:
        """Return the runtime's arrays of the set of `data`; gamma and epsilon (outputs,), scale (n,)."""
        history = history_length(self.table, self.drive)
        base = no_base(len(self.drive.pole), len(data))
        if self.base is not None:
            base = base_arrays(self.base)
            least = self.base.arrays["history"][0] if "a" in self.base.arrays else 0.0
            history = max(history, int(least), int(base["delay"].max()) + base["b"].shape[1], base["a"].shape[1])
        return {
            "history": history_array(history, len(data)),
            "drive": self.drive.array,
            "table": self.table,
            "scale": scale,
            **set_arrays([(scaled(X, scale), y) for X, y in data], gamma, epsilon),
            **base,
        }

    def free_run(self, arrays: dict[str, Matrix], recording: Recording) -> tuple[float, float, float]:
        """Return the sum of all axes' free-run fits [%], the bounds' coverage (0 to 1) and mean width [rad].

        The score of a run that left all bounds is -inf.
        """
        robot, outputs = recording.robot, recording.outputs.shape[1]
        lower = outputs + recording.set_points.shape[1] + 2 * np.arange(outputs)
        model = Model(kind="nlsm", sample_time=recording.sample_time, arrays=arrays, robot=robot)
        y, Y = recording.outputs[WARM_UP:], model.simulate(recording)[WARM_UP:]
        fits = [nrmse_fit(y[:, axis], Y[:, axis]) for axis in range(outputs)]
        low, high, there = Y[:, lower], Y[:, lower + 1], np.isfinite(y)
        coverage = float(((low <= y) & (y <= high))[there].mean()) if there.any() else 0.0
        return float(sum(fits)) if np.isfinite(fits).all() else -np.inf, coverage, float(np.mean(high - low))


def base_arrays(base: Model) -> dict[str, Matrix]:
    """Return redefinition, a, b and delay of a linear base: a neck's own, of another robot those of its axes."""
    axes = base.findings.get("transfer_functions")
    if axes is None:
        return {name: base.arrays[name] for name in no_base()}
    return {
        "redefinition": np.array(base.findings["directions"]),
        "a": np.array([entry["a"] for entry in axes.values()]),
        "b": np.array([entry["b"] for entry in axes.values()]),
        "delay": np.array([float(entry["delay"]) for entry in axes.values()]),
    }


def gammas(data: Data, scale: Vector, epsilons: Sequence[Vector]) -> list[Vector]:
    """Return the least gamma (outputs,) for each epsilon (outputs,), by the paper's rule."""
    columns = [
        least_gammas(scaled(X, scale), y, np.array([epsilon[axis] for epsilon in epsilons]))[0]
        for axis, (X, y) in enumerate(data)
    ]
    return [np.array(pair) for pair in zip(*columns, strict=True)]


def scaled(points: Matrix, scale: Vector) -> Matrix:
    """Return points (n, N) in the norm of Eq. 16, each component times its weight."""
    return np.ascontiguousarray(points * scale[:, None])


def set_arrays(points: Data, gamma: Vector, epsilon: Vector) -> dict[str, Matrix]:
    rows = min(values.size for _, values in points)
    if rows < 2:
        raise SettingsError("a set needs at least 2 points.")
    W = np.empty((len(points), points[0][0].shape[0], rows))
    y = np.empty((len(points), rows))
    # Filled in place: with the data at hand and the tree, memory holds 2.9 times the data (of eight sides: 3.3).
    points = [(given[:, :rows], values[:rows]) for given, values in points]
    frames, slopes = slant_frames(points, gamma)
    for axis, (given, values) in enumerate(points):
        order = slant_order(frames[axis], given)
        for row, given_row in zip(W[axis], given, strict=True):
            row[:] = given_row[order]
        y[axis] = values[order]
    nodes = np.array([slant_nodes(*axis) for axis in zip(frames, slopes, W, y, strict=True)])
    return {
        "points": W, "values": y, "bounds": np.column_stack([gamma, epsilon]), "nodes": nodes, "frame": frames,
    }  # fmt: skip
