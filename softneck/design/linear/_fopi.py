"""The fractional-order PI: iso-damped gains, a realisation that keeps a true integrator, and the kind of controller."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_positive
from softneck.estimation import AxisPlant

from ..plants._uncertain import UncertainAxis
from ._axis_loop import error_feedback
from ._settings import AxisDesign, AxisSettings

if TYPE_CHECKING:
    import control


# Integration orders that are searched; the ends are 0 and 2, where the realisation would lose its integrator.
_ORDERS = np.linspace(0.05, 1.95, 96)
# Relative step of the slopes of phases: the error of a central difference is its square.
_PHASE_SLOPE_STEP = 1e-4
# The band of the approximation: three decades to both sides of the crossover, 13 poles and zeros; from a tenth to
# five times the crossover the error stays below 0.5 %.
_HALF_BAND_DECADES = 3.0
_POLE_COUNT = 13


@dataclass(frozen=True, slots=True, kw_only=True)
class FopiSettings(AxisSettings):
    """Fractional-order PI, `K (1 + Ki s^-lambda)`, iso-damped on the exact-delay plant.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        crossover: [rad/s]; None for the largest whose loops keep `max_sensitivity` on all samples.
        phase_margin: where the phase is flat [rad].
    """

    KIND: ClassVar[str] = "fopi"

    crossover: float | None = None
    phase_margin: float = math.radians(70.0)

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.crossover is not None:
            require_positive("crossover", self.crossover, "rad/s")
        require_between("phase_margin", self.phase_margin, 0.1, 2.5, "rad")

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        if self.crossover is not None:
            return self._design_at(axis, self.crossover)
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._design_at(axis, speed), axis, low=0.2 / lag, high=5.0 / lag, what="crossover"
        )

    def _design_at(self, axis: UncertainAxis, crossover: float) -> AxisDesign:
        plant = _DelayedPlant(axis.nominal, self.extra_delay)
        found = fopi(plant, crossover=crossover, phase_margin=self.phase_margin)
        K = found.controller(axis.sample_time)
        gains = {
            "K": found.gain, "Ki": found.integral, "lambda": found.integral_order, "crossover_rad_s": crossover,
        }  # fmt: skip
        return AxisDesign(error_feedback(K), gains, {"band_error": _band_error(found, K)})


@dataclass(frozen=True, slots=True)
class _DelayedPlant:
    """A plant with the samples that the loop's order adds."""

    plant: AxisPlant
    extra_delay: int

    def response(self, frequency: Vector) -> Vector:
        """Return the response (m,) at `frequency` [rad/s]."""
        return self.plant.response(frequency, extra_delay=self.extra_delay)


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionalPi:
    """`C(s) = K (1 + Ki s^-lambda)`.

    `gain`: K [rad/rad]. `integral`: Ki [1/s^lambda]. `integral_order`: lambda, in (0, 2). `crossover`: around which it
    is realised [rad/s].
    """

    gain: float
    integral: float
    integral_order: float
    crossover: float = 4.0

    def response(self, frequency: Vector) -> np.ndarray:
        """Return the ideal complex response (m,) at `frequency` [rad/s]."""
        return self.gain * (1.0 + self.integral * (1j * np.asarray(frequency)) ** -self.integral_order)

    def controller(self, dt: float) -> control.StateSpace:
        """Return it in discrete time: s^-lambda is s^-1 times Oustaloup's s^(1 - lambda), with an exact integrator.

        Poles and zeros are mapped bilinearly, which costs no phase; gains are exact at the crossover (Oustaloup et al.
        2000, IEEE TCAS-I 47:25).
        """
        import control

        require_positive("dt", dt, "s")
        order, crossover = 1.0 - self.integral_order, self.crossover
        low, span, k = crossover * 10.0**-_HALF_BAND_DECADES, 100.0**_HALF_BAND_DECADES, np.arange(_POLE_COUNT)
        corners = [low * span ** ((k + 0.5 + side * order) / _POLE_COUNT) for side in (-0.5, 0.5)]
        zeros, poles = ((2.0 - dt * corner) / (2.0 + dt * corner) for corner in corners)
        if abs(order) < 1e-9:
            zeros, poles = np.zeros(0), np.zeros(0)
        # Tustin's z + 1 over z - 1: its phase is -90 deg at every frequency.
        zeros, poles = np.append(zeros, -1.0), np.append(poles, 1.0)
        z = np.exp(1j * crossover * dt)
        size = crossover**order / crossover / float(np.abs(np.prod(z - zeros) / np.prod(z - poles)))
        weights, D = self.integral * (size * _residues(zeros, poles)), 1.0 + self.integral * size
        n = poles.size
        return control.StateSpace(np.diag(poles), np.ones((n, 1)), self.gain * weights[None, :], [[self.gain * D]], dt)


