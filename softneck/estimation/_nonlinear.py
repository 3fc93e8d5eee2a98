"""The observer over a nonlinear model: its simulation (free run), and what that misses of the outputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import FileFormatError, Matrix, ReprMixin, Vector, to_si, write_archive
from softneck.identification import KINDS as LINEAR
from softneck.identification import Model, embed_model, embedded_model, payloads, without_validity
from softneck.robot import TIME_CONSTANT, Robot
from softneck.runtime import Block, Port, SteppedMixin
from softneck.signals import Recording

from ._axis import directions_of, slowest_seconds
from ._forms import NOISES, noise_units, require_levels
from ._kalman import fields_from_header, file_header, gate_and_timing_lines, observer_ports
from ._kalman_parts_runtime import KALMAN_LEAD, KALMAN_MORE_LAGS
from ._nonlinear_parts_runtime import NonlinearArrays, NonlinearState
from ._offline import Estimates, check_recording, filter_recording, run_filter

_NONLINEAR_RUNTIME = "softneck.estimation._nonlinear_runtime"
# Over a model that takes the payload as a parameter.
_PAYLOAD_RUNTIME = "softneck.estimation._payload_runtime"
FORM = "nonlinear"
# A model settles within 6 scaled seconds. The recent motion keeps 0.95 of its value in 0.02 scaled seconds: it halves
# in 0.27, the duration of a step.
_SETTLING_S, _MOTION_MEMORY, _NOMINAL_PERIOD_S = 6.0, 0.95, 0.02
# A finite number beyond any set-point: files and C take it.
_NO_SLEW_LIMIT = 1e12
# How long a timing error lasts [scaled s]: from 2 to 8 the error changes by 0.5 %.
_TIMING_MEMORY_S = 4.0
# Standard deviation of the payload's random walk in a scaled second, as a part of the payload range.
_PAYLOAD_WALK = 0.1
_PAYLOAD_PORT = Port(name="payload", unit="kg", description="estimated, within what the model's recordings had")
_NOISE_DESCRIPTIONS = ("standard deviation", "standard deviation", "of the model's fastest motion of late")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class NonlinearObserver(SteppedMixin, ReprMixin):
    """A filter over an identified model of any kind; `KalmanSettings.design` makes it.

    The outputs are the model's simulation from the set-points, earlier or later by a timing error that varies, plus a
    random-walk disturbance. Its step has the standard deviation `rest_noise_std` at rest, and `motion_noise_ratio`
    times the model's recent motion besides.

    Over a model of several payloads, the payload is a further state with an output of its own.

    Attributes:
        model: of any kind; its state is not corrected.
        noise: standard deviations, named as `noise_names`, in SI.
        constants: see KALMAN_* of `_kalman_parts_runtime`.
        start: initial standard deviation of the disturbance [SI].
        timing: standard deviation of the timing error [s]; 0 without one, as in files of before.
        slew: (motors,) limit on the rate of set-points [SI/s]; None without a limit.
        sensor: name of the preset, or the source of its noise: "none" (given), "robot" (its file), "recording".
        order: of the loop that it runs in.
        gate_level: chi-square level of the gate.
        delay_source: where the sensor's delay comes from: "given", "sensor", "robot", "recording".
    """

    model: Model
    noise: tuple[float, float, float]
    constants: Vector
    start: float
    sensor: str
    order: str
    gate_level: float
    timing: float = 0.0
    delay_source: str = "given"
    slew: tuple[float, ...] | None = None
    form: str = FORM

    @property
    def robot(self) -> Robot:
        """The model's robot."""
        return self.model.robot

    @property
    def payloads(self) -> tuple[float, float] | None:
        """The lowest and highest payload [kg] of the model's recordings; None for a model of one payload."""
        return payloads(self.model.arrays)

    @property
    def sample_time(self) -> float:
        """Sample time of the model and of the loop [s]."""
        return self.model.sample_time

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names of the noise levels."""
        return tuple(name for name, _ in NOISES[FORM])

    @property
    def directions(self) -> Matrix:
        """Weights (outputs, motors) of the motors in each output."""
        return directions_of(self.model)

    @property
    def lead(self) -> float:
        """How far the estimate runs ahead of the measurement [s]: the sensor's delay."""
        return float(self.constants[KALMAN_LEAD]) * self.sample_time

    def with_constants(self, constants: Vector) -> NonlinearObserver:
        """Return the filter with other constants."""
        return replace(self, constants=constants)

    def with_noise(self, noise: Sequence[float], *, sensor: str = "none") -> NonlinearObserver:
        """Return the filter with other noise levels."""
        levels = require_levels(FORM, self.robot, noise)
        return replace(self, noise=levels, sensor=sensor)

    def block(self) -> Block:
        """Return the filter as a block of role "observer"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        # The model's validity is not part of the estimate and costs time in each step.
        plant = replace(self.model, arrays=without_validity(self.model.arrays)).block()
        inputs, outputs = observer_ports(FORM, self.robot)
        payload = () if self.payloads is None else (_PAYLOAD_PORT,)
        return Block(
            kind=FORM,
            role="observer",
            runtime=f"{_PAYLOAD_RUNTIME if payload else _NONLINEAR_RUNTIME}({plant.runtime}:{len(plant.arrays)})",
            sample_time=self.sample_time,
            arrays=(*self._own_arrays(plant), *plant.arrays),
            inputs=inputs,
            outputs=(*outputs, *payload),
            parameters=tuple(
                Port(
                    name=name,
                    unit=unit,
                    start=value,
                    minimum=0.0,
                    description=meaning,
                    display_unit=self.robot.outputs.shown if unit == to_si(self.robot.outputs.unit)[1] else "",
                )
                for (name, unit), value, meaning in zip(
                    noise_units(FORM, self.robot), self.noise, _NOISE_DESCRIPTIONS, strict=True
                )
            ),
        )

    def _own_arrays(self, plant: Block) -> tuple[Matrix, ...]:
        robot, motors, period = self.robot, len(self.robot.motors.names), self.sample_time
        scaled = period / self._second
        least, most = self.payloads or (0.0, 0.0)
        setup = np.array([
            motors, len(robot.outputs.names), len(plant.outputs),
            max(1, round(_SETTLING_S / scaled)), self.start, _MOTION_MEMORY ** (scaled / _NOMINAL_PERIOD_S),
            self.timing / period, self._timing_kept,
            *(period * most for most in self.slew or (_NO_SLEW_LIMIT,) * motors),
        ])  # fmt: skip
        free = plant.initial_state(use_measurement=0.0).parameters
        load = np.array([least, most, _PAYLOAD_WALK * (most - least) * math.sqrt(scaled)])
        return setup, self.constants, free, load

    def estimate(self, recording: Recording) -> Estimates:
        """Filter a recording; each of its runs starts anew. Missing samples are predicted over.

        Raises:
            DataError: another sample time or another robot.
        """
        return filter_recording(self, recording, self._parts, self._align)

    def simulate(self, run: Recording) -> tuple[Matrix, Matrix, Vector]:
        """Return the model's simulation of a run, its motion in a sample (time, outputs), and that of late (time,).

        Raises:
            DataError: another sample time or another robot.
        """
        check_recording(self, run)
        _, states = run_filter(self, run)
        angles, motion, fastest = (states[:, self._parts[name]] for name in ("angles", "motion", "fastest"))
        return angles, motion, fastest[:, 0]

    @cached_property
    def _parts(self) -> dict[str, slice]:
        """Slices of the runtime's state by name."""
        return NonlinearState.parts(NonlinearArrays(self.block().arrays))

    @cached_property
    def _second(self) -> float:
        """A scaled second [s]."""
        return slowest_seconds(self.model) / TIME_CONSTANT

    @property
    def _timing_kept(self) -> float:
        """Part of the timing error that a sample keeps."""
        return math.exp(-self.sample_time / (_TIMING_MEMORY_S * self._second))

    @property
    def walk_start(self) -> Vector:
        """Variances at the start of disturbance and timing error [samples^2], and what a sample keeps of the latter."""
        return np.array([self.start**2, (self.timing / self.sample_time) ** 2, self._timing_kept])

    def _align(self, states: Matrix) -> tuple[Matrix, np.ndarray]:
        """Return the outputs (time, outputs) at the filter's time, and their covariance (time, outputs, outputs)."""
        angles, motion, slopes, told, P = (
            states[:, self._parts[name]] for name in ("angles", "motion", "slopes", "told", "P")
        )
        m, one = angles.shape[1], np.eye(angles.shape[1])
        P = P.reshape(-1, 2 * m + 1, 2 * m + 1)
        G = np.concatenate([np.tile(one, (len(P), 1, 1)), one * motion[:, None], slopes[:, :, None]], axis=2)
        return angles + told[:, :m] + motion * told[:, m:], G @ P @ G.transpose(0, 2, 1)

    def summary(self) -> str:
        """Return a text of some lines."""
        unit = self.robot.outputs.display_unit
        first, rest = (level / to_si(unit)[0] for level in self.noise[:2])
        lines = [
            f"nonlinear observer over {self.model.kind}, {self.sample_time * 1e3:g} ms, {self.order} order, "
            f"sensor {self.sensor}",
            "  simulation of the model, a random-walk disturbance of each output"
            + (f", and a timing error of {self.timing * 1e3:.3g} ms" if self.timing else ""),
            f"  noise: measurement {first:.3g} {unit}, disturbance {rest:.3g} {unit} a sample and "
            f"{self.noise[2]:.3g} times the model's motion",
            *gate_and_timing_lines(self.gate_level, self.constants, self.sample_time, self.delay_source),
        ]
        if self.slew is not None:
            si = to_si(self.robot.motors.unit)[1]
            lines.append(f"  set-points move the model by at most {min(self.slew):.3g} {si}/s, the drives' limit")
        if self.payloads is not None:
            least, most = self.payloads
            lines.append(f"  the payload, {least:g} to {most:g} kg, is estimated during large motions")
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the observer with its model to one `.npz` file."""
        model, arrays = embed_model(self.model)
        timing = {"timing": self.timing} if self.timing else {}
        slew = {} if self.slew is None else {"slew": list(self.slew)}
        own = {"start": self.start, **timing, **slew, "delay_source": self.delay_source}
        header = {**file_header(self), **own, "model": model}
        write_archive(path, header, {**arrays, "constants": self.constants}, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NonlinearObserver:
        """Return the observer that `save` wrote; `softneck.core.load` calls this."""
        constants = np.ascontiguousarray(arrays["constants"], dtype=np.float64)
        model = embedded_model(header["model"], arrays)
        if constants.size != KALMAN_MORE_LAGS + max(len(model.robot.outputs.names) - 2, 0):
            raise FileFormatError("its array `constants` has another length; design the observer again.")
        # Files of earlier versions have no slew limit and no timing error.
        slew = None if header.get("slew") is None else tuple(float(value) for value in header["slew"])
        own = {"start": float(header["start"]), "timing": float(header.get("timing", 0.0)), "slew": slew}
        return cls(model=model, constants=constants, **own, **fields_from_header(header, FORM))


def is_nonlinear(model: Any) -> bool:
    """Return whether `model` is an identified model without transfer functions."""
    return isinstance(model, Model) and model.kind not in LINEAR
