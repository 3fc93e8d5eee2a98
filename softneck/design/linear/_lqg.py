"""LQG with integral action as a kind of controller: a Kalman filter with a load on the plant's input, and an LQR."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_positive

from ..plants._uncertain import UncertainAxis
from ._assembly import AxisController
from ._axis_loop import delayed_form
from ._axis_settings import AxisDesign, AxisSettings, scaled, slowest_time


@dataclass(frozen=True, slots=True, kw_only=True)
class LqgSettings(AxisSettings):
    """Linear quadratic Gaussian control of the exact-delay plant, whose input a random walk disturbs.

    The filter estimates that load and the controller takes it away, which is its integral action; its state is
    driven by what the motors were really told, which is its conditioning (Astrom and Wittenmark 1997, Computer-
    Controlled Systems, sec. 9.2 and 11.4).

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        load_rate: how fast the load is expected to wander against the noise [rad/s], the filter's speed; None for
            the largest whose loops keep `max_sensitivity` on all samples.
        control_weight: weight of the input against the angle, in units of the plant's static gain.
        input_noise: white noise on the input against that of the angle, in the same units.
    """

    KIND: ClassVar[str] = "lqg"

    load_rate: float | None = None
    control_weight: float = 0.1
    input_noise: float = 10.0

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        if self.load_rate is not None:
            require_positive("load_rate", self.load_rate, "rad/s")
        require_between("control_weight", self.control_weight, 1e-4, 1e4)
        require_between("input_noise", self.input_noise, 0.0, 1e4)

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        if self.load_rate is not None:
            return self._built(axis, self.load_rate)
        lag = slowest_time(axis.nominal) + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._built(axis, speed), axis, low=0.02 / lag, high=100.0 / lag, what="load_rate"
        )

    def _built(self, axis: UncertainAxis, rate: float) -> AxisDesign:
        from scipy.linalg import solve_discrete_are

        gain, dt = axis.nominal.static_gain, axis.sample_time
        A, B, C = delayed_form(scaled(axis.nominal, 1.0 / gain), self.extra_delay)
        try:
            X = solve_discrete_are(A, B[:, None], np.outer(C, C), np.array([[self.control_weight]]))
            M = _filter(A, B, C, (rate * dt) ** 2, self.input_noise**2)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise SettingsError(
                "the Riccati equations of the LQG design have no solution; raise `control_weight` or `input_noise`."
            ) from error
        F = B @ X @ A / (self.control_weight + B @ X @ B)
        return AxisDesign(_controller(A, B, C, F, M, gain), {"load_rate_rad_s": rate}, {"feedback": F.tolist()})


def _filter(A: Matrix, B: Vector, C: Vector, walk: float, noise: float) -> Vector:
    """Return the gain M (n + 1,) with which the filter corrects plant and load; the angle's noise has variance 1."""
    from scipy.linalg import solve_discrete_are

    n = A.shape[0]
    whole, out = _with_load(A, B), np.append(C, 0.0)
    Q = np.zeros((n + 1, n + 1))
    Q[:n, :n] = noise * np.outer(B, B)
    Q[n, n] = walk
    P = solve_discrete_are(whole.T, out[:, None], Q, np.eye(1))
    return P @ out / (1.0 + out @ P @ out)


def _with_load(A: Matrix, B: Vector) -> Matrix:
    return np.block([[A, B[:, None]], [np.zeros((1, A.shape[0])), np.ones((1, 1))]])


def _controller(A: Matrix, B: Vector, C: Vector, F: Vector, M: Vector, gain: float) -> AxisController:
    """Return `v = (N r - [F 1] xi_filtered)/gain`, `xi_filtered = xi + M (y - C xi)`, xi+ = Aa xi_filtered + Ba v.

    L = Ba: beyond the limits the filter goes on with what the motors were told.
    """
    n = A.shape[0]
    Aa, Ba, Ca = _with_load(A, B), np.append(B, 0.0)[:, None], np.append(C, 0.0)[None, :]
    Fa, M = np.append(F, 1.0)[None, :], M[:, None]
    # The state at rest under an input of 1: what the reference asks for.
    at_rest = np.linalg.solve(np.eye(n) - A, B)
    N = 1.0 + float(F @ at_rest)
    kept = np.eye(n + 1) - M @ Ca
    return AxisController(
        A=(Aa - Ba @ Fa) @ kept,
        Br=N * Ba,
        By=(Aa - Ba @ Fa) @ M,
        C=-Fa @ kept / gain,
        Dr=N / gain,
        Dy=float((-Fa @ M)[0, 0]) / gain,
        L=gain * Ba,
    )
