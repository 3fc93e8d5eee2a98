"""H-infinity mixed sensitivity as a kind of controller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softneck.core import SettingsError, require_between, require_one_of, require_positive

from ..linear._axis_loop import error_feedback
from ..linear._axis_settings import AxisDesign, AxisSettings
from ..plants._uncertain import UncertainAxis
from ._synthesis import METHODS, Synthesis, mixsyn
from ._weights import makeweight, ucover

if TYPE_CHECKING:
    import control


# Gain of W1 at rest: its pole lies this far below the bandwidth and becomes an integrator afterwards.
_AT_REST = 1e4


@dataclass(frozen=True, slots=True, kw_only=True)
class HinfSettings(AxisSettings):
    """H-infinity mixed sensitivity `|W1 S; W2 K S; W3 T|` on the exact-delay plant, at 1.05 gamma.

    W1 asks for `|S|` below frequency/bandwidth and `peak`; W2 is a gain on the effort in units of the plant's static
    gain; W3, if `cover`, the smallest weight over the samples: `|W3 T| < 1` then proves them stable. The slow pole of
    the controller becomes a true integrator.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        bandwidth: where W1 falls to 1 [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        peak: what W1 allows `|S|` far up.
        control_weight: W2, dimensionless.
        cover: whether the samples' weight enters as W3.
        method: "slycot", "riccati" or "auto".
    """

    KIND: ClassVar[str] = "hinf"

    bandwidth: float | None = None
    peak: float = 1.3
    control_weight: float = 0.3
    cover: bool = False
    method: str = "auto"

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.bandwidth is not None:
            require_positive("bandwidth", self.bandwidth, "rad/s")
        require_between("peak", self.peak, 1.05, 10.0)
        require_between("control_weight", self.control_weight, 1e-3, 100.0)
        require_one_of("method", self.method, METHODS)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        W3 = self._uncertainty(axis)
        if self.bandwidth is not None:
            return self._built(axis, self.bandwidth, W3)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._built(axis, speed, W3), axis, low=0.05 / lag, high=5.0 / lag, what="bandwidth"
        )

    def _built(self, axis: UncertainAxis, bandwidth: float, W3: Any) -> AxisDesign:
        import control

        gain, dt = axis.nominal.static_gain, axis.sample_time
        G = axis.nominal.tf(extra_delay=self.extra_delay) / gain
        W1 = makeweight(_AT_REST, bandwidth, 1.0 / self.peak, dt=dt)
        found = mixsyn(G, W1, self.control_weight, W3, method=self.method)
        if W3 is not None:
            self._promise(found, G, W3, dt)
        K: Any = with_integrator(found.controller)
        return AxisDesign(
            error_feedback(control.StateSpace(K.A, K.B, K.C / gain, K.D / gain, dt)),
            {"bandwidth_rad_s": bandwidth},
            {"gamma": found.gamma, "achieved": found.achieved, "method": found.method},
        )

    def _uncertainty(self, axis: UncertainAxis) -> Any:
        if not self.cover:
            return None
        W3 = ucover(axis.samples, axis.nominal)
        at_rest = float(np.abs(W3(1.0)))
        if at_rest >= 1.0:
            raise SettingsError(
                f"infeasible weights: the samples' static gains spread by {100 * at_rest:.0f} % about the nominal one, "
                "and T is 1 at rest, so |W3 T| < 1 cannot be. Choose a nominal plant in their middle, leave samples "
                "out, or set `cover=false`: then every sample is verified on its own."
            )
        return W3

    def _promise(self, found: Synthesis, G: Any, W3: Any, dt: float) -> None:
        z = np.exp(1j * np.geomspace(1e-3, np.pi / dt, 400) * dt)
        loop = np.asarray(G(z)) * np.asarray(found.controller(z))
        size = float(np.max(np.abs(np.asarray(W3(z)) * loop / (1.0 + loop))))
        if size >= 1.0:
            raise SettingsError(
                f"|W3 T| reaches {size:.3g}: robust stability of what W3 covers is not proven. Lower `bandwidth`."
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
