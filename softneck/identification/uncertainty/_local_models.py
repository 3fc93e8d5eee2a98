"""Local models: one pole and dead time around an operating point, over windows, points and whole recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording

from ..linear._srivc_fit import Continuous, Runs, SrivcFitOptions, deviations
from ..models._directions import Directions

# Below this spread of its scaled input a window does not show an axis: 0.05 rad move the neck by 0.3 deg.
_LEAST_INPUT = 0.05
# How far scaled outputs go from their mean: of the neck some 0.2 rad.
_OUTPUT_SPREAD = 0.2
# A local model is kept where these are known to better than these parts of themselves.
_WORST_GAIN, _WORST_POLE = 0.3, 0.6
_LEAST_FIT = 50.0
_START_POLES = (5.0, 1.5, 15.0)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Local:
    """One local model `K exp(-L s)/(s + p)` of one axis.

    scope: "window", "point" or "recording"; recording: index, -1 for a point over several; time: middle of the window
    [s], NaN for others; inclination, direction: mean tilt and its direction [rad]; std: (4,) of static gain, pole, dead
    time and K; fit: [%] of the window's own variation.
    """

    scope: str
    recording: int
    time: float
    inclination: float
    direction: float
    model: Continuous
    std: Vector
    fit: float

    @property
    def numbers(self) -> Vector:
        """(3,) static gain [rad/rad], pole [1/s] and dead time [s]."""
        return np.array([self.model.b[0] / self.model.a[0], self.model.a[0], self.model.delay])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Window:
    """A segment of one run, with rows before it whose outputs are not judged.

    time: of its middle [s]; inputs: (time, channels) redefined, and co-contraction where the robot names it; outputs:
    (time, outputs), NaN in the rows before; inclination, direction: means over it [rad].
    """

    recording: int
    time: float
    inputs: Matrix
    outputs: Matrix
    inclination: float
    direction: float

    def run(self, axis: int) -> tuple[Vector, Vector]:
        """Return input and output of an axis."""
        return np.ascontiguousarray(self.inputs[:, axis]), np.ascontiguousarray(self.outputs[:, axis])

    def is_excited(self, axis: int) -> bool:
        """Return whether the axis is driven and measured in it."""
        y = self.outputs[:, axis]
        return float(self.inputs[:, axis].std()) > _LEAST_INPUT and int(np.isfinite(y).sum()) > 0.5 * y.size


def tilt(outputs: Matrix) -> tuple[Vector, Vector]:
    """Return inclination and direction (time,) [rad] of pitch and roll (time, 2), or of one angle (time, 1)."""
    p = np.tan(outputs[:, 0])
    r = np.tan(outputs[:, 1]) if outputs.shape[1] > 1 else np.zeros_like(p)
    return np.arctan(np.hypot(p, r)), np.arctan2(p, -r)


def axis_inputs(run: Recording, directions: Directions, source: str) -> Matrix:
    """Return the redefined inputs (time, channels): one an output, and co-contraction where it is named."""
    motors = run.motor_positions if source == "positions" else run.set_points
    T = directions.redefinition if run.robot.directions.names else directions.weights
    return motors @ T.T


def _place(outputs: Matrix, recording: Recording, upright: bool) -> tuple[Vector, Vector]:
    """Return inclination and direction (time,) [rad] of angles from upright; of other outputs their way from the mean.

    Operating points are 7.5 deg wide, and a neck goes some 0.2 rad to each side: others are taken as large.
    """
    if upright:
        return tilt(outputs)
    measured = recording.outputs
    moved = _OUTPUT_SPREAD * (outputs - np.nanmean(measured, axis=0)) / np.nanstd(measured, axis=0)
    other = moved[:, 1] if moved.shape[1] > 1 else np.zeros(len(moved))
    return np.linalg.norm(moved, axis=1), np.arctan2(moved[:, 0], -other)


def windows(
    recording: Recording, number: int, directions: Directions, *, length: float, lead: float, source: str, upright: bool
) -> list[Window]:
    """Cut every run into half-overlapping windows of `length` [s]; a run of half that length is one window.

    `number` is the recording's index; inputs in the `lead` [s] before a window still act in it; `source` is
    "set_points" or "positions"; `upright`: outputs are one or two angles from a rest that the robot gives.
    """
    Ts = recording.sample_time
    size, before = round(length / Ts), round(lead / Ts)
    cut: list[Window] = []
    for run in recording.runs():
        U = axis_inputs(run, directions, source)
        Y = run.outputs
        if len(run) < size // 2:
            continue
        for start in range(0, max(len(run) - size, 0) + 1, max(size // 2, 1)):
            first, stop = max(start - before, 0), min(start + size, len(run))
            outputs = Y[first:stop].copy()
            outputs[: start - first] = np.nan
            inclination, direction = _place(Y[start:stop], recording, upright)
            # The mean of a direction is that of its vector.
            mean = np.nanmean(inclination * np.exp(1j * direction))
            cut.append(
                Window(
                    recording=number,
                    time=float(run.time[start] + 0.5 * (stop - start) * Ts),
                    inputs=U[first:stop],
                    outputs=outputs,
                    inclination=float(np.nanmean(inclination)),
                    direction=float(np.angle(mean)),
                )
            )
    return cut


def fit_local(
    search: SrivcFitOptions, group: Sequence[Window], axis: int, *, scope: str, near: Continuous | None = None
) -> Local | None:
    """Fit one model to all windows of a group, each with its own start and offset; None if they are not informative.

    `scope` is of the result; `near`: a model to start from as well.
    """
    chosen = [window for window in group if window.is_excited(axis)]
    if not chosen:
        return None
    runs: Runs = [window.run(axis) for window in chosen]
    fits = [search.start(runs, pole, delay) for pole in _START_POLES for delay in (0.3 * search.max_delay,)]
    if near is not None:
        fits.append(search.improve(runs, near, [np.zeros(2) for _ in runs]))
    there = [fit for fit in fits if fit is not None]
    if not there:
        return None
    best = min(there, key=lambda fit: fit.cost)
    std, percent = deviations(search, runs, best)
    model = best.model
    gain, pole = model.b[0] / model.a[0], model.a[0]
    sure = std[0] < _WORST_GAIN * abs(gain) and std[1] < _WORST_POLE * pole and percent > _LEAST_FIT
    # A pole at its bound was not found but stopped.
    if not sure or gain <= 0.0 or pole > 0.98 * search.fastest:
        return None
    weights = np.array([window.inputs.shape[0] for window in chosen], dtype=float)
    inclination = float(np.average([window.inclination for window in chosen], weights=weights))
    direction = float(np.angle(np.average([np.exp(1j * w.direction) for w in chosen], weights=weights)))
    numbers = {window.recording for window in chosen}
    return Local(
        scope=scope,
        recording=numbers.pop() if len(numbers) == 1 else -1,
        time=chosen[0].time if scope == "window" else float("nan"),
        inclination=inclination,
        direction=direction,
        model=model,
        std=std,
        fit=percent,
    )


def fit_compression(
    recordings: Sequence[Recording], search: SrivcFitOptions, directions: Directions, source: str
) -> Continuous | None:
    """Return G_delta from co-contraction to compression [m], None where it was not logged or not excited."""
    runs: list[tuple[Vector, Vector]] = []
    for recording in recordings:
        for run in recording.runs():
            if "compression" not in run.channels or not run.robot.directions.names:
                continue
            U = axis_inputs(run, directions, source)
            # In millimetres the numbers are of the order of one.
            runs.append((np.ascontiguousarray(U[:, -1]), 1e3 * run.channels["compression"]))
    if not runs or max(float(u.std()) for u, _ in runs) < 0.05:
        return None
    fits = [fit for pole in (5.0, 1.5, 15.0) if (fit := search.start(runs, pole, 0.1)) is not None]
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit.cost).model
    return Continuous(a=best.a, b=1e-3 * best.b, delay=best.delay)


def unit_response(model: Continuous, u: Vector, sample_time: float) -> Vector:
    """Return the response to `u` of the model scaled to a static gain of one, from rest at u(0)."""
    from scipy.signal import lfilter

    scaled = Continuous(a=model.a, b=model.a[-1:], delay=model.delay)
    a, b, d = scaled.discretize(sample_time)
    return u[0] + np.asarray(lfilter(np.concatenate([np.zeros(1 + d), b]), np.concatenate([[1.0], a]), u - u[0]))
