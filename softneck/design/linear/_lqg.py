"""LQG with integral action as a kind of controller: a Kalman filter with a load on the plant's input, and an LQR."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from softneck.core import Matrix, SettingsError, require_between
from softneck.robot import Robot

from ..plants._coupled import AnyAxes, CoupledPlant, coupled_plant, realise, scale_gains
from ..plants._uncertain import UncertainAxis, default_uncertainty, scale_gain
from ._axis_loop import delayed_form
from ._controller import AxisController, LinearController
from ._multivariable import MultivariableDesign, bisect_speed, multivariable_controller
from ._settings import AxisDesign, AxisSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class LqgSettings(AxisSettings):
    """Linear quadratic Gaussian control of the exact-delay plant, whose input a random walk disturbs.

    The filter estimates that load and the controller takes it away, which is its integral action; its state is
    driven by what the motors were really told, which is its conditioning (Astrom and Wittenmark 1997, Computer-
    Controlled Systems, sec. 9.2 and 11.4).

    How fast the load is expected to wander, the filter's speed, is the largest whose loops keep `max_sensitivity` on
    all samples. A `control` system is taken with all that each motor does to each output: one filter, one regulator.

    Reference filter, order and conditioning, with limits and loop, are those of `AxisSettings`.

    Attributes:
        control_weight: weight of the input against the angle, in units of the plant's static gain.
        input_noise: white noise on the input against that of the angle, in the same units.
    """

    KIND: ClassVar[str] = "lqg"

    control_weight: float = 0.1
    input_noise: float = 10.0

    def __post_init__(self) -> None:
        AxisSettings.__post_init__(self)
        require_between("control_weight", self.control_weight, 1e-4, 1e4)
        require_between("input_noise", self.input_noise, 0.0, 1e4)

    def _design_plant(self, plant: Any, robot: Robot | None) -> LinearController:
        whole: Any = coupled_plant(plant, robot=robot)
        return (
            AxisSettings._design_plant(self, plant, robot)
            if whole is None
            else self.of_robot(whole)._design_coupled(whole)
        )

    def _design_coupled(self, plant: CoupledPlant) -> LinearController:
        uncertainty = default_uncertainty(plant.robot)
        nominal: AnyAxes = tuple(row.with_min_delay(uncertainty.least_delay) for row in plant.rows)
        spread = {1.0, 1.0 - uncertainty.gain_spread, 1.0 + uncertainty.gain_spread}
        own = tuple(row.with_min_delay(uncertainty.least_delay) for row in plant.own_rows)
        samples = [scale_gains(own, gain) for gain in sorted(spread, key=lambda gain: (gain != 1.0, gain))]
        lag = max(row.time_constant + row.delay * row.sample_time for row in nominal)

        def design_at(rate: float) -> MultivariableDesign:
            return MultivariableDesign(
                law=_rotate_law(plant.turn, self._law(nominal, rate)), samples=samples,
                redefinition=plant.own_redefinition, gains={"load_rate_rad_s": rate}, notes={},
            )  # fmt: skip

        def keeps(rate: float) -> bool:
            try:
                return design_at(rate).worst(self.extra_delay) <= self.max_sensitivity
            except SettingsError:
                return False

        rate = bisect_speed(keeps, 0.02 / lag, 100.0 / lag)
        if rate is None:
            raise SettingsError(
                f"not even a filter of {0.02 / lag:.3g} rad/s keeps Ms <= {self.max_sensitivity:g} on all "
                f"{len(samples)} samples; raise `max_sensitivity`."
            )
        made = design_at(rate)
        made.notes["worst_sensitivity"] = made.worst(self.extra_delay)
        return multivariable_controller(self, made, plant.robot, filtered=True)

    def _law(self, plants: AnyAxes, rate: float) -> tuple[Matrix, ...]:
        """Return A, Br, By, C, Dr, Dy and L; each output counts in its static gain."""
        gains = np.array([plant.static_gain for plant in plants])
        A, B, C = realise(plants, self.extra_delay)
        F, M = self._solve_riccati(A, B, C / gains[:, None], rate * plants[0].sample_time)
        A, Br, By, C, Dr, Dy, L = _law(A, B, C / gains[:, None], F, M)
        # The law is in outputs over their gains.
        return A, Br / gains, By / gains, C, Dr / gains, Dy / gains, L

    def _solve_riccati(self, A: Matrix, B: Matrix, C: Matrix, walk: float) -> tuple[Matrix, Matrix]:
        """Return F of the regulator and M of the filter for a load that walks by `walk` a sample."""
        from scipy.linalg import solve_discrete_are

        try:
            X = solve_discrete_are(A, B, C.T @ C, self.control_weight * np.eye(B.shape[1]))
            M = _kalman_gain(A, B, C, walk**2, self.input_noise**2)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise SettingsError(
                "the Riccati equations of the LQG design have no solution; raise `control_weight` or `input_noise`."
            ) from error
        return np.linalg.solve(self.control_weight * np.eye(B.shape[1]) + B.T @ X @ B, B.T @ X @ A), M

    def _synthesise(self, axis: UncertainAxis, name: str) -> AxisDesign:  # noqa: ARG002
        lag = axis.nominal.time_constant + axis.nominal.delay * axis.sample_time
        return self._fastest(
            lambda speed: self._design_at(axis, speed), axis, low=0.02 / lag, high=100.0 / lag, what="filter"
        )

    def _design_at(self, axis: UncertainAxis, rate: float) -> AxisDesign:
        gain, dt = axis.nominal.static_gain, axis.sample_time
        A, b, c = delayed_form(scale_gain(axis.nominal, 1.0 / gain), self.extra_delay)
        B, C = b[:, None], c[None, :]
        F, M = self._solve_riccati(A, B, C, rate * dt)
        A, Br, By, C, Dr, Dy, L = _law(A, B, C, F, M)
        # The law is for the plant over its gain.
        made = AxisController(A=A, Br=Br, By=By, C=C / gain, Dr=float(Dr[0, 0]) / gain, Dy=float(Dy[0, 0]) / gain,
                              L=gain * L)  # fmt: skip
        return AxisDesign(made, {"load_rate_rad_s": rate}, {"feedback": F[0].tolist()})


def _rotate_law(turn: Matrix, law: tuple[Matrix, ...]) -> tuple[Matrix, ...]:
    """Return a law in the redefined inputs that `turn` makes into those it was found in."""
    A, Br, By, C, Dr, Dy, L = law
    back = np.linalg.inv(turn)
    return A, Br, By, back @ C, back @ Dr, back @ Dy, L @ turn


def _kalman_gain(A: Matrix, B: Matrix, C: Matrix, walk: float, noise: float) -> Matrix:
    """Return the gain M (n + inputs, outputs) with which the filter corrects plant and loads.

    The noise of the outputs has variance 1.
    """
    from scipy.linalg import solve_discrete_are

    n, inputs = B.shape
    whole, out = _append_load(A, B), np.hstack([C, np.zeros((len(C), inputs))])
    Q = np.zeros((n + inputs, n + inputs))
    Q[:n, :n] = noise * B @ B.T
    Q[n:, n:] = walk * np.eye(inputs)
    P = solve_discrete_are(whole.T, out.T, Q, np.eye(len(C)))
    return np.linalg.solve(np.eye(len(C)) + out @ P @ out.T, out @ P).T


def _append_load(A: Matrix, B: Matrix) -> Matrix:
    n, inputs = B.shape
    return np.block([[A, B], [np.zeros((inputs, n)), np.eye(inputs)]])


def _law(A: Matrix, B: Matrix, C: Matrix, F: Matrix, M: Matrix) -> tuple[Matrix, ...]:
    """Return A, Br, By, C, Dr, Dy, L of `v = N r - [F 1] xi_filtered`.

    With xi_filtered = xi + M (y - C xi) and xi+ = Aa xi_filtered + Ba v. L = Ba: beyond the limits the filter goes on
    with what the motors were told.
    """
    n, inputs = B.shape
    Aa, Ba = _append_load(A, B), np.vstack([B, np.zeros((inputs, inputs))])
    Ca, Fa = np.hstack([C, np.zeros((len(C), inputs))]), np.hstack([F, np.eye(inputs)])
    # The states at rest under inputs of 1, and the inputs that bring the outputs to what is asked.
    at_rest = np.linalg.solve(np.eye(n) - A, B)
    N = (np.eye(inputs) + F @ at_rest) @ np.linalg.inv(C @ at_rest)
    kept = np.eye(n + inputs) - M @ Ca
    return (Aa - Ba @ Fa) @ kept, Ba @ N, (Aa - Ba @ Fa) @ M, -Fa @ kept, N, -Fa @ M, Ba
