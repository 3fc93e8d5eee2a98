"""The Kalman observer: one runtime in loops, FMUs and over recordings; tests compare it with filterpy."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import FileFormatError, Matrix, ReprMixin, SettingsError, Vector, to_si, write_archive
from softneck.robot import Robot
from softneck.runtime import Block, Port, SteppedMixin, sized_name
from softneck.signals import Recording

from ._forms import NOISES, STATES, noise_units, require_levels, system
from ._kalman_parts_runtime import (
    KALMAN_DIVIDER,
    KALMAN_FROZEN,
    KALMAN_GATE,
    KALMAN_LEAD,
    KALMAN_MORE_LAGS,
    KALMAN_REJECTIONS,
    KALMAN_TIMEOUT,
    KalmanArrays,
    kalman_lag,
)
from ._kalman_runtime import KalmanFullState
from ._offline import Estimates, filter_recording

if TYPE_CHECKING:
    from filterpy.kalman import KalmanFilter


_KALMAN_RUNTIME = "softneck.estimation._kalman_runtime"
_NECK = Robot.preset("neck")
# Lowest noise level, as a part of a small one.
_MIN_LEVEL_FACTOR = 1e-3
# Sources of the sensor's delay, and their text in the summary.
_DELAY_SOURCES = {
    "given": "as given",
    "sensor": "of the sensor",
    "robot": "of the robot's file; set-points and angles alone give only the sum of drive and sensor delay",
    "recording": "the nearest to the robot's file that the model's recordings allow; measure it",
    "gyro": "from the gyro's rates",
    "motor positions": "the upper bound from motor positions",
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class KalmanObserver(SteppedMixin, ReprMixin):
    """A designed Kalman filter; `KalmanSettings.design` makes it.

    Attributes:
        form: "model" or "gyro".
        sample_time: [s].
        arrays: those of `KalmanArrays`.
        noise: standard deviations, named as `noise_names`, in SI.
        sensor: name of the preset, or the source of its noise: "none" (given), "data" (estimated), "robot" (its file).
        order: of the loop that it runs in.
        gate_level: chi-square level of the gate.
        robot: of the outputs that it estimates.
        delay_source: where the sensor's delay comes from: "given", "sensor", "robot", "gyro", "motor positions".
    """

    form: str = "model"
    sample_time: float
    arrays: tuple[Matrix, ...]
    noise: tuple[float, float, float]
    sensor: str
    order: str
    gate_level: float
    robot: Robot = _NECK
    delay_source: str = "given"

    def __post_init__(self) -> None:
        for name in ("first_noise", "second_noise", "P0", "PF"):
            _require_covariance(name, getattr(self._named, name))

    @property
    def _named(self) -> KalmanArrays:
        return KalmanArrays(self.arrays)

    @property
    def delays(self) -> tuple[int, ...]:
        """Dead time from set-points to each output, beyond the first sample [samples]; 0 without set-points."""
        acts, axes = self.form == "model", range(len(self.robot.outputs.names))
        return tuple(int(kalman_lag(self._named.constants, axis)) if acts else 0 for axis in axes)

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names of the noise levels."""
        return tuple(name for name, _ in NOISES[self.form])

    @property
    def lead(self) -> float:
        """How far the estimate runs ahead of the measurement [s]: the sensor's delay."""
        return float(self._named.constants[KALMAN_LEAD]) * self.sample_time

    @property
    def constants(self) -> Vector:
        """The constants KALMAN_* of `_kalman_parts_runtime`."""
        return self._named.constants

    @property
    def directions(self) -> Matrix:
        """Weights (outputs, inputs) of the filter's inputs: motors, or rates of the gyro."""
        return self._named.sources

    def with_constants(self, constants: Vector) -> KalmanObserver:
        """Return the filter with other constants; its gains do not depend on the delays."""
        names = KalmanArrays.names()
        place = names.index("constants")
        return dataclasses.replace(self, arrays=(*self.arrays[:place], constants, *self.arrays[place + 1 :]))

    def with_noise(self, noise: Sequence[float], *, sensor: str = "none") -> KalmanObserver:
        """Return the filter with other noise levels."""
        levels = require_levels(self.form, self.robot, noise)
        return dataclasses.replace(self, noise=levels, sensor=sensor)

    def block(self) -> Block:
        """Return the filter as a block of role "observer"."""
        inputs, outputs = observer_ports(self.form, self.robot)
        levels = list(zip(noise_units(self.form, self.robot), self.noise, strict=True))
        return Block(
            kind="kalman",
            role="observer",
            runtime=sized_name(_KALMAN_RUNTIME, len(self.robot.motors.names), len(self.robot.outputs.names)),
            sample_time=self.sample_time,
            arrays=self.arrays,
            inputs=inputs,
            outputs=outputs,
            parameters=tuple(
                Port(name=name, unit=unit, start=value, minimum=min(1e-9, _MIN_LEVEL_FACTOR * value),
                     maximum={"rad": math.pi, "rad/s": 1e3}.get(unit), description="standard deviation",
                     display_unit=self.robot.outputs.shown if unit == to_si(self.robot.outputs.unit)[1] else "")
                for (name, unit), value in levels
            ),
        )  # fmt: skip

    def filterpy(self) -> KalmanFilter:
        """Return the configured `filterpy.kalman.KalmanFilter`, with an input and a measurement for each output.

        Give `predict(u)` the delayed inputs (outputs, 1): theta_i and phi_i, or rates of the gyro. Call `update(None)`
        for a missing measurement: NaN would stay in its state.
        """
        from filterpy.kalman import KalmanFilter

        F, H, Q, R = system(self.arrays, self.noise)
        kf: Any = KalmanFilter(dim_x=F.shape[0], dim_z=H.shape[0], dim_u=H.shape[0])
        kf.F, kf.B, kf.H = F.copy(), self._named.B.copy(), H.copy()
        kf.P, kf.Q, kf.R = self._named.P0.copy(), Q, R
        return kf

    def estimate(self, recording: Recording) -> Estimates:
        """Filter a recording; each of its runs starts anew. Missing samples are predicted over.

        Raises:
            DataError: another sample time, or no gyro rates where the form needs them.
        """
        H, parts = self._named.H, KalmanFullState.parts(self._named)

        def align(x: Matrix) -> tuple[Matrix, Matrix]:
            return x[:, parts["x"]] @ H.T, H @ x[:, parts["P"]].reshape(-1, H.shape[1], H.shape[1]) @ H.T

        return filter_recording(self, recording, parts, align)

    def summary(self) -> str:
        """Return a text of some lines."""
        n, c = len(self._named.F), self._named.constants
        acts = (
            f"; set-points act after {_join_with_and(d + 1 for d in self.delays)} samples"
            if self.form == "model"
            else ""
        )
        shown, si = to_si(self.robot.outputs.display_unit)
        levels = [
            f"{name.removesuffix('_noise_std')} {value / shown:.3g} "
            f"{unit.replace(si, self.robot.outputs.display_unit, 1)}"
            for (name, unit), value in zip(noise_units(self.form, self.robot), self.noise, strict=True)
        ]
        lines = [
            f"kalman observer, {self.sample_time * 1e3:g} ms, {self.order} order, sensor {self.sensor}",
            f"  {self.form} form, gains from the covariance",
            f"  {n} states: {STATES[self.form]} of {_join_with_and(self.robot.outputs.names)}{acts}",
            f"  noise: {', '.join(levels)}",
            *gate_and_timing_lines(self.gate_level, c, self.sample_time, self.delay_source),
        ]
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the observer to one `.npz` file."""
        source = {} if self.delay_source == "given" else {"delay_source": self.delay_source}
        write_archive(
            path,
            {**file_header(self), **source},
            dict(zip(KalmanArrays.names(), self.arrays, strict=True)),
            force=force,
        )

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> KalmanObserver:
        """Return the observer that `save` wrote; `softneck.core.load` calls this."""
        form = str(header["form"])
        gone = "form kinematic" if form == "kinematic" else "constant gains" if "gain" in arrays else ""
        if gone:
            raise FileFormatError(f"{gone} was removed after softneck 0.2.0, which reads the file; design it again.")
        items = KalmanArrays.read(arrays)
        robot = Robot.from_dict(header["robot"]) if "robot" in header else _NECK
        outputs, motors = len(robot.outputs.names), len(robot.motors.names)
        if items["sources"].shape != (outputs, outputs if form == "gyro" else motors):
            raise FileFormatError(f"its array `sources` is not of form {form}; design the observer again.")
        if items["constants"].size != KALMAN_MORE_LAGS + max(outputs - 2, 0):
            raise FileFormatError("its array `constants` has another length; design the observer again.")
        try:
            return cls(
                form=form, sample_time=float(header["sample_time"]), arrays=tuple(items.values()), robot=robot,
                **fields_from_header(header, form),
            )  # fmt: skip
        except SettingsError as error:
            raise FileFormatError(f"{error} Design the observer again.") from error


def gate_and_timing_lines(gate_level: float, constants: Vector, sample_time: float, source: str) -> list[str]:
    """Return the summary's lines on the gate, health and the timing of the sensor."""
    c = constants
    lines = [
        f"  gate: chi-square level {gate_level:g} (innovation <= {c[KALMAN_GATE]:.3g}); "
        f"off after {c[KALMAN_REJECTIONS]:g} rejections in a row",
        f"  healthy until {c[KALMAN_TIMEOUT] * sample_time * 1e3:g} ms without an accepted measurement"
        + (f" or {c[KALMAN_FROZEN]:g} identical ones" if c[KALMAN_FROZEN] > 0 else ""),
    ]
    if c[KALMAN_DIVIDER] > 1 or c[KALMAN_LEAD] > 0:
        lines.append(
            f"  measured every {c[KALMAN_DIVIDER] * sample_time * 1e3:g} ms, late by "
            f"{c[KALMAN_LEAD] * sample_time * 1e3:g} ms ({_DELAY_SOURCES[source]})"
        )
    return lines


