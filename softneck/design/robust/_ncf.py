"""Loop shaping with normalised coprime factors as a kind of controller."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import SettingsError, require_positive

from ..linear._assembly import AxisController
from ..linear._axis_loop import conditioning_gain
from ..linear._axis_settings import AxisDesign, AxisSettings
from ..plants._uncertain import UncertainAxis
from ._bilinear import drawn_out, to_discrete
from ._synthesis import ncf_parts

# Below this margin a design is called fragile (Skogestad and Postlethwaite 2005, sec. 9.4.1: 0.25 to 0.3).
_LEAST_MARGIN = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class NcfSettings(AxisSettings):
    """Glover and McFarlane's loop shaping: `W = k (s + 1/Ti)/s`, then the most robust Ks about the shaped plant.

    The reference enters through Ks at rest, `v = W (Ks(0) r - Ks y)`, which overshoots less than the error alone
    (Skogestad and Postlethwaite 2005, sec. 9.4.3).

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        crossover: of the shaped plant [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        integral_time: Ti [s]; None for the plant's slowest time constant.
    """

    KIND: ClassVar[str] = "ncf"

    crossover: float | None = None
    integral_time: float | None = None

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        for name, unit in (("crossover", "rad/s"), ("integral_time", "s")):
            value = getattr(self, name)
            if value is not None:
                require_positive(name, value, unit)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        if self.crossover is not None:
            return self._built(axis, self.crossover)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._built(axis, speed), axis, low=0.05 / lag, high=5.0 / lag, what="crossover"
        )

    def _built(self, axis: UncertainAxis, crossover: float) -> AxisDesign:
        import control

        plant, dt = axis.nominal, axis.sample_time
        gain = plant.static_gain
        if crossover >= math.pi / dt:
            raise SettingsError(f"`crossover` must be below the Nyquist frequency {math.pi / dt:.4g} rad/s.")
        time = self.integral_time or plant.time_constant
        shape = control.TransferFunction([1.0, 1.0 / time], [1.0, 0.0])
        w = np.array([crossover])
        size = float(np.abs(plant.response(w) / gain * np.asarray(shape(1j * drawn_out(w, dt))))[0])
        found, W = ncf_parts(plant.tf(extra_delay=self.extra_delay) / gain, shape / size)
        if found.margin < _LEAST_MARGIN:
            raise SettingsError(
                f"a crossover of {crossover:.3g} rad/s leaves a stability margin of {found.margin:.2f}, below "
                f"{_LEAST_MARGIN:g}; lower `crossover`."
            )
        controller = _two_degrees(to_discrete(found.controller, dt), to_discrete(W, dt), gain)
        return AxisDesign(
            controller,
            {"crossover_rad_s": crossover, "Ti_s": time},
            {"gamma": found.gamma, "margin": found.margin},
        )


def _two_degrees(Ks: Any, W: Any, gain: float) -> AxisController:
    """Return `v = W/gain (Ks(1) r - Ks y)`, states of Ks first."""
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (Ks.A, Ks.B, Ks.C, Ks.D))
    Aw, Bw, Cw, Dw = (np.asarray(part, dtype=np.float64) for part in (W.A, W.B, W.C, W.D))
    Cw, Dw = Cw / gain, Dw / gain
    n, m = A.shape[0], Aw.shape[0]
    at_rest = float(np.real(np.asarray(Ks(1.0))))
    whole = np.block([[A, np.zeros((n, m))], [Bw @ C, Aw]])
    Br = np.vstack([np.zeros((n, 1)), at_rest * Bw])
    By = -np.vstack([B, Bw @ D])
    out = np.hstack([Dw @ C, Cw])
    Dr, Dy = float(Dw[0, 0]) * at_rest, -float((Dw @ D)[0, 0])
    return AxisController(A=whole, Br=Br, By=By, C=out, Dr=Dr, Dy=Dy, L=conditioning_gain(whole, Br, out, Dr))
