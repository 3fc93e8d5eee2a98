"""Settings of the Kalman filter and how a linear model becomes one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag, solve_discrete_lyapunov
from scipy.stats import chi2

from softneck.core import Matrix, SettingsError, require_between, require_one_of, require_positive
from softneck.signals import TENDON_ANGLES, redefinition_matrix

from ._axis import AXES, AxisPlant, HasTransferFunctions, axis_plant
from ._kalman import KalmanObserver
from ._sensors import find_sensor

ORDERS = ("sequential", "jacobi")
# The neck reaches some 40 deg (paper, section 5): so far off may the first angle be.
_START_STD = math.radians(40.0)
# Set-points may stand anywhere in +-6 rad when a filter starts: a third of it as standard deviation.
_START_INPUT = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class KalmanSettings:
    """Kalman filter over an identified linear model with an output disturbance on each axis.

    The angle is what the model makes of the delayed set-points plus a disturbance that walks; the estimate is
    of the angle at the instant of the measurement. Measurement noise is white, and so is what the model's angle
    misses from one sample to the next.

    Attributes:
        sensor: preset of the measurement noise: "mpu9250", "3dm-gx5-10", "paper".
        measurement_noise_std: [rad]; None for that of the sensor.
        model_noise_std: of the model's angle, added each sample [rad].
        disturbance_noise_std: step of the disturbance's walk, each sample [rad].
        gate_level: part of good measurements that the gate lets pass, chi-square with 2 degrees of freedom.
        max_rejections: after so many in a row the next measurement is taken in by force.
        healthy_timeout: [s] without an accepted measurement until `healthy` goes false.
        order: of the loop it will run in; in "jacobi" the observer sees set-points one sample younger.
        tendon_angles: gamma_1..3 of Eq. 5 and 7 [rad].
    """

    sensor: str = "paper"
    measurement_noise_std: float | None = None
    # The neck moves by up to 0.8 deg in 20 ms, and a fit to large moves is some 20 % off in small ones.
    model_noise_std: float = math.radians(0.15)
    disturbance_noise_std: float = math.radians(0.02)
    gate_level: float = 0.9999
    max_rejections: int = 10
    healthy_timeout: float = 0.1
    order: str = "sequential"
    tendon_angles: tuple[float, float, float] = tuple(TENDON_ANGLES.tolist())

    def __post_init__(self) -> None:
        find_sensor(self.sensor)
        if self.measurement_noise_std is not None:
            _require_noise("measurement_noise_std", self.measurement_noise_std)
        _require_noise("model_noise_std", self.model_noise_std)
        _require_noise("disturbance_noise_std", self.disturbance_noise_std)
        require_between("gate_level", self.gate_level, 0.5, 1.0 - 1e-12)
        require_between("max_rejections", self.max_rejections, 0, 1_000_000)
        require_positive("healthy_timeout", self.healthy_timeout, "s")
        require_one_of("order", self.order, ORDERS)

    @property
    def noise_std(self) -> float:
        """The measurement noise that holds [rad]."""
        return find_sensor(self.sensor).noise_std if self.measurement_noise_std is None else self.measurement_noise_std

    def design(self, model: HasTransferFunctions) -> KalmanObserver:
        """Return the filter for `model`, anything with `tf("pitch")` and `tf("roll")`.

        Raises:
            SettingsError: a model that is not linear, discrete and stable, or axes of different sample times.
        """
        plants = [axis_plant(model, axis) for axis in AXES]
        times = [plant.sample_time for plant in plants]
        if not math.isclose(*times, rel_tol=1e-9):
            raise SettingsError(f"pitch and roll have different sample times, {times[0]:g} s and {times[1]:g} s.")
        axes = [_axis_matrices(plant) for plant in plants]
        F, QM, QW, P0 = (_diagonal(*(axis[i] for axis in axes)) for i in (0, 3, 4, 5))
        B, H = (_diagonal(*(axis[i] for axis in axes)) for i in (1, 2))
        late = self.order == "jacobi"
        timeout = math.ceil(self.healthy_timeout / times[0] - 1e-9)
        gate = float(chi2.ppf(self.gate_level, df=len(AXES)))
        constants = np.array([*(p.delay + late for p in plants), gate, self.max_rejections, timeout, times[0]])
        T = redefinition_matrix(np.array(self.tendon_angles))[:2]
        return KalmanObserver(
            sample_time=times[0],
            arrays=(F, B, H, QM, QW, P0, T, constants),
            noise=(self.noise_std, self.model_noise_std, self.disturbance_noise_std),
            sensor=self.sensor if self.measurement_noise_std is None else "none",
            order=self.order,
            gate_level=self.gate_level,
        )


def _axis_matrices(plant: AxisPlant) -> tuple[Matrix, ...]:
    """Return F, B, H, unit model noise, unit disturbance noise and P0 of one axis: model states, disturbance."""
    A, b, c = plant.observable_form()
    F = _diagonal(A, np.eye(1))
    B = np.append(b, 0.0)[:, None]
    H = np.append(c, 1.0)[None, :]
    QM, QW = np.zeros_like(F), np.zeros_like(F)
    QM[0, 0] = QW[-1, -1] = 1.0
    # The model's spread under a white input, scaled to what set-points of _START_INPUT held for long do.
    spread = np.asarray(solve_discrete_lyapunov(A, np.outer(b, b)))
    spread *= (_START_INPUT * plant.static_gain) ** 2 / spread[0, 0]
    return F, B, H, QM, QW, _diagonal(0.5 * (spread + spread.T), _START_STD**2 * np.eye(1))


def _diagonal(*blocks: Matrix) -> Matrix:
    return np.asarray(block_diag(*blocks), dtype=np.float64)


def _require_noise(name: str, value: float) -> None:
    require_positive(name, value, "rad")
    if value > math.pi:
        raise SettingsError(f"`{name}` is a standard deviation in rad; got {value:g}: degrees?")
