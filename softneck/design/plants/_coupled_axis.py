"""One axis of a coupled plant, and what loops around all axes do, coupled or not."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Vector
from softneck.estimation import AxisPlant


@dataclass(frozen=True, slots=True, eq=False)
class CoupledAxis:
    """One output of a coupled plant: `x+ = A x + B v(k - delay)`, `y = x[0]`, v the redefined inputs of all axes.

    Attributes:
        A: (n, n).
        B: (n, outputs).
        axis: which of the redefined inputs is its own; at rest it answers to that alone.
        delay: samples beyond the one that A and B have themselves.
        sample_time: [s].
        second: how many seconds a scaled second is [s]; of the neck 1.
    """

    A: Matrix
    B: Matrix
    axis: int
    delay: int
    sample_time: float
    second: float = 1.0

    @property
    def order(self) -> int:
        """n, the number of states without the delay."""
        return self.A.shape[0]

    @property
    def denominator(self) -> Vector:
        """The characteristic polynomial (n + 1,) of A."""
        return np.real(np.poly(self.A))

    @property
    def static_gain(self) -> float:
        """Output over its own input in steady state."""
        return float(np.linalg.solve(np.eye(self.order) - self.A, self.B[:, self.axis])[0])

    @property
    def time_constant(self) -> float:
        """Of the slowest pole [s]."""
        radius = float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))
        return -self.sample_time / math.log(max(radius, 1e-9))

    def observable_form(self) -> tuple[Matrix, Vector, Vector]:
        """Return A (n, n), B (n,) of its own input, C (n,), as of a plant that is not coupled."""
        return self.A, self.B[:, self.axis], np.eye(self.order)[0]

    def response(self, frequency: Vector, *, extra_delay: int = 0) -> Matrix:
        """Return the exact complex response (m, outputs) at `frequency` [rad/s] with `extra_delay` samples more."""
        z = np.exp(1j * np.asarray(frequency) * self.sample_time)
        states = np.linalg.solve(z[:, None, None] * np.eye(self.order) - self.A, self.B.astype(complex))
        return states[:, 0, :] * z[:, None] ** (-(self.delay + extra_delay))

    def with_min_delay(self, least: float) -> CoupledAxis:
        """Return the same plant with a dead time of at least `least` [s], in whole samples."""
        return replace(self, delay=max(self.delay, round(least / self.sample_time)))

    def lag(self) -> AxisPlant:
        """Return the lag of its slowest pole and static gain, which weights are chosen for: zeros may be slower."""
        pole = float(np.abs(np.linalg.eigvals(self.A)).max(initial=0.0))
        gain = self.static_gain * (1.0 - pole)
        return AxisPlant(np.array([gain]), np.array([1.0, -pole]), self.delay, self.sample_time, self.second)

    def faster(self, pole: float) -> CoupledAxis:  # noqa: ARG002 - what is slow in it is no pole of one axis
        """Return itself."""
        return self


# What one output of a plant answers to: its own redefined input, or those of all.
AnyAxis = AxisPlant | CoupledAxis
AnyAxes = tuple[AnyAxis, ...]


def times(plants: AnyAxes, factor: float) -> AnyAxes:
    """Return all plants with their gains times `factor`."""
    return tuple(
        replace(plant, B=factor * plant.B)
        if isinstance(plant, CoupledAxis)
        else replace(plant, numerator=factor * plant.numerator)
        for plant in plants
    )


def inputs_of(plant: AnyAxis, axis: int, outputs: int) -> Matrix:
    """Return B (n, outputs) from the redefined inputs of all axes: of a plant of its own one column."""
    if isinstance(plant, CoupledAxis):
        return plant.B
    B = np.zeros((plant.order, outputs))
    B[:, axis] = plant.numerator
    return B


def realised(plants: AnyAxes, extra_delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B (states, outputs), C of all axes, inputs on their way as states."""
    from scipy.linalg import block_diag

    sides = [_behind(plant, inputs_of(plant, axis, len(plants)), extra_delay) for axis, plant in enumerate(plants)]
    A, C = (np.asarray(block_diag(*items)) for items in ([side[0] for side in sides], [side[2] for side in sides]))
    return A, np.vstack([side[1] for side in sides]), C


