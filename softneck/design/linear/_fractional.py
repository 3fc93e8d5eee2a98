"""Fractional-order PI and PID: iso-damped gains, and a realisation that keeps a true integrator."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_positive, require_whole

if TYPE_CHECKING:
    import control


# Integration orders that are searched; the ends are 0 and 2, where the realisation would lose its integrator.
_ORDERS = np.linspace(0.05, 1.95, 96)
# Relative step of the slopes of phases: the error of a central difference is its square.
_STEP = 1e-4
# The band of the approximation: three decades to both sides of the crossover, 13 poles and zeros; from a tenth to
# five times the crossover the error stays below 0.5 %.
_DECADES = 3.0
_SECTIONS = 13


@dataclass(frozen=True, slots=True, kw_only=True)
class FractionalPid:
    """`C(s) = K (1 + Ki s^-lambda + Kd s^mu)`.

    Attributes:
        gain: K [rad/rad].
        integral: Ki [1/s^lambda].
        integral_order: lambda, in (0, 2).
        derivative: Kd [s^mu].
        derivative_order: mu, in (0, 1].
        crossover: around which it is realised [rad/s].
    """

    gain: float
    integral: float
    integral_order: float
    derivative: float = 0.0
    derivative_order: float = 1.0
    crossover: float = 4.0

    def response(self, frequency: Vector) -> np.ndarray:
        """Return the ideal complex response (m,) at `frequency` [rad/s]."""
        s = 1j * np.asarray(frequency)
        return self.gain * (1.0 + self.integral * s**-self.integral_order + self.derivative * s**self.derivative_order)

    def controller(self, dt: float, *, sections: int = _SECTIONS) -> control.StateSpace:
        """Return it in discrete time: s^-lambda is s^-1 times Oustaloup's s^(1 - lambda), with an exact integrator.

        The poles and zeros of the integral are mapped bilinearly, which costs no phase, those of a derivative as
        exp(s dt); gains are exact at the crossover (Oustaloup et al. 2000, IEEE TCAS-I 47:25).
        """
        import control

        require_positive("dt", dt, "s")
        require_whole("sections", sections, 1, 25)
        poles, residues, direct = _term(1.0 - self.integral_order, self.crossover, dt, sections, integrator=True)
        weights, D = self.integral * residues, 1.0 + self.integral * direct
        if self.derivative > 0.0:
            more, at, through = _term(self.derivative_order, self.crossover, dt, sections, integrator=False)
            poles, weights = np.concatenate([poles, more]), np.concatenate([weights, self.derivative * at])
            D += self.derivative * through
        n = poles.size
        return control.StateSpace(np.diag(poles), np.ones((n, 1)), self.gain * weights[None, :], [[self.gain * D]], dt)


def fopi(
    G: Any,
    *,
    crossover: float,
    phase_margin: float = math.radians(60.0),
    derivative: float = 0.0,
    derivative_order: float = 1.0,
) -> FractionalPid:
    """Return the fractional-order PI, or PID with the derivative given, that is iso-damped about G.

    The loop crosses 1 at `crossover` with `phase_margin`, and its phase is flat there: the overshoot stays while the
    gain changes (Monje, Chen, Vinagre, Xue and Feliu 2010, Fractional-order Systems and Controls, sec. 5.2).

    Args:
        G: scalar plant, discrete (dead time exact) or continuous, or anything with `response(frequency)`.
        crossover: [rad/s].
        phase_margin: [rad].
        derivative: Kd [s^mu], 0 for a PI.
        derivative_order: mu.

    Raises:
        SettingsError: no order in (0, 2) has a flat phase there.
    """
    require_positive("crossover", crossover, "rad/s")
    require_between("phase_margin", phase_margin, 0.1, 2.5, "rad")
    require_between("derivative", derivative, 0.0, 1e3)
    require_between("derivative_order", derivative_order, 0.05, 1.0)
    w = crossover * np.array([1.0 - _STEP, 1.0, 1.0 + _STEP])
    g = _response(G, w)
    flat = _FlatPhase(
        w=w,
        rest=1.0 + derivative * (1j * w) ** derivative_order,
        theta=phase_margin - math.pi - float(np.angle(g[1])),
        slope=-float(np.angle(g[2] / g[0])),
    )
    order = flat.order()
    if order is None:
        raise SettingsError(
            f"no integration order between 0 and 2 gives a flat phase at {crossover:.3g} rad/s with a phase margin of "
            f"{math.degrees(phase_margin):.3g} deg; lower the crossover, or change the phase margin (50 to 100 deg)."
        )
    return FractionalPid(
        gain=1.0 / float(np.abs(flat.response(order)[1] * g[1])),
        integral=flat.integral(order),
        integral_order=order,
        derivative=derivative,
        derivative_order=derivative_order,
        crossover=crossover,
    )


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class _FlatPhase:
    """C/K = rest + Ki s^-order about the crossover, Ki such that its phase there is theta.

    Attributes:
        w: below, at and above the crossover (3,) [rad/s].
        rest: what of C/K is without the integral (3,).
        theta: the phase that C is to have at the crossover [rad].
        slope: what its phase is to gain from the first to the last frequency [rad], so that the loop's is flat.
    """

    w: Vector
    rest: np.ndarray
    theta: float
    slope: float

    def integral(self, order: float) -> float:
        """Return Ki with which C has the phase theta at the crossover."""
        turned = np.exp(-1j * self.theta)
        at = (1j * float(self.w[1])) ** -order
        return -float(np.imag(self.rest[1] * turned)) / float(np.imag(at * turned))

    def response(self, order: float) -> np.ndarray:
        """Return C/K at the three frequencies (3,)."""
        return self.rest + self.integral(order) * (1j * self.w) ** -order

    def excess(self, order: float) -> float:
        """Return what its phase gains too much [rad]."""
        C = self.response(order)
        return float(np.angle(C[2] / C[0])) - self.slope

    def right(self, order: float) -> bool:
        """Return whether Ki is positive, and the phase is theta rather than theta + pi."""
        C = self.response(order)[1]
        return self.integral(order) > 0.0 and float(np.real(C * np.exp(-1j * self.theta))) > 0.0

    def order(self) -> float | None:
        """Return the least order at which the loop's phase is flat."""
        from scipy.optimize import brentq

        usable = [float(order) for order in _ORDERS if self.right(float(order))]
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


