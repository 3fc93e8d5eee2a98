"""The observer over a nonlinear model: its free run, and a disturbance that walks as far as the model moves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import FileFormatError, Matrix, ReprMixin, Vector, to_si, write_archive
from softneck.identification import KINDS as LINEAR
from softneck.identification import Model, nested, nested_model, payloads, without_validity
from softneck.robot import TIME_CONSTANT, Robot
from softneck.runtime import Block, Port, State
from softneck.signals import Recording

from ._axis import directions_of
from ._forms import NOISES, noise_units, require_levels
from ._kalman import filter_lines, header_of, observer_ports, of_header
from ._kalman_parts_runtime import KALMAN_LEAD, KALMAN_MORE_LAGS
from ._nonlinear_parts_runtime import NonlinearArrays
from ._nonlinear_runtime import NonlinearState
from ._offline import Estimates, check_recording, filter_recording, stepped
from ._payload_runtime import PayloadArrays, PayloadState
from ._scaling import slowest_seconds

_RUNTIME = "softneck.estimation._nonlinear_runtime"
# Over a model that takes the payload as a parameter.
_PAYLOAD_RUNTIME = "softneck.estimation._payload_runtime"
FORM = "nonlinear"
# In scaled seconds: until a model stands, and what `_PERIOD` leaves of the fastest motion: half of it after 0.27, as
# long as outputs are on their way.
_SETTLED, _KEEP, _PERIOD = 6.0, 0.95, 0.02
# A number that files and C know, beyond any set-point.
_UNLIMITED = 1e12
# How far the payload walks in a scaled second, as a part of the range that the model knows.
_PAYLOAD_WALK = 0.1
_PAYLOAD = Port(name="payload", unit="kg", description="estimated, within what the model's recordings had")
_MEANINGS = ("standard deviation", "standard deviation", "of the model's fastest motion of late")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class NonlinearObserver(ReprMixin):
    """A filter over an identified model of any kind; `KalmanSettings.design` makes it.

    The angle is what the model makes of the set-points in free run, plus a disturbance that walks: at rest by
    `rest_noise_std` in a sample, in motion by `motion_noise_ratio` times the model's fastest motion of late.

    Over a model of several payloads the payload is estimated as well: it walks by `_PAYLOAD_WALK` of their range in a
    second, and has an output of its own.

    Attributes:
        model: of any kind; nothing corrects its state.
        noise: standard deviations, named as `noise_names`, in SI.
        constants: see KALMAN_* of `_kalman_parts_runtime`.
        start: standard deviation of the disturbance when nothing is known, in SI.
        slew: (motors,) how fast set-points move the model at most, in SI a second; None: a jump is one to it.
        sensor: name of the preset, "none" where the noise was given, "robot" where the robot's file says it.
        order: of the loop it is for.
        gate_level: chi-square level of the gate.
        delay_source: where the sensor's delay comes from: "given", "sensor", "robot".
    """

    model: Model
    noise: tuple[float, float, float]
    constants: Vector
    start: float
    sensor: str
    order: str
    gate_level: float
    delay_source: str = "given"
    slew: tuple[float, ...] | None = None
    form: str = FORM

    @property
    def robot(self) -> Robot:
        """Whose outputs it estimates."""
        return self.model.robot

    @property
    def payloads(self) -> tuple[float, float] | None:
        """Least and most payload [kg] of the model's recordings; None where it knows but one."""
        return payloads(self.model.arrays)

    @property
    def sample_time(self) -> float:
        """Of the model and of the loop [s]."""
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
        """Return the same filter with other constants."""
        return replace(self, constants=constants)

    def with_noise(self, noise: Sequence[float], *, sensor: str = "none") -> NonlinearObserver:
        """Return the same filter with other noise levels."""
        levels = require_levels(FORM, self.robot, noise)
        return replace(self, noise=levels, sensor=sensor)

    def block(self) -> Block:
        """Return the filter as a block of role "observer"."""
        return self._block

    @cached_property
    def _block(self) -> Block:
        # How far it can be trusted is no part of an estimate, and takes time in each of its steps.
        plant = replace(self.model, arrays=without_validity(self.model.arrays)).block()
        inputs, outputs = observer_ports(FORM, self.robot)
        payload = () if self.payloads is None else (_PAYLOAD,)
        return Block(
            kind=FORM,
            role="observer",
            runtime=f"{_PAYLOAD_RUNTIME if payload else _RUNTIME}({plant.runtime}:{len(plant.arrays)})",
            sample_time=self.sample_time,
            arrays=(*self._own_arrays(plant), *plant.arrays),
            inputs=inputs,
            outputs=(*outputs, *payload),
            parameters=tuple(
                Port(name=name, unit=unit, start=value, minimum=0.0, description=meaning)
                for (name, unit), value, meaning in zip(
                    noise_units(FORM, self.robot), self.noise, _MEANINGS, strict=True
                )
            ),
        )

    def _own_arrays(self, plant: Block) -> tuple[Matrix, ...]:
        robot, motors, period = self.robot, len(self.robot.motors.names), self.sample_time
        scaled = period / (slowest_seconds(self.model) / TIME_CONSTANT)
        setup = np.array([
            motors, len(robot.outputs.names), len(plant.outputs),
            max(1, round(_SETTLED / scaled)), self.start, _KEEP ** (scaled / _PERIOD),
            *(period * most for most in self.slew or (_UNLIMITED,) * motors),
        ])  # fmt: skip
        arrays = (setup, self.constants, plant.initial_state(use_measurement=0.0).parameters)
        if self.payloads is None:
            return arrays
        least, most = self.payloads
        walk = _PAYLOAD_WALK * (most - least) * math.sqrt(scaled)
        return (*arrays, np.array([least, most, walk]))

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters are the noise levels by name."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now; inputs and outputs as in `block()`."""
        return self.block().step(state, inputs)

    def estimate(self, recording: Recording) -> Estimates:
        """Filter a recording; each of its runs starts anew. Missing samples are predicted over.

        Raises:
            DataError: another sample time or another robot.
        """
        parts = self._parts
        return filter_recording(
            self, recording, parts, lambda x: (x[:, parts["angles"]] + x[:, parts["disturbance"]], self._covariance(x))
        )

    def free_run(self, run: Recording) -> tuple[Matrix, Vector]:
        """Return what the model says of a run (time, outputs), and its fastest motion in a sample of late (time,).

        Raises:
            DataError: another sample time or another robot.
        """
        check_recording(self, run)
        _, states = self._rows(run)
        return states[:, self._parts["angles"]], states[:, self._parts["fastest"]][:, 0]

    @cached_property
    def _parts(self) -> dict[str, slice]:
        """Where the parts of the runtime's state are."""
        arrays = self.block().arrays
        if self.payloads is None:
            return NonlinearState.parts(NonlinearArrays(arrays))
        return PayloadState.parts(PayloadArrays(arrays))

    def _covariance(self, states: Matrix) -> Matrix:
        """Return that of the outputs at the filter's time (time, outputs, outputs)."""
        m = len(self.robot.outputs.names)
        if self.payloads is None:
            return np.eye(m) * states[:, self._parts["variance"], None]
        P = states[:, self._parts["P"]].reshape(-1, m + 1, m + 1)
        G = np.concatenate([np.tile(np.eye(m), (len(P), 1, 1)), states[:, self._parts["slopes"], None]], axis=2)
        return G @ P @ G.transpose(0, 2, 1)

    def _rows(self, run: Recording) -> tuple[Matrix, Matrix]:
        """Return outputs (time, outputs) and states (time, states) of a run."""
        return stepped(self, run)

    def summary(self) -> str:
        """Return some lines for people."""
        unit = self.robot.outputs.display_unit
        first, rest = (level / to_si(unit)[0] for level in self.noise[:2])
        lines = [
            f"nonlinear observer over {self.model.kind}, {self.sample_time * 1e3:g} ms, {self.order} order, "
            f"sensor {self.sensor}",
            "  the model in free run, and a disturbance of each output that walks",
            f"  noise: measurement {first:.3g} {unit}, disturbance {rest:.3g} {unit} a sample and "
            f"{self.noise[2]:.3g} times the model's motion",
            *filter_lines(self.gate_level, self.constants, self.sample_time, self.delay_source),
        ]
        if self.slew is not None:
            si = to_si(self.robot.motors.unit)[1]
            lines.append(
                f"  set-points move the model by {min(self.slew):.3g} {si}/s at most: drives take time over a jump"
            )
        if self.payloads is not None:
            least, most = self.payloads
            lines.append(f"  the payload, from {least:g} to {most:g} kg, is estimated: while the neck moves far")
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the observer with its model to one `.npz` file."""
        model, arrays = nested(self.model)
        header = {
            **header_of(self), "start": self.start, **({} if self.slew is None else {"slew": list(self.slew)}),
            "delay_source": self.delay_source, "model": model,
        }  # fmt: skip
        write_archive(path, header, {**arrays, "constants": self.constants}, force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> NonlinearObserver:
        """Return the observer that `save` wrote; `softneck.core.load` calls this."""
        constants = np.ascontiguousarray(arrays["constants"], dtype=np.float64)
        model = nested_model(header["model"], arrays)
        if constants.size != KALMAN_MORE_LAGS + max(len(model.robot.outputs.names) - 2, 0):
            raise FileFormatError("its array `constants` has another length; design the observer again.")
        # Files of earlier versions know no slew: set-points move the model as fast as they come.
        slew = None if header.get("slew") is None else tuple(float(value) for value in header["slew"])
        start = float(header["start"])
        return cls(model=model, constants=constants, start=start, slew=slew, **of_header(header, FORM))


def is_nonlinear(model: Any) -> bool:
    """Return whether `model` is identified and of a kind that has no transfer functions."""
    return isinstance(model, Model) and model.kind not in LINEAR
