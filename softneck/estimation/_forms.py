"""The forms of the filter: what its states are, what drives them, which noises it has."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, to_si
from softneck.robot import Robot

from ._axis import AxisPlant
from ._kalman_parts_runtime import KalmanArrays

FORMS = ("model", "gyro", "nonlinear")
# Name and unit of the noise levels (standard deviations): of the measurement, then of the two process noises;
# a nonlinear model's second is a part of its motion.
NOISES: dict[str, tuple[tuple[str, str], ...]] = {
    "model": (("measurement_noise_std", "rad"), ("model_noise_std", "rad"), ("disturbance_noise_std", "rad")),
    "gyro": (("measurement_noise_std", "rad"), ("gyro_noise_std", "rad/s"), ("bias_noise_std", "rad/s")),
    "nonlinear": (("measurement_noise_std", "rad"), ("rest_noise_std", "rad"), ("motion_noise_ratio", "")),
}
STATES = {"model": "model and disturbance", "gyro": "angle and gyro bias"}


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


def system(arrays: tuple[Matrix, ...], noise: tuple[float, float, float]) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return F, H, Q and R of one sample."""
    p = KalmanArrays(arrays)
    measurement, first, second = noise
    return p.F, p.H, first**2 * p.first_noise + second**2 * p.second_noise, measurement**2 * np.eye(len(p.H))
