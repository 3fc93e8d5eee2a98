"""The forms of the filter: what its states are, what drives them, which noises it has; and its steady state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.robot import Robot

from ._axis import AxisPlant
from ._kalman_parts_runtime import KALMAN_DIVIDER, KalmanArrays

FORMS = ("model", "kinematic", "gyro", "nonlinear")
# Name and unit of the noise levels (standard deviations): of the measurement, then of the two process noises;
# a nonlinear model's second is a part of its motion.
NOISES: dict[str, tuple[tuple[str, str], ...]] = {
    "model": (("measurement_noise_std", "rad"), ("model_noise_std", "rad"), ("disturbance_noise_std", "rad")),
    "kinematic": (
        ("measurement_noise_std", "rad"),
        ("acceleration_noise_std", "rad/s^2"),
        ("angle_noise_std", "rad"),
    ),
    "gyro": (("measurement_noise_std", "rad"), ("gyro_noise_std", "rad/s"), ("bias_noise_std", "rad/s")),
    "nonlinear": (("measurement_noise_std", "rad"), ("rest_noise_std", "rad"), ("motion_noise_ratio", "")),
}
STATES = {"model": "model and disturbance", "kinematic": "angle and rate", "gyro": "angle and gyro bias"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Reach:
    """How far and how fast a robot's outputs go, in SI; the defaults are the neck's.

    Attributes:
        start: standard deviation of the first output when nothing is known; the neck reaches some 40 deg (paper,
            section 5).
        held: of an output that set-points hold which may stand anywhere; None: what 2 rad do, a third of the neck's
            range.
        rate: what the rate may be when nothing tells it [1/s]; the neck moves by up to 0.8 deg in 20 ms.
        bias: of a gyro that was not zeroed [1/s]; up to some deg/s (MPU-9250 data sheet: 5).
    """

    start: float = math.radians(40.0)
    held: float | None = None
    rate: float = math.radians(40.0)
    bias: float = math.radians(5.0)


_NECK = Reach()
_START_INPUT = 2.0


def noise_units(form: str, robot: Robot) -> tuple[tuple[str, str], ...]:
    """Return name and SI unit of the noise levels of a form for a robot's outputs."""
    unit = to_si(robot.outputs.unit)[1]
    return tuple((name, told.replace("rad", unit)) for name, told in NOISES[form])


def require_levels(form: str, robot: Robot, noise: Sequence[float]) -> tuple[float, float, float]:
    """Return the three noise levels of a form; raise SettingsError where one is not positive."""
    for (name, unit), value in zip(noise_units(form, robot), noise, strict=True):
        if not (math.isfinite(value) and value > 0.0):
            raise SettingsError(f"`{name}` must be positive{f' [{unit}]' if unit else ''}; got {value}.")
    return float(noise[0]), float(noise[1]), float(noise[2])


@dataclass(frozen=True, slots=True, eq=False)
class FilterMatrices:
    """Matrices of all axes together, as the runtime takes them.

    Attributes:
        F: (n, n) state over one sample.
        B: (n, outputs) of the inputs.
        H: (outputs, n) angles.
        first_noise, second_noise: (n, n) unit covariances of the process noises.
        start: (n, n) covariance when nothing is known.
        forced: (n, n) added before a measurement is taken in by force.
    """

    F: Matrix
    B: Matrix
    H: Matrix
    first_noise: Matrix
    second_noise: Matrix
    start: Matrix
    forced: Matrix

    def arrays(self, sources: Matrix, constants: Vector) -> tuple[Matrix, ...]:
        """Return what the runtime reads."""
        items = (self.F, self.B, self.H, self.first_noise, self.second_noise, self.start, self.forced)
        return (*items, sources, constants)


def model_form(plants: Sequence[AxisPlant], reach: Reach = _NECK) -> FilterMatrices:
    """Return model states and an output disturbance that walks, on each axis."""
    from scipy.linalg import solve_discrete_lyapunov

    axes: list[tuple[Matrix, ...]] = []
    for plant in plants:
        A, b, c = plant.observable_form()
        F = _diagonal(A, np.eye(1))
        QM, QW = np.zeros_like(F), np.zeros_like(F)
        QM[0, 0] = QW[-1, -1] = 1.0
        # The model's spread under a white input, scaled to what set-points of _START_INPUT held for long do.
        spread = np.asarray(solve_discrete_lyapunov(A, np.outer(b, b)))
        held = _START_INPUT * plant.static_gain if reach.held is None else reach.held
        spread *= held**2 / spread[0, 0]
        P0 = _diagonal(0.5 * (spread + spread.T), reach.start**2 * np.eye(1))
        axes.append((F, np.append(b, 0.0)[:, None], np.append(c, 1.0)[None, :], QM, QW, P0, P0))
    return _all(axes)