def _term(
    order: float, crossover: float, dt: float, sections: int, *, integrator: bool
) -> tuple[Vector, Vector, float]:
    """Return poles, residues (n,) and the direct gain of s^order, over s if `integrator`, in z."""
    low, span = crossover * 10.0**-_DECADES, 100.0**_DECADES
    k = np.arange(sections)
    corners = [low * span ** ((k + 0.5 + side * order) / sections) for side in (-0.5, 0.5)]
    # Bilinear, a derivative would have its largest gain where noise is, and ring: there corners map as exp(-a dt).
    zeros, poles = (
        (2.0 - dt * corner) / (2.0 + dt * corner) if integrator else np.exp(-dt * corner) for corner in corners
    )
    if abs(order) < 1e-9:
        zeros, poles = np.zeros(0), np.zeros(0)
    if integrator:
        # Tustin's z + 1 over z - 1: its phase is -90 deg at every frequency.
        zeros, poles = np.append(zeros, -1.0), np.append(poles, 1.0)
    z = np.exp(1j * crossover * dt)
    wanted = crossover**order / (crossover if integrator else 1.0)
    size = wanted / float(np.abs(np.prod(z - zeros) / np.prod(z - poles)))
    return poles, size * _residues(zeros, poles), size


def _residues(zeros: Vector, poles: Vector) -> Vector:
    """Return the residues of prod(z - zeros)/prod(z - poles) at its distinct poles."""
    above: Matrix = poles[:, None] - zeros[None, :]
    below = poles[:, None] - poles[None, :]
    np.fill_diagonal(below, 1.0)
    # Pairs of the same size first: products of many small numbers would lose digits.
    return np.prod(above / below, axis=1) if poles.size else np.zeros(0)
