"""H-infinity mixed sensitivity as a kind of controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softneck.core import SettingsError, require_between, require_positive

from ..linear._axis_loop import error_feedback
from ..linear._axis_settings import AxisDesign, AxisSettings
from ..plants._uncertain import UncertainAxis
from ._synthesis import mixsyn
from ._weights import makeweight

if TYPE_CHECKING:
    import control


# Gain of W1 at rest: its pole lies this far below the bandwidth and becomes an integrator afterwards.
_AT_REST = 1e4
# What W1 allows |S| far up: below it the bound on Ms, from 1.2 on, is what binds.
_PEAK = 1.3


@dataclass(frozen=True, slots=True, kw_only=True)
class HinfSettings(AxisSettings):
    """H-infinity mixed sensitivity `|W1 S; W2 K S; W3 T|` on the exact-delay plant, at 1.05 gamma.

    W1 asks for `|S|` below frequency/bandwidth and 1.3; W2 is a gain on the effort in units of the plant's static gain;
    T is verified on every sample instead of being weighed. The slow pole of the controller becomes a true integrator.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        bandwidth: where W1 falls to 1 [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        control_weight: W2, dimensionless.
    """

    KIND: ClassVar[str] = "hinf"

    bandwidth: float | None = None
    control_weight: float = 0.3

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.bandwidth is not None:
            require_positive("bandwidth", self.bandwidth, "rad/s")
        require_between("control_weight", self.control_weight, 1e-3, 100.0)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        if self.bandwidth is not None:
            return self._built(axis, self.bandwidth)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._built(axis, speed), axis, low=0.05 / lag, high=5.0 / lag, what="bandwidth"
        )

    def _built(self, axis: UncertainAxis, bandwidth: float) -> AxisDesign:
        import control

        gain, dt = axis.nominal.static_gain, axis.sample_time
        G = axis.nominal.tf(extra_delay=self.extra_delay) / gain
        W1 = makeweight(_AT_REST, bandwidth, 1.0 / _PEAK, dt=dt)
        found = mixsyn(G, W1, self.control_weight)
        K: Any = with_integrator(found.controller)
        return AxisDesign(
            error_feedback(control.StateSpace(K.A, K.B, K.C / gain, K.D / gain, dt)),
            {"bandwidth_rad_s": bandwidth},
            {"gamma": found.gamma, "achieved": found.achieved},
        )


def with_integrator(K: Any) -> control.StateSpace:
    """Return K with its slowest real pole moved to z = 1, its other modes untouched.

    W1's pole lies at a ten-thousandth of the bandwidth, and K inherits it; A + (1 - p) v w' moves only that mode.

    Raises:
        SettingsError: K has no pole near 1.
    """
    import control

    A = np.asarray(K.A, dtype=np.float64)
    values, vectors = np.linalg.eig(A)
    i = int(np.argmin(np.abs(values - 1.0)))
    p = values[i]
    if abs(p.imag) > 1e-12 or abs(p.real - 1.0) > 1e-2:
        raise SettingsError("the controller has no slow pole to become its integrator; give W1 a larger gain at rest.")
    v = np.real(vectors[:, i])
    w = np.real(np.linalg.inv(vectors)[i])
    w = w / float(w @ v)
    moved = A + (1.0 - p.real) * np.outer(v, w)
    return control.StateSpace(moved, K.B, K.C, K.D, K.dt, inputs=K.input_labels, outputs=K.output_labels)
