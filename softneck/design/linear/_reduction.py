"""Balanced reduction of a controller, its integrators kept, with the loss stated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_whole
from softneck.estimation import AxisPlant

from ._assembly import AxisController
from ._axis_loop import axis_margins, conditioning_gain

if TYPE_CHECKING:
    import control


# Poles beyond this are kept as they are: integrators, which have no Gramian.
_BORDER = 1.0 - 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class ReducedController:
    """A system of fewer states.

    Attributes:
        system: with the names and dt of the original.
        singular_values: Hankel singular values of its stable part, falling.
        bound: largest gain of the error at any frequency, twice the sum of those left out (Glover 1984).
    """

    system: control.StateSpace
    singular_values: Vector
    bound: float


def reduce_controller(system: Any, order: int) -> ReducedController:
    """Return `system`, discrete, with `order` states: balanced truncation of all but its integrators.

    Raises:
        SettingsError: continuous, fewer states asked than it has integrators, or more than it has.
    """
    import control

    full: Any = control.ss(system)
    if not full.dt or full.dt is True:
        raise SettingsError("`reduce_controller` takes a discrete system with its dt in seconds.")
    require_whole("order", order, 0, full.nstates)
    A, B, C, values, bound = _truncated(np.asarray(full.A), np.asarray(full.B), np.asarray(full.C), order)
    reduced = control.StateSpace(
        A, B, C, full.D, full.dt, inputs=full.input_labels, outputs=full.output_labels, name=full.name
    )
    return ReducedController(reduced, values, bound)


def reduce_axis(
    axis: AxisController, plant: AxisPlant, extra_delay: int, order: int
) -> tuple[AxisController, dict[str, Any]]:
    """Return the axis with `order` states, and what that lost, in words of the loop."""
    A, B, C, values, bound = _truncated(axis.A, np.hstack([axis.Br, axis.By]), axis.C, order)
    Br, By = B[:, :1], B[:, 1:]
    reduced = AxisController(A=A, Br=Br, By=By, C=C, Dr=axis.Dr, Dy=axis.Dy, L=conditioning_gain(A, Br, C, axis.Dr))
    before = axis_margins(axis, plant, extra_delay).sensitivity
    after = axis_margins(reduced, plant, extra_delay).sensitivity
    return reduced, {
        "reduction": {
            "states_before": int(axis.A.shape[0]),
            "error_bound": bound,
            "hankel_singular_values": values.tolist(),
            "sensitivity_before": before,
            "sensitivity_after": after,
        }
    }


def _truncated(A: Matrix, B: Matrix, C: Matrix, order: int) -> tuple[Matrix, Matrix, Matrix, Vector, float]:
    """Return A, B, C of `order` states, the Hankel singular values of the stable part, and the error's bound."""
    from scipy.linalg import schur, solve_discrete_lyapunov, solve_sylvester

    split: Any = schur(A, output="real", sort=lambda x, y: np.hypot(x, y) < _BORDER)
    T, Z, stable = split
    n = A.shape[0]
    kept = n - stable
    if order < kept:
        raise SettingsError(
            f"`controller_order` {order} is less than the {kept} integrators that the controller keeps; ask for more."
        )
    B, C = Z.T @ B, C @ Z
    # Split: stable part first; X takes the coupling away.
    X = solve_sylvester(T[:stable, :stable], -T[stable:, stable:], -T[:stable, stable:])
    As, Bs, Cs = T[:stable, :stable], B[:stable] - X @ B[stable:], C[:, :stable]
    Au, Bu, Cu = T[stable:, stable:], B[stable:], C[:, stable:] + C[:, :stable] @ X
    P, Q = solve_discrete_lyapunov(As, Bs @ Bs.T), solve_discrete_lyapunov(As.T, Cs.T @ Cs)
    left, right = _root(P), _root(Q)
    U, values, Vh = np.linalg.svd(right.T @ left)
    r = min(order - kept, int(np.sum(values > 1e-12 * values.max(initial=0.0))))
    scale = 1.0 / np.sqrt(values[:r])
    W, V = right @ U[:, :r] * scale, left @ Vh[:r].T * scale
    zero = np.zeros((r, kept))
    reduced = np.block([[W.T @ As @ V, zero], [zero.T, Au]])
    return (
        reduced,
        np.vstack([W.T @ Bs, Bu]),
        np.hstack([Cs @ V, Cu]),
        values,
        2.0 * float(np.sum(values[r:])),
    )


def _root(P: Matrix) -> Matrix:
    """Return a square root of a Gramian, which rounding may have left slightly negative."""
    values, vectors = np.linalg.eigh(0.5 * (P + P.T))
    return vectors * np.sqrt(np.maximum(values, 0.0))