def _behind(plant: AnyAxis, B0: Matrix, extra_delay: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B, C (1, states) of one output behind a chain of samples of the inputs that act on it."""
    n, delay = plant.order, plant.delay + extra_delay
    acting = np.flatnonzero(np.abs(B0).max(axis=0) > 0.0)
    k = acting.size
    A = np.zeros((n + k * delay, n + k * delay))
    B = np.zeros((n + k * delay, B0.shape[1]))
    A[:n, :n] = plant.observable_form()[0]
    if delay == 0:
        B[:n] = B0
    else:
        # Newest first; the oldest acts.
        A[:n, n + k * (delay - 1) :] = B0[:, acting]
        A[n + k :, n : n + k * (delay - 1)] = np.eye(k * (delay - 1))
        B[n + np.arange(k), acting] = 1.0
    return A, B, np.concatenate([[1.0], np.zeros(n + k * delay - 1)])[None, :]


def responses(plants: AnyAxes, frequency: Vector, extra_delay: int) -> Matrix:
    """Return the responses (m, outputs, outputs) of all axes to the redefined inputs of all."""
    count = len(plants)
    G = np.zeros((len(frequency), count, count), dtype=complex)
    for axis, plant in enumerate(plants):
        row = plant.response(frequency, extra_delay=extra_delay)
        G[:, axis, axis if row.ndim == 1 else slice(None)] = row
    return G


def closed(
    parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int
) -> tuple[Matrix, Matrix, Matrix]:
    """Return A, B (from all references) and C (to all outputs) of the loop with its dead time in full.

    Args:
        parts: A, B, C, D of the controller, from references and outputs to redefined inputs.
        plants: of all axes.
        extra_delay: samples added to their delay.
    """
    A, B, C, D = parts
    m = len(plants)
    Ap, Bp, Cp = realised(plants, extra_delay)
    top = np.hstack([Ap + Bp @ D[:, m:] @ Cp, Bp @ C])
    bottom = np.hstack([B[:, m:] @ Cp, A])
    return (
        np.vstack([top, bottom]),
        np.vstack([Bp @ D[:, :m], B[:, :m]]),
        np.hstack([Cp, np.zeros((m, A.shape[0]))]),
    )


def radius(parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int) -> float:
    """Return the spectral radius of the loop."""
    return float(np.abs(np.linalg.eigvals(closed(parts, plants, extra_delay)[0])).max())


def sensitivity(
    parts: tuple[Matrix, Matrix, Matrix, Matrix], plants: AnyAxes, extra_delay: int, frequency: Vector
) -> float:
    """Return Ms: the largest singular value of (I - G C)^-1 at the outputs, over `frequency` [rad/s]."""
    A, B, C, D = parts
    m = len(plants)
    z = np.exp(1j * frequency * plants[0].sample_time)
    values, V = np.linalg.eig(A)
    if np.linalg.cond(V) < 1e8:
        left, right = C @ V, np.linalg.solve(V, B[:, m:].astype(complex))
        K = np.einsum("on,kn,ni->koi", left, 1.0 / (z[:, None] - values), right) + D[:, m:]
    else:
        eye = np.eye(A.shape[0])
        K = np.array([C @ np.linalg.solve(point * eye - A, B[:, m:]) + D[:, m:] for point in z])
    if all(isinstance(plant, AxisPlant) for plant in plants):
        own = np.array([plant.response(frequency, extra_delay=extra_delay) for plant in plants]).T
        loop = own[:, :, None] * K
    else:
        loop = responses(plants, frequency, extra_delay) @ K
    S = np.linalg.inv(np.eye(m) - loop)
    return float(np.linalg.norm(S, ord=2, axis=(1, 2)).max())
