"""The filter over recordings, with the runtime of loops and FMUs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Matrix, ReprMixin, Vector
from softneck.signals import Recording, require_same_robot


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimates(ReprMixin):
    """The filter's estimates of a recording, row by row; the units are for a neck, those of other robots are SI.

    Attributes:
        time: (time,) [s].
        outputs: (time, outputs) estimates at the time of the row: of a neck pitch and roll [rad].
        rates: (time, outputs) [rad/s].
        innovation: (time,) normalised innovation squared; 0 without a measurement.
        accepted: (time,) bool, whether the measurement passed the gate.
        healthy: (time,) bool.
        judged: (time,) bool, whether there was a measurement.
        aligned: (time, outputs) at the instant of the measurement; differs where the sensor is late.
        covariance: (time, outputs, outputs) of `aligned` [rad^2].
        log_det: (time,) log det of the innovation's covariance; 0 without a measurement.
    """

    time: Vector
    outputs: Matrix
    rates: Matrix
    innovation: Vector
    accepted: np.ndarray
    healthy: np.ndarray
    judged: np.ndarray
    aligned: Matrix
    covariance: np.ndarray
    log_det: Vector

    @property
    def pitch(self) -> Vector:
        """Of a neck: the estimates of pitch (time,) [rad]."""
        return self.outputs[:, 0]

    @property
    def roll(self) -> Vector:
        """Of a neck: the estimates of roll (time,) [rad]."""
        return self.outputs[:, 1]

    @property
    def pitch_rate(self) -> Vector:
        """Of a neck: the rates of pitch (time,) [rad/s]."""
        return self.rates[:, 0]

    @property
    def roll_rate(self) -> Vector:
        """Of a neck: the rates of roll (time,) [rad/s]."""
        return self.rates[:, 1]


def run_filter(observer: Any, run: Recording) -> tuple[Matrix, Matrix]:
    """Step the filter through a run as a loop does; return its outputs and states (time, ...)."""
    block, state, kept = observer.block(), observer.initial_state(), []
    for row in input_rows(observer, run, measured_angles(run)):
        state, _ = block.step(state, row)
        kept.append(state)
    return np.array([state.outputs for state in kept]), np.array([state.values for state in kept])


def filter_recording(
    observer: Any, recording: Recording, parts: Mapping[str, slice], align: Callable[[Matrix], tuple[Matrix, Matrix]]
) -> Estimates:
    """Return the estimates of a recording; each run starts anew.

    `parts`: slices of the state by name; `align` returns outputs (time, outputs) and their covariance at the filter's
    time, from states (time, states).
    """
    check_recording(observer, recording)
    m = len(observer.robot.outputs.names)
    y, x = (np.vstack(rows) for rows in zip(*(run_filter(observer, run) for run in recording.runs()), strict=True))
    at_filter, covariance = align(x)
    accepted = x[:, parts["unheard"]][:, 0] == 0.0
    judged = accepted | (y[:, 2 * m] > 0.0)
    return Estimates(
        time=recording.time,
        outputs=y[:, :m].copy(),
        rates=y[:, m : 2 * m].copy(),
        innovation=y[:, 2 * m].copy(),
        accepted=accepted,
        healthy=y[:, 2 * m + 1] > 0.5,
        judged=judged,
        aligned=at_filter,
        covariance=covariance,
        log_det=np.where(judged, x[:, parts["log_det"]][:, 0], 0.0),
    )


def measured_angles(run: Recording) -> Matrix:
    """Return the measured outputs (time, outputs): `pitch_measured` where a simulation logged it, else `pitch`."""
    return np.column_stack([run.channels[name] for name in measured_names(run)])


def measured_names(run: Recording) -> list[str]:
    """Return the channels of the measured outputs: `pitch` beside `pitch_measured` is the truth."""
    axes = run.robot.outputs.names
    return [f"{axis}_measured" if f"{axis}_measured" in run.channels else axis for axis in axes]


def input_rows(observer: Any, run: Recording, z: Matrix) -> Matrix:
    """Return the runtime's inputs (time, inputs) as in a loop, with the measured outputs `z`."""
    valid = np.ones((len(run), 1))
    if observer.form == "gyro":
        rates = np.column_stack([_rate(run, axis) for axis in run.robot.outputs.names])
        lost = np.asarray(~np.isfinite(rates).all(axis=1))
        none = np.zeros((len(run), len(run.robot.motors.names)))
        return np.hstack([none, z, valid, np.where(lost[:, None], np.nan, rates)])
    # The set-points of t_k are commanded after the measurement of t_k, so the filter gets those before. In a Jacobi
    # loop they come a sample early, and the filter keeps them for one.
    late = 0 if observer.order == "jacobi" else 1
    return np.hstack([run.set_points[np.maximum(np.arange(len(run)) - late, 0)], z, valid])


def check_recording(observer: Any, recording: Recording) -> None:
    """Raise DataError for another sample time, missing rates or another robot."""
    if not math.isclose(recording.sample_time, observer.sample_time, rel_tol=1e-6):
        raise DataError(
            f"the recording has sample time {recording.sample_time:g} s, the observer {observer.sample_time:g} s; "
            "resample it or design the observer for it."
        )
    require_same_robot(observer.robot, recording.robot, "the recording and the observer")
    if observer.form == "gyro":
        for axis in recording.robot.outputs.names:
            _rate(recording, axis)


def _rate(run: Recording, axis: str) -> Vector:
    for name in (f"{axis}_rate_measured", f"{axis}_rate"):
        if name in run.channels:
            return run.channels[name]
    raise DataError(
        f"the recording has no channel `{axis}_rate`, which a filter with gyro needs; record it, or design the "
        "observer without the gyro."
    )