def file_header(observer: Any) -> dict[str, Any]:
    """Return the file header that both kinds of observers share."""
    return {
        **observer.block().in_header(),
        "form": observer.form,
        "noise": dict(zip(observer.noise_names, observer.noise, strict=True)),
        **{name: getattr(observer, name) for name in ("sensor", "order", "gate_level")},
        **observer.robot.in_header(),
    }


def fields_from_header(header: Mapping[str, Any], form: str) -> dict[str, Any]:
    """Return the fields in the header of either kind; earlier versions have no source of the sensor's delay."""
    source = str(header.get("delay_source", "given"))
    return {
        "noise": tuple(float(header["noise"][name]) for name, _ in NOISES[form]),
        "sensor": str(header["sensor"]),
        "order": str(header["order"]),
        "gate_level": float(header["gate_level"]),
        "delay_source": source if source in _DELAY_SOURCES else "given",
    }


def observer_ports(form: str, robot: Robot = _NECK) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """Return the inputs and outputs of a filter of one form."""
    names, unit, shown = robot.outputs.names, to_si(robot.outputs.unit)[1], robot.outputs.shown
    factor, motor = to_si(robot.motors.unit)
    ends = [[None] * len(robot.set_points) if given is None else [factor * value for value in given]
            for given in (robot.motors.setpoint_min, robot.motors.setpoint_max)]  # fmt: skip
    u = tuple(
        Port(name=name, unit=motor, minimum=low, maximum=high, display_unit=robot.motors.shown)
        for name, low, high in zip(robot.set_points, *ends, strict=True)
    )
    y = tuple(
        Port(name=f"{a}_measured", unit=unit, description=f"measured {a}", missing=True, display_unit=shown)
        for a in names
    )
    valid = Port(name="measurement_valid", description="whether the outputs were measured", start=1.0, boolean=True)
    rates = tuple(
        Port(name=f"{a}_rate_measured", unit=f"{unit}/s", description=f"{a} rate of the gyro", missing=True)
        for a in names
    )
    outputs = (
        *(Port(name=a, unit=unit, description=f"estimated {a}", display_unit=shown) for a in names),
        *(Port(name=f"{a}_rate", unit=f"{unit}/s", description=f"estimated rate of {a}") for a in names),
        Port(name="innovation", description="normalised innovation squared; 0 when nothing was measured"),
        Port(name="healthy", description="a measurement was accepted in time", boolean=True),
    )
    return (*u, *y, valid, *(rates if form == "gyro" else ())), outputs


def _join_with_and(items: Iterable[object]) -> str:
    *most, last = (str(item) for item in items)
    return f"{', '.join(most)} and {last}" if most else last


def _require_covariance(name: str, P: Matrix) -> None:
    """Raise SettingsError unless `P` is symmetric and no direction has a negative variance."""
    largest = float(np.abs(P).max(initial=0.0))
    # 1e-9 of the largest: rounding of a zero eigenvalue.
    if not np.isfinite(P).all() or not np.allclose(P, P.T, rtol=0.0, atol=1e-9 * largest):
        raise SettingsError(f"the covariance `{name}` must be finite and symmetric.")
    least = float(np.linalg.eigvalsh(P).min())
    if least < -1e-9 * largest:
        raise SettingsError(
            f"the covariance `{name}` must be positive semidefinite; its least eigenvalue is {least:.3g}."
        )
