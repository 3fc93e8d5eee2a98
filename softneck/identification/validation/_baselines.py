"""Baselines of every model: persistence, and the best linear time-invariant model of the set-points in hindsight.

Persistence at 20 ms fits 97 %, so nothing below it has predicted anything. The best linear one is least squares on the
rows judged, an upper bound: free responses over the first 0.3 s, then orthonormal lags with real poles from 0.0125 to
6.4 s (Wahlberg 1991; Ninness and Gustafsson 1997). k steps ahead, measured outputs are known as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix
from softneck.robot import TIME_CONSTANT
from softneck.signals import Recording

from ..models._scores import nrmse_fit
from ._score_tables import Rows, ScoredSegment


def persistence(run: Recording, horizon: int) -> Matrix:
    """Repeat the measurement `horizon` samples before (time, 2), or the last one before a gap."""
    y = held_outputs(run)
    return np.vstack([np.repeat(y[:1], min(horizon, len(y)), axis=0), y[:-horizon]])


def held_outputs(run: Recording) -> Matrix:
    """Return pitch and roll (time, 2) [rad] with each missed sample replaced by the last one before it."""
    y = run.outputs.copy()
    for axis in range(y.shape[1]):
        last = np.maximum.accumulate(np.where(np.isfinite(y[:, axis]), np.arange(len(y)), 0))
        y[:, axis] = y[last, axis]
    return y


# Dead times of a robot and its drives: the response is free, tap by tap, for so many scaled seconds.
_FREE_SECONDS = 0.3
# Beyond, each octave of scaled time constants has its own pole: a lag between two of them is met to 1e-3.
_TIME_CONSTANTS = 0.0125 * 2.0 ** np.arange(10)
# So does the initial state of a segment; what is faster has gone before its first row is judged.
_DECAYS = _TIME_CONSTANTS[3:]
# Measured samples of both outputs that a prediction k steps ahead may use.
_PAST_SAMPLES = 10
# With fewer rows for each parameter the fit would flatter by more than 5 of what is left to 100.
_ROWS_PER_PARAMETER = 10


def best_linear(
    segments: Sequence[ScoredSegment], rows: Rows, horizons: Sequence[int | None]
) -> list[list[float | None]]:
    """Return for each horizon (None: simulation) the fit [%] of pitch and roll; None where rows are too few.

    For a finite horizon persistence and, in simulation, every stable linear model of the set-points lies below.
    """
    Ts = segments[0].recording.sample_time * TIME_CONSTANT / (rows.robot.time_constant_s or np.nan)
    inputs = np.concatenate([_response_columns(segment.recording.set_points, Ts) for segment in segments])
    columns = np.column_stack([np.ones(len(inputs)), inputs, _decay_columns(segments, Ts)])
    result: list[list[float | None]] = []
    for horizon in horizons:
        if horizon is None:
            result.append(_fits(columns, rows.measured))
            continue
        past = np.concatenate([_past_columns(segment.recording, horizon) for segment in segments])
        result.append(_fits(np.column_stack([columns, past]), rows.outputs_at(horizon)))
    return result


def _fits(columns: Matrix, measured: Matrix) -> list[float | None]:
    there = np.isfinite(measured)
    if (there[:, :1] == there).all():
        return _fit_axes(columns, measured, there[:, 0])
    return [_fit_axes(columns, measured[:, [axis]], there[:, axis])[0] for axis in range(measured.shape[1])]


def _fit_axes(columns: Matrix, measured: Matrix, rows: np.ndarray) -> list[float | None]:
    """Return the fits [%] of the columns of `measured` on the rows given, by QR and then least squares on R."""
    if rows.sum() < _ROWS_PER_PARAMETER * columns.shape[1]:
        return [None] * measured.shape[1]
    X, Y = columns[rows], measured[rows]
    # Set-points that stand still, or that move together, leave columns that say the same: the least norm takes them.
    R = np.asarray(np.linalg.qr(np.column_stack([X, Y]), mode="r"))
    p = X.shape[1]
    theta = np.linalg.lstsq(R[:, :p], R[:, p:], rcond=None)[0]
    fits = [nrmse_fit(y, yhat) for y, yhat in zip(Y.T, (X @ theta).T, strict=True)]
    return [fit if np.isfinite(fit) else None for fit in fits]


def _response_columns(u: Matrix, Ts: float) -> Matrix:
    """Return the set-points (time, n) of the samples before, tap by tap, and then through the ladder."""
    taps = round(_FREE_SECONDS / Ts) + 1
    columns = [_late(u, lag) for lag in range(1, taps + 1)]
    stage = columns[-1]
    p_before = 0.0
    for number, p in enumerate(np.exp(-Ts / _TIME_CONSTANTS)):
        # Orthonormal by an all-pass of the pole before (Takenaka-Malmquist); the first has none.
        numerator = [0.0, 1.0] if number == 0 else [-p_before, 1.0]
        stage = _filter_first_order(numerator, [1.0, -p], stage)
        columns.append(np.sqrt(1.0 - p**2) * stage)
        p_before = p
    return np.column_stack(columns)


def _filter_first_order(numerator: list[float], denominator: list[float], x: Matrix) -> Matrix:
    """Return a first-order filter of x (time, 3) that had stood at x(0) before."""
    from scipy.signal import lfilter

    gain = sum(numerator) / sum(denominator)
    # Steady state of the transposed direct form: z = y - b0 x.
    z = (gain - numerator[0]) * x[:1]
    return np.asarray(lfilter(numerator, denominator, x, axis=0, zi=z)[0])


def _decay_columns(segments: Sequence[ScoredSegment], Ts: float) -> Matrix:
    """Return decaying exponentials (time, 7 for each segment), each zero outside its segment."""
    columns = np.zeros((sum(len(s.recording) for s in segments), len(_DECAYS) * len(segments)))
    row = 0
    for number, segment in enumerate(segments):
        n = len(segment.recording)
        t = np.arange(n) * Ts
        for i, seconds in enumerate(_DECAYS):
            columns[row : row + n, len(_DECAYS) * number + i] = np.exp(-t / seconds)
        row += n
    return columns


def _past_columns(run: Recording, horizon: int) -> Matrix:
    """Return both outputs at t-k, t-k-1, ... (time, 20), a missed sample by the one before."""
    held = np.nan_to_num(held_outputs(run))
    return np.column_stack([_late(held, horizon + back) for back in range(_PAST_SAMPLES)])


def _late(x: Matrix, lag: int) -> Matrix:
    """Return x(t - lag) (time, n), x(0) before the record."""
    lag = min(lag, len(x))
    return np.vstack([np.repeat(x[:1], lag, axis=0), x[: len(x) - lag]])


@dataclass(frozen=True, slots=True, eq=False)
class Baselines:
    """Fits [%] of persistence and the best linear model, horizon -> axis -> fit."""

    persistence: dict[str, dict[str, float | None]]
    best_linear: dict[str, dict[str, float | None]]


def baselines(segments: Sequence[ScoredSegment], rows: Rows, horizons: Sequence[int | str]) -> Baselines:
    """Return the baselines of the segments judged.

    The best linear model has poles about the robot's time constant; there is none where its file does not give one.
    """
    axes = rows.names
    nothing: list[float | None] = [None] * len(axes)
    names = [str(h) for h in horizons]
    steps = [None if h == "inf" else int(h) for h in horizons]
    bounds = best_linear(segments, rows, steps) if rows.robot.time_constant_s else [nothing for _ in steps]
    held: dict[str, dict[str, float | None]] = {}
    for name, k in zip(names, steps, strict=True):
        if k is not None:
            predicted = np.concatenate([persistence(segment.recording, k) for segment in segments])
            pairs = zip(rows.outputs_at(k).T, predicted.T, strict=True)
            held[name] = _by_axis(axes, [nrmse_fit(y, yhat) for y, yhat in pairs])
    return Baselines(
        persistence=held, best_linear={name: _by_axis(axes, fits) for name, fits in zip(names, bounds, strict=True)}
    )


def _by_axis(names: Sequence[str], fits: Sequence[float | None]) -> dict[str, float | None]:
    return {a: f if f is not None and np.isfinite(f) else None for a, f in zip(names, fits, strict=True)}
