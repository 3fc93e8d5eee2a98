"""The fractional-order PI or PID as a kind of controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import Vector, require_between, require_positive, require_whole
from softneck.estimation import AxisPlant

from ..plants._uncertain import UncertainAxis
from ._axis_loop import error_feedback
from ._axis_settings import AxisDesign, AxisSettings
from ._fractional import fopi


@dataclass(frozen=True, slots=True, kw_only=True)
class FopiSettings(AxisSettings):
    """Fractional-order PI, `K (1 + Ki s^-lambda)`, iso-damped on the exact-delay plant; a PID with a derivative.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        crossover: [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        phase_margin: where the phase is flat [rad].
        derivative: Kd [s^mu]; 0 for a PI.
        derivative_order: mu.
        sections: poles of Oustaloup's approximation.
    """

    KIND: ClassVar[str] = "fopi"

    crossover: float | None = None
    phase_margin: float = math.radians(70.0)
    derivative: float = 0.0
    derivative_order: float = 0.8
    sections: int = 13

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.crossover is not None:
            require_positive("crossover", self.crossover, "rad/s")
        require_between("phase_margin", self.phase_margin, 0.1, 2.5, "rad")
        require_between("derivative", self.derivative, 0.0, 1e3)
        require_between("derivative_order", self.derivative_order, 0.05, 1.0)
        require_whole("sections", self.sections, 1, 25)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        if self.crossover is not None:
            return self._built(axis, self.crossover)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._built(axis, speed), axis, low=0.2 / lag, high=5.0 / lag, what="crossover"
        )

    def _built(self, axis: UncertainAxis, crossover: float) -> AxisDesign:
        found = fopi(
            _DelayedPlant(axis.nominal, self.extra_delay),
            crossover=crossover,
            phase_margin=self.phase_margin,
            derivative=self.derivative,
            derivative_order=self.derivative_order,
        )
        K = found.controller(axis.sample_time, sections=self.sections)
        gains = {
            "K": found.gain, "Ki": found.integral, "lambda": found.integral_order, "crossover_rad_s": crossover,
        }  # fmt: skip
        if self.derivative > 0.0:
            gains |= {"Kd": found.derivative, "mu": found.derivative_order}
        return AxisDesign(error_feedback(K), gains, {"band_error": _band_error(found.response, K, crossover)})


@dataclass(frozen=True, slots=True)
class _DelayedPlant:
    """A plant with the samples that the loop's order adds."""

    plant: AxisPlant
    extra_delay: int

    def response(self, frequency: Vector) -> Vector:
        """Return the response (m,) at `frequency` [rad/s]."""
        return self.plant.response(frequency, extra_delay=self.extra_delay)


def _band_error(ideal: Callable[[Vector], np.ndarray], realised: Any, crossover: float) -> float:
    """Return the largest relative error over a decade to both sides of the crossover, below half of Nyquist."""
    w = np.geomspace(0.1 * crossover, min(10.0 * crossover, 0.25 * math.pi / realised.dt), 100)
    at = np.asarray(realised(np.exp(1j * w * realised.dt)))
    return float(np.max(np.abs(at / ideal(w) - 1.0)))