def kinematic_form(sample_time: float, outputs: int = 2, reach: Reach = _NECK) -> FilterMatrices:
    """Return angle and rate, driven by an acceleration constant over each sample (Bar-Shalom 2001, sec. 6.3.2)."""
    T = sample_time
    F = np.array([[1.0, T], [0.0, 1.0]])
    g = np.array([0.5 * T * T, T])
    P0 = np.diag([reach.start**2, reach.rate**2])
    axis = (F, np.zeros((2, 1)), np.array([[1.0, 0.0]]), np.outer(g, g), np.diag([1.0, 0.0]), P0, P0)
    return _all([axis] * outputs)


def gyro_form(sample_time: float, outputs: int = 2, reach: Reach = _NECK) -> FilterMatrices:
    """Return angle and gyro bias: the angle rises by what the gyro says minus its bias (Lefferts 1982)."""
    T = sample_time
    F = np.array([[1.0, -T], [0.0, 1.0]])
    P0 = np.diag([reach.start**2, reach.bias**2])
    # A measurement taken in by force moves the angle; the bias is none the worse for it.
    forced = np.diag([reach.start**2, 0.0])
    axis = (F, np.array([[T], [0.0]]), np.array([[1.0, 0.0]]), np.diag([T * T, 0.0]), np.diag([0.0, 1.0]), P0, forced)
    return _all([axis] * outputs)


def _all(axes: Sequence[tuple[Matrix, ...]]) -> FilterMatrices:
    return FilterMatrices(*(_diagonal(*(axis[i] for axis in axes)) for i in range(7)))


def _diagonal(*blocks: Matrix) -> Matrix:
    from scipy.linalg import block_diag

    return np.asarray(block_diag(*blocks), dtype=np.float64)


def steady_covariance(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> Matrix:
    """Return the covariance (n, n) before a measurement, when one came every sensor period for long.

    Over the m samples of a period the state goes by F^m, with the noise of all m (Anderson and Moore 1979, sec. 4.4).
    """
    from scipy.linalg import solve_discrete_are

    F, H, Q, R = system(arrays, noise)
    Fm, Qm = np.eye(F.shape[0]), np.zeros_like(Q)
    for _ in range(int(KalmanArrays(arrays).constants[KALMAN_DIVIDER])):
        Fm, Qm = F @ Fm, F @ Qm @ F.T + Q
    try:
        P = np.asarray(solve_discrete_are(Fm.T, H.T, Qm, R))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SettingsError(f"these noise levels have no steady filter ({error}); give each process noise.") from error
    # The solver works to some 1e-10 of its largest number; what it left the recursion takes away.
    for _ in range(50):
        K, _ = gain(P, H, R)
        J = np.eye(len(P)) - K @ H
        P = Fm @ (J @ P @ J.T + K @ R @ K.T) @ Fm.T + Qm
    return 0.5 * (P + P.T)


def steady_gains(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, ...]:
    """Return gain and inverse innovation covariance in steady state, at the start and by force: six matrices."""
    P, p, R = steady_covariance(arrays, noise), KalmanArrays(arrays), system(arrays, noise)[3]
    pairs = (gain(P, p.H, R), gain(P + p.P0, p.H, R), gain(P + p.PF, p.H, R))
    return tuple(np.ascontiguousarray(matrix) for pair in pairs for matrix in pair)


def gain(P: Matrix, H: Matrix, R: Matrix) -> tuple[Matrix, Matrix]:
    """Return K = P H' S^-1 (n, outputs) and S^-1 (outputs, outputs)."""
    SI = np.linalg.inv(H @ P @ H.T + R)
    return P @ H.T @ SI, SI


def system(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return F, H, Q and R of one sample."""
    p = KalmanArrays(arrays)
    measurement, first, second = noise
    return p.F, p.H, first**2 * p.first_noise + second**2 * p.second_noise, measurement**2 * np.eye(len(p.H))
