"""Regressor matrices for training, with the lags of the runtime; no row crosses the border of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from softneck.core import DataError, Matrix, SettingsError, Vector
from softneck.robot import Scaling
from softneck.signals import Recording

from ._drive import DriveModel

# Lag between the samples of u and M in Eq. 21 [s]: the neck's sample time, a tenth of its time constant.
_LAG_STEP_S = 0.02


def lag_table(
    outputs: Sequence[int],
    set_points: Sequence[int],
    motors: Sequence[int],
    *,
    both_outputs: bool = False,
    sizes: tuple[int, int] = (3, 2),
) -> Matrix:
    """Return the regressor table, with rows (source, channel, lag), of lags of y, u_i and M_i [samples].

    `both_outputs`: all outputs at each lag, for form `residual`; `sizes`: numbers of motors and outputs.
    """
    rows = [[0, 0, lag] for lag in outputs]
    if both_outputs:
        rows = [[3, c, lag] for lag in outputs for c in range(sizes[1])]
    rows += [[1, c, lag] for c in range(sizes[0]) for lag in set_points]
    rows += [[2, c, lag] for lag in motors for c in range(sizes[0])]
    return np.array(rows, dtype=np.float64)


#: The regressor of Eq. 21: y(k-1); u_i(k-2), u_i(k-3); M_i(k-3).
# Rows are (source, channel, lag): 0 own output, 1 u, 2 M.
PAPER_EQ21 = lag_table((1,), (2, 3), (3,))


def eq21_table(recording: Recording) -> Matrix:
    """Return the regressor of Eq. 21 for a scaled recording, with the lags in time of a neck at 20 ms."""
    sizes = len(recording.robot.motors.names), len(recording.robot.outputs.names)
    apart = max(round(_LAG_STEP_S / recording.sample_time), 1)
    return lag_table((1,), (1 + apart, 1 + 2 * apart), (1 + 2 * apart,), sizes=sizes)


def spread_table(recording: Recording) -> Matrix:
    """Return a regressor for a scaled recording of unknown dead time: three samples of y and of all u."""
    sizes = len(recording.robot.motors.names), len(recording.robot.outputs.names)
    lags = [1 + i * max(round(2.0 * _LAG_STEP_S / recording.sample_time), 1) for i in range(3)]
    return lag_table(lags, lags, [], sizes=sizes)


def regressor_scale(table: Matrix, scaling: Scaling, base_rest: Vector | float = 0.0) -> tuple[Matrix, Matrix]:
    """Return rest value in SI and unit of each regressor of each output (outputs, n); source 3 rests at `base_rest`."""
    outputs, at = len(scaling.output_unit), table[:, 1].astype(int)
    rests, units = np.zeros((outputs, len(table))), np.full((outputs, len(table)), scaling.motor_unit)
    own, base, motors = table[:, 0] == 0, table[:, 0] == 3, np.isin(table[:, 0], (1, 2))
    rests[:, own], units[:, own] = scaling.output_rest[:, None], scaling.output_unit[:, None]
    rests[:, base], units[:, base] = np.broadcast_to(base_rest, outputs)[at[base]], scaling.output_unit[at[base]]
    rests[:, motors] = scaling.motor_rest[at[motors]]
    return rests, units


def motor_signals(recording: Recording, drive: DriveModel, *, again: bool = False) -> Recording:
    """Add motor positions of the drive model to a recording without logged ones, or with `again` to any."""
    if recording.has_motor_positions and not again:
        return recording
    positions = np.concatenate([drive.simulate(run.set_points, run.set_points[0]) for run in recording.runs()])
    return recording.with_channels(**dict(zip(recording.robot.motor_positions, positions.T, strict=True)))


def regression(recording: Recording, table: Matrix, axis: int) -> tuple[Matrix, Vector]:
    """Return regressors (rows, n) and targets y(k) (rows,) of one axis, without rows with a missed sample."""
    if table.shape[1] != 3 or table[:, 2].min() < 1:
        raise SettingsError("each row of a regressor table is (source, channel, lag) with lag >= 1.")
    X, y = zip(*[_run_regression(run, table, axis) for run in recording.runs()], strict=True)
    regressors, targets = np.concatenate(X), np.concatenate(y)
    good = np.isfinite(regressors).all(axis=1) & np.isfinite(targets)
    if good.sum() < 2:
        raise DataError(f"the recording is too short: {len(recording)} rows leave {good.sum()} to fit.")
    return regressors[good], targets[good]


def _run_regression(run: Recording, table: Matrix, axis: int) -> tuple[Matrix, Vector]:
    lag = int(table[:, 2].max())
    if len(run) <= lag:
        return np.zeros((0, table.shape[0])), np.zeros(0)
    return lagged_columns(run, run.motor_positions, axis, table), run.outputs[lag:, axis]


def lagged_columns(run: Recording, motors: Matrix, axis: int, table: Matrix) -> Matrix:
    """Return the regressors (rows, n) of one run and axis along positions `motors` (time, motors)."""
    lag, sources = int(table[:, 2].max()), (run.outputs[:, [axis]], run.set_points, motors)
    return np.column_stack([sources[int(s)][lag - int(back) : len(run) - int(back), int(c)] for s, c, back in table])
