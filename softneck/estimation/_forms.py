"""The forms of the filter: its states, its inputs and its noise levels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.robot import Robot, Scaling

from ._axis import AxisPlant
from ._kalman_parts_runtime import KalmanArrays

FORMS = ("model", "gyro", "nonlinear")
# Name and unit of the standard deviations: measurement noise, then two process noises. The second of a nonlinear model
# is a ratio to its motion.
NOISES: dict[str, tuple[tuple[str, str], ...]] = {
    "model": (("measurement_noise_std", "rad"), ("model_noise_std", "rad"), ("disturbance_noise_std", "rad")),
    "gyro": (("measurement_noise_std", "rad"), ("gyro_noise_std", "rad/s"), ("bias_noise_std", "rad/s")),
    "nonlinear": (("measurement_noise_std", "rad"), ("rest_noise_std", "rad"), ("motion_noise_ratio", "")),
}
STATES = {"model": "model and disturbance", "gyro": "angle and gyro bias"}
#: Scaled standard deviations before the first measurement: of an output, as outputs reach some 40 deg (paper, section
#: 5), and of a rate, as outputs move by up to 0.8 deg in 20 ms.
NECK_REACH, RATE_STD = math.radians(40.0), math.radians(40.0)
# Scaled standard deviations of the bias of a gyro that was not zeroed (MPU-9250 data sheet: 5 deg/s), and of inputs.
_GYRO_BIAS, _HELD_INPUT = math.radians(5.0), 2.0


def noise_units(form: str, robot: Robot) -> tuple[tuple[str, str], ...]:
    """Return name and SI unit of the noise levels of a form for a robot's outputs."""
    unit = to_si(robot.outputs.unit)[1]
    return tuple((name, own.replace("rad", unit)) for name, own in NOISES[form])


def require_levels(form: str, robot: Robot, noise: Sequence[float]) -> tuple[float, float, float]:
    """Return the three noise levels of a form; raise SettingsError where one is not positive."""
    for (name, unit), value in zip(noise_units(form, robot), noise, strict=True):
        if not (math.isfinite(value) and value > 0.0):
            raise SettingsError(f"`{name}` must be positive{f' [{unit}]' if unit else ''}; got {value}.")
    return float(noise[0]), float(noise[1]), float(noise[2])


@dataclass(frozen=True, slots=True, eq=False)
class FilterMatrices:
    """Matrices of all axes together, as the runtime takes them.

    F (n, n) state over one sample; B (n, outputs); H (outputs, n); first_noise, second_noise (n, n) unit covariances;
    start (n, n) initial covariance; forced (n, n) added before a measurement that passes without the gate.
    """

    F: Matrix
    B: Matrix
    H: Matrix
    first_noise: Matrix
    second_noise: Matrix
    start: Matrix
    forced: Matrix

    def arrays(self, sources: Matrix, constants: Vector) -> tuple[Matrix, ...]:
        """Return the arrays in the order of `KalmanArrays`."""
        items = (self.F, self.B, self.H, self.first_noise, self.second_noise, self.start, self.forced)
        return (*items, sources, constants)


def model_form(plants: Sequence[AxisPlant], scaling: Scaling, input_units: Vector) -> FilterMatrices:
    """Return the matrices of the model's states and a random-walk output disturbance for each output."""
    from scipy.linalg import solve_discrete_lyapunov

    axes: list[tuple[Matrix, ...]] = []
    for plant, input_unit, output_unit in zip(plants, input_units.tolist(), scaling.output_unit.tolist(), strict=True):
        A, b, c = plant.observable_form()
        F = _block_diagonal(A, np.eye(1))
        QM, QW = np.zeros_like(F), np.zeros_like(F)
        QM[0, 0] = QW[-1, -1] = 1.0
        # The spread under a white input, scaled to the steady state under a constant input.
        spread = np.asarray(solve_discrete_lyapunov(A, np.outer(b, b)))
        spread *= (_HELD_INPUT * input_unit * plant.static_gain) ** 2 / spread[0, 0]
        P0 = _block_diagonal(0.5 * (spread + spread.T), (NECK_REACH * output_unit) ** 2 * np.eye(1))
        axes.append((F, np.append(b, 0.0)[:, None], np.append(c, 1.0)[None, :], QM, QW, P0, P0))
    return _join_axes(axes)


def gyro_form(sample_time: float, scaling: Scaling) -> FilterMatrices:
    """Return the matrices of angle and gyro bias: the angle is the integral of rate minus bias (Lefferts 1982)."""
    T, axes = sample_time, []
    for unit in scaling.output_unit.tolist():
        F = np.array([[1.0, -T], [0.0, 1.0]])
        P0 = np.diag([(NECK_REACH * unit) ** 2, (_GYRO_BIAS * unit / scaling.second) ** 2])
        # A measurement that passes without the gate moves the angle, not the bias.
        forced = np.diag([(NECK_REACH * unit) ** 2, 0.0])
        Q = np.diag([T * T, 0.0]), np.diag([0.0, 1.0])
        axes.append((F, np.array([[T], [0.0]]), np.array([[1.0, 0.0]]), *Q, P0, forced))
    return _join_axes(axes)


def _join_axes(axes: Sequence[tuple[Matrix, ...]]) -> FilterMatrices:
    return FilterMatrices(*(_block_diagonal(*(axis[i] for axis in axes)) for i in range(7)))


def _block_diagonal(*blocks: Matrix) -> Matrix:
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks), dtype=np.float64)


def system(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return F, H, Q and R of one sample."""
    p = KalmanArrays(arrays)
    measurement, first, second = noise
    return p.F, p.H, first**2 * p.first_noise + second**2 * p.second_noise, measurement**2 * np.eye(len(p.H))
