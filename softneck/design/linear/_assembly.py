"""From one controller for each axis to the arrays of the linear controller's runtime."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisController:
    """`v = C x + Dr r + Dy y`, `x+ = A x + Br r + By y` of one axis, with the gain of its conditioning.

    Attributes:
        A: (n, n).
        Br, By: (n, 1) from reference and angle.
        C: (1, n).
        Dr, Dy: direct gains [rad/rad].
        L: (n, 1) gain on what the limits took away; None for Hanus' `Br / Dr`.
    """

    A: Matrix
    Br: Matrix
    By: Matrix
    C: Matrix
    Dr: float
    Dy: float
    L: Matrix | None = None

    def conditioning(self) -> Matrix:
        """Return L (n, 1).

        Raises:
            SettingsError: no direct gain from the reference and no L given, or an unstable conditioned state.
        """
        if self.L is None and self.Dr == 0.0:
            raise SettingsError("a controller without direct gain from the reference needs `L` for its conditioning.")
        L = self.Br / self.Dr if self.L is None else self.L
        radius = float(np.abs(np.linalg.eigvals(self.A - L @ self.C)).max(initial=0.0))
        if radius >= 1.0:
            raise SettingsError(
                f"the conditioned controller would be unstable at its limits (spectral radius {radius:.3f}); "
                "give another `L` or a controller whose zeros from the reference are stable."
            )
        return L


@dataclass(frozen=True, slots=True)
class ReferenceFilter:
    """`(1 + T1 s)/(1 + T2 s)` before the reference; what is asked now acts now.

    Attributes:
        time: T2 [s]; 0 for none.
        lead: T1 [s].
    """

    time: float
    lead: float = 0.0

    def pole(self, sample_time: float) -> float:
        """Return a of `rf+ = a rf + (1 - a) r`."""
        return math.exp(-sample_time / self.time) if self.time > 0.0 else 0.0

    @property
    def jump(self) -> float:
        """T1/T2, the part of a step that passes at once beside what the lag passes."""
        return self.lead / self.time if self.time > 0.0 else 0.0


def pi_axis(gain: float, integral_time: float, sample_time: float) -> AxisController:
    """Return `v = K (e + s)`, `s+ = s + Ts/Ti e` with e = r - y.

    Args:
        gain: K [rad/rad].
        integral_time: Ti [s].
        sample_time: Ts [s].
    """
    one = np.eye(1)
    rate = sample_time / integral_time
    return AxisController(A=one, Br=rate * one, By=-rate * one, C=gain * one, Dr=gain, Dy=-gain)


def assemble(
    axes: Sequence[AxisController],
    *,
    filters: Sequence[ReferenceFilter],
    redefinition: tuple[Matrix, Matrix],
    constants: Vector,
) -> tuple[Matrix, ...]:
    """Return the arrays of `LinearArrays`.

    Args:
        axes: controllers of all axes: of pitch and roll.
        filters: of the references of all axes and of co-contraction.
        redefinition: T (axes + 1, motors) and its inverse.
        constants: of the runtime, the sample time [s] first.
    """
    from scipy.linalg import block_diag

    A, Br, By, C, L = (
        np.asarray(block_diag(*parts), dtype=np.float64)
        for parts in (
            [axis.A for axis in axes],
            [axis.Br for axis in axes],
            [axis.By for axis in axes],
            [axis.C for axis in axes],
            [axis.conditioning() for axis in axes],
        )
    )
    Dr, Dy = np.diag([axis.Dr for axis in axes]), np.diag([axis.Dy for axis in axes])
    return assemble_whole((A, Br, By, C, Dr, Dy, L), filters=filters, redefinition=redefinition, constants=constants)


def assemble_whole(
    law: tuple[Matrix, ...],
    *,
    filters: Sequence[ReferenceFilter],
    redefinition: tuple[Matrix, Matrix],
    constants: Vector,
) -> tuple[Matrix, ...]:
    """Return the arrays of `LinearArrays` for one controller of all axes: A, Br, By, C, Dr, Dy and L.

    The rest is as in `assemble`.
    """
    A, Br, By, C, Dr, Dy, L = law
    sample_time = float(constants[0])
    a = np.array([item.pole(sample_time) for item in filters])
    # rf_k = x_k + d r_k with x = a (1 - jump) at rest under r = 1: without lead rf_k = a rf_k-1 + (1 - a) r_k.
    held = a * (1.0 - np.array([item.jump for item in filters]))
    Af, Bf, Cf, Df = np.diag(a), np.diag(held * (1.0 - a)), np.eye(a.size), np.diag(1.0 - held)
    align = _alignment(A, Br + By, C, Dr + Dy)
    # The filter's state at rest, where rf = r.
    rest = np.diag(held)
    return (Af, Bf, Cf, Df, A, Br, By, C, Dr, Dy, L, align, rest, *redefinition, constants)


def _alignment(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Matrix:
    """Return M (n, 2 axes) with x = M (y, v): the state nearest to rest under r = y that gives exactly v.

    x minimises |(I - A) x - B y| subject to C x = v - D y, by its Lagrange conditions.
    """
    n = A.shape[0]
    E = np.eye(n) - A
    top = np.hstack([E.T @ E, C.T])
    m = C.shape[0]
    bottom = np.hstack([C, np.zeros((m, m))])
    right = np.block([[E.T @ B, np.zeros((n, m))], [-D, np.eye(m)]])
    return np.linalg.lstsq(np.vstack([top, bottom]), right, rcond=None)[0][:n]