def fopi(G: Any, *, crossover: float, phase_margin: float = math.radians(60.0)) -> FractionalPi:
    """Return the fractional-order PI that is iso-damped about G.

    The loop crosses 1 at `crossover` with `phase_margin`, and its phase is flat there: the overshoot stays while the
    gain changes (Monje, Chen, Vinagre, Xue and Feliu 2010, Fractional-order Systems and Controls, sec. 5.2).

    Args:
        G: scalar plant, discrete (dead time exact) or continuous, or anything with `response(frequency)`.
        crossover: [rad/s].
        phase_margin: [rad].

    Raises:
        SettingsError: no order in (0, 2) has a flat phase there.
    """
    require_positive("crossover", crossover, "rad/s")
    require_between("phase_margin", phase_margin, 0.1, 2.5, "rad")
    w = crossover * np.array([1.0 - _PHASE_SLOPE_STEP, 1.0, 1.0 + _PHASE_SLOPE_STEP])
    g = _response(G, w)
    flat = _FlatPhase(w=w, theta=phase_margin - math.pi - float(np.angle(g[1])), slope=-float(np.angle(g[2] / g[0])))
    order = flat.order()
    if order is None:
        raise SettingsError(
            f"no integration order between 0 and 2 gives a flat phase at {crossover:.3g} rad/s with a phase margin of "
            f"{math.degrees(phase_margin):.3g} deg; lower the crossover, or change the phase margin (50 to 100 deg)."
        )
    return FractionalPi(
        gain=1.0 / float(np.abs(flat.response(order)[1] * g[1])),
        integral=flat.integral(order),
        integral_order=order,
        crossover=crossover,
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _FlatPhase:
    """C/K = 1 + Ki s^-order about the crossover, Ki such that its phase there is theta.

    `w`: below, at and above the crossover (3,) [rad/s]. `theta`: the phase that C is to have at the crossover [rad].
    `slope`: what its phase is to gain from the first to the last frequency [rad], so that the loop's is flat.
    """

    w: Vector
    theta: float
    slope: float

    def integral(self, order: float) -> float:
        """Return Ki with which C has the phase theta at the crossover."""
        turned = np.exp(-1j * self.theta)
        at = (1j * float(self.w[1])) ** -order
        return -float(np.imag(turned)) / float(np.imag(at * turned))

    def response(self, order: float) -> np.ndarray:
        """Return C/K at the three frequencies (3,)."""
        return 1.0 + self.integral(order) * (1j * self.w) ** -order

    def excess(self, order: float) -> float:
        """Return the excess of the phase [rad]."""
        C = self.response(order)
        return float(np.angle(C[2] / C[0])) - self.slope

    def is_feasible(self, order: float) -> bool:
        """Return whether Ki is positive, and the phase is theta rather than theta + pi."""
        C = self.response(order)[1]
        return self.integral(order) > 0.0 and float(np.real(C * np.exp(-1j * self.theta))) > 0.0

    def order(self) -> float | None:
        """Return the smallest order for which the loop's phase is flat at crossover."""
        from scipy.optimize import brentq

        usable = [float(order) for order in _ORDERS if self.is_feasible(float(order))]
        step = float(_ORDERS[1] - _ORDERS[0])
        for low, high in itertools.pairwise(usable):
            if high - low < 1.5 * step and self.excess(low) * self.excess(high) <= 0.0:
                root: Any = brentq(self.excess, low, high, xtol=1e-10)
                return float(root)
        return None


def _response(G: Any, w: Vector) -> Vector:
    import control

    if hasattr(G, "response") and not isinstance(G, control.StateSpace | control.TransferFunction):
        return np.asarray(G.response(w))
    if not isinstance(G, control.StateSpace | control.TransferFunction) or G.dt is None or G.dt is True:
        raise SettingsError("`fopi` needs a control.StateSpace or TransferFunction that says its dt.")
    return np.asarray(G(np.exp(1j * w * G.dt) if G.dt else 1j * w))


def _residues(zeros: Vector, poles: Vector) -> Vector:
    """Return the residues of prod(z - zeros)/prod(z - poles) at its distinct poles."""
    above: Matrix = poles[:, None] - zeros[None, :]
    below = poles[:, None] - poles[None, :]
    np.fill_diagonal(below, 1.0)
    # Pairs of the same size first: products of many small numbers would lose digits.
    return np.prod(above / below, axis=1)


def _band_error(ideal: FractionalPi, realised: Any) -> float:
    """Return the largest relative error over a decade to both sides of the crossover, below half of Nyquist."""
    at = ideal.crossover
    w = np.geomspace(0.1 * at, min(10.0 * at, 0.25 * math.pi / realised.dt), 100)
    return float(np.max(np.abs(np.asarray(realised(np.exp(1j * w * realised.dt))) / ideal.response(w) - 1.0)))
