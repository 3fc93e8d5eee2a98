"""One axis of an identified linear model, and the scaling of a robot whose file gives no ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from softneck.core import DataError, Matrix, ReprMixin, SettingsError, Vector, to_si
from softneck.identification import Model, weights_of
from softneck.robot import TIME_CONSTANT, Robot, Scaling

if TYPE_CHECKING:
    import control


AXES = ("pitch", "roll")


class HasTransferFunctions(Protocol):
    """Any linear model: an identified one, a family, or a `LinearNeck`; it may have a `robot`."""

    def tf(self, output: str, /) -> Any:
        """Return the discrete transfer function to an output from its redefined input: to "pitch" from theta_i."""
        ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LinearNeck(ReprMixin):
    """A neck model from two given transfer functions, with the dead time as poles at zero.

    Attributes:
        pitch: discrete `control.TransferFunction` from theta_i [rad] to pitch [rad] (Eq. 9).
        roll: the same from phi_i to roll (Eq. 10).
    """

    pitch: control.TransferFunction
    roll: control.TransferFunction

    def tf(self, output: str, /) -> control.TransferFunction:
        """Return the transfer function to `output`."""
        if output not in AXES:
            raise SettingsError(f"`output` must be pitch or roll; got {output!r}.")
        return self.pitch if output == "pitch" else self.roll


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class AxisPlant(ReprMixin):
    """`y(z) = z^-delay B(z)/A(z) u(z)` with deg B < deg A; monic A.

    Attributes:
        numerator: (n,) coefficients of B, highest power z^(n-1) first.
        denominator: (n + 1,) coefficients of A, the first is 1.
        delay: samples beyond the one that B/A has itself.
        sample_time: [s].
        second: length of a scaled second [s]; frequencies and horizons are chosen by it. 1 for the neck.
    """

    numerator: Vector
    denominator: Vector
    delay: int
    sample_time: float
    second: float = 1.0

    @property
    def order(self) -> int:
        """n, the number of states without the delay."""
        return self.numerator.size

    @property
    def static_gain(self) -> float:
        """Angle over input in steady state [rad/rad]."""
        return float(np.sum(self.numerator) / np.sum(self.denominator))

    def observable_form(self) -> tuple[Matrix, Vector, Vector]:
        """Return A (n, n), B (n,), C (n,) without the delay; the first state is the angle (Kailath 1980, sec. 2.1)."""
        n = self.order
        A = np.zeros((n, n))
        A[:, 0] = -self.denominator[1:]
        A[:-1, 1:] = np.eye(n - 1)
        C = np.zeros(n)
        C[0] = 1.0
        return A, self.numerator.copy(), C

    def response(self, frequency: Vector, *, extra_delay: int = 0) -> Vector:
        """Return the exact complex response (m,) at `frequency` [rad/s] with `extra_delay` samples more."""
        z = np.exp(1j * np.asarray(frequency) * self.sample_time)
        ratio = np.polyval(self.numerator, z) / np.polyval(self.denominator, z)
        return ratio * z ** (-(self.delay + extra_delay))

    @property
    def time_constant(self) -> float:
        """Time constant of the main pole [s]."""
        poles, main = main_pole(self.numerator, self.denominator)
        return -self.sample_time / math.log(max(float(np.abs(poles[main])), 1e-9))

    def with_faster_pole(self, pole: float) -> AxisPlant:
        """Return the plant with its main pole moved to `pole` [1/s], at the same gain and delay.

        The plant is returned unchanged if it is faster already or if the main pole is complex. Slower poles that a zero
        nearly cancels stay: without their zero they would multiply the gain at high frequency.
        """
        poles, main = main_pole(self.numerator, self.denominator)
        slow, moved = complex(poles[main]), float(np.exp(-pole * self.sample_time))
        # 1e-9: rounding of the root.
        if abs(slow.imag) > 0.0 or slow.real <= moved + 1e-9:
            return self
        a = float(slow.real)
        rest = np.real(np.poly(np.delete(poles, main)))
        numerator = self.numerator * (1.0 - moved) / (1.0 - a)
        return replace(self, numerator=numerator, denominator=np.convolve(rest, [1.0, -moved]))

    def remove_hidden_poles(self) -> AxisPlant:
        """Return the plant without the poles slower than its main one and the zeros nearest to them, at the same gain.

        The plant is returned unchanged if the main pole is the slowest, or if there are too few zeros.
        """
        poles, main = main_pole(self.numerator, self.denominator)
        zeros = np.roots(self.numerator)
        if main == 0 or abs(poles[main].imag) > 0.0 or zeros.size < main:
            return self
        for pole in poles[:main]:
            zeros = np.delete(zeros, np.argmin(np.abs(zeros - pole)))
        numerator, denominator = np.atleast_1d(np.poly(zeros)), np.atleast_1d(np.poly(poles[main:]))
        if max(np.abs(numerator.imag).max(), np.abs(denominator.imag).max()) > 0.0:
            return self  # only one pole of a complex pair would go
        scale = self.static_gain * denominator.real.sum() / numerator.real.sum()
        return replace(self, numerator=scale * numerator.real, denominator=denominator.real)

    def with_min_delay(self, minimum: float) -> AxisPlant:
        """Return the plant with a dead time of `minimum` [s] or more, in whole samples."""
        return replace(self, delay=max(self.delay, round(minimum / self.sample_time)))

    def resample(self, sample_time: float) -> AxisPlant:
        """Return the zero-order-hold plant at a shorter `sample_time` [s].

        It is the augmented matrix [A B; 0 I] to the power of the ratio (Van Loan 1978). Both agree at the old instants.

        Raises:
            SettingsError: the new sample time does not divide the old one, or a pole has no real root.
        """
        from scipy.linalg import fractional_matrix_power

        ratio = round(self.sample_time / sample_time)
        # 1e-6: sample times such as 0.02 / 2 are off by rounding only.
        if ratio < 1 or not math.isclose(ratio * sample_time, self.sample_time, rel_tol=1e-6):
            raise SettingsError(
                f"`sample_time` {sample_time:g} s must divide that of the model, {self.sample_time:g} s, as "
                f"{self.sample_time / 2:g} s does."
            )
        if ratio == 1:
            return self
        A, B, C = self.observable_form()
        poles = np.linalg.eigvals(A)
        if np.any((np.abs(poles.imag) < 1e-12) & (poles.real <= 1e-12)):
            raise SettingsError(
                f"the model has a pole at {poles.real.min():.3g}, which no plant with a held input has: it cannot "
                f"be resampled to {sample_time:g} s. Identify it at that sample time."
            )
        whole = np.block([[A, B[:, None]], [np.zeros((1, A.shape[0])), np.ones((1, 1))]])
        part = np.real(np.asarray(fractional_matrix_power(whole, 1.0 / ratio)))
        n = A.shape[0]
        Ad, Bd = part[:n, :n], part[:n, n]
        denominator = np.real(np.poly(Ad))
        # Markov parameters times the denominator give the numerator.
        markov = np.array([C @ np.linalg.matrix_power(Ad, i) @ Bd for i in range(n)])
        numerator = np.convolve(markov, denominator)[:n]
        return AxisPlant(numerator, denominator, self.delay * ratio, sample_time, self.second)

    def tf(self, *, extra_delay: int = 0) -> control.TransferFunction:
        """Return a `control.TransferFunction` with `extra_delay` samples more."""
        import control

        denominator = np.concatenate([self.denominator, np.zeros(self.delay + extra_delay)])
        return control.TransferFunction(self.numerator, denominator, self.sample_time)


def main_pole(numerator: Vector, denominator: Vector) -> tuple[np.ndarray, int]:
    """Return the poles of B/A, slowest first, and the index of the pole with the largest part in the static gain.

    The part of a pole p is B(p)/(A'(p) (1 - p)) (Kailath 1980, sec. 2.2).
    """
    poles = np.roots(denominator)
    poles = poles[np.argsort(-np.abs(poles), kind="stable")]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.polyval(numerator, poles) / (np.polyval(np.polyder(denominator), poles) * (1.0 - poles))
    # An exactly double pole has no part of its own.
    return poles, int(np.argmax(np.nan_to_num(np.abs(part), nan=np.inf)))


def axis_plant(model: HasTransferFunctions, axis: str) -> AxisPlant:
    """Return one output ("pitch", "roll" or another robot's) of a linear model, its dead time split off.

    Raises:
        SettingsError: the model is not linear, not discrete, or not stable.
        DataError: its transfer function is not strictly proper or not finite.
    """
    import control

    if not hasattr(model, "tf"):
        raise SettingsError(f"a linear model is needed, one with `tf`; got {type(model).__name__}. Identify `rls`.")
    system: Any = model.tf(axis)
    if not isinstance(system, control.TransferFunction) or system.ninputs != 1 or system.noutputs != 1:
        raise SettingsError(f"the model's `tf({axis!r})` must be a scalar control.TransferFunction; got {system!r}.")
    dt = system.dt
    if dt is None or isinstance(dt, bool) or not dt > 0:
        raise SettingsError(f"the model's {axis} must be discrete; its dt is {dt}. Use control.sample_system.")
    numerator = np.trim_zeros(np.asarray(system.num[0][0], dtype=np.float64), "f")
    denominator = np.trim_zeros(np.asarray(system.den[0][0], dtype=np.float64), "f")
    _require_stable(axis, numerator, denominator)
    poles_at_zero = denominator.size - np.trim_zeros(denominator, "b").size
    # One sample stays with B/A, so that it is strictly proper.
    delay = min(poles_at_zero, denominator.size - numerator.size - 1)
    A = denominator[: denominator.size - delay]
    B = np.concatenate([np.zeros(A.size - 1 - numerator.size), numerator])
    return AxisPlant(B / A[0], A / A[0], delay, float(dt), _seconds_per_scaled_second(model, B, A, float(dt)))


def robot_of(source: Any) -> Robot:
    """Return the robot of a linear model; the built-in neck if the model has none."""
    return getattr(source, "robot", Robot.preset())


def directions_of(source: Any) -> Matrix:
    """Return the weights (outputs, motors) of the motors in each output; a model has them in its findings."""
    own, given = getattr(source, "directions", None), robot_of(source).weights()
    if own is not None:
        return np.asarray(own)
    return weights_of(source) if given is None else given


def _seconds_per_scaled_second(
    model: HasTransferFunctions, numerator: Vector, denominator: Vector, sample_time: float
) -> float:
    """Return the length of a robot's scaled second [s], from its time constant or else from the main pole."""
    slow = AxisPlant(numerator, denominator, 0, sample_time).time_constant
    return (robot_of(model).time_constant_s or max(slow, sample_time)) / TIME_CONSTANT


def _require_stable(axis: str, numerator: Vector, denominator: Vector) -> None:
    if not (np.isfinite(numerator).all() and np.isfinite(denominator).all()):
        raise DataError(f"the model's {axis} has coefficients that are not finite; identify it again.")
    if numerator.size == 0 or denominator.size <= numerator.size:
        raise DataError(f"the model's {axis} must be strictly proper and not zero; an input acts one sample later.")
    radius = float(np.abs(np.roots(denominator)).max())
    if radius >= 1.0:
        raise SettingsError(
            f"the model's {axis} is not stable (spectral radius {radius:.4f}); identify it on a longer recording."
        )


# The neck's outputs span 46 deg; the static gain times the motors' full range is 63 deg.
SPAN_OF_STATIC_GAIN = 0.73
# Random motor levels that show the output range of a nonlinear model.
_RANDOM_LEVELS, _SAMPLES_PER_LEVEL = 60, 50


def plants_scaling(robot: Robot, plants: Sequence[Any], weights: Matrix, what: str) -> Scaling:
    """Return the scaling of a robot with a linear plant for each output; `weights` (outputs, motors).

    Ranges in the robot's file take precedence. SettingsError: it gives no range of its set-points.
    """
    seconds = max(max(plant.time_constant, plant.sample_time) for plant in plants)
    if robot.motors.nominal is not None:
        return Scaling.of(robot, time_constant=seconds)
    ends = np.array(motor_ends(robot, what))
    most = np.abs(weights) @ (0.5 * (ends[1] - ends[0]))
    spans = SPAN_OF_STATIC_GAIN * np.array([abs(plant.static_gain) for plant in plants]) * most
    return Scaling.of(robot, set_points=ends, outputs=np.array([-spans, spans]), time_constant=seconds)


def model_scaling(model: Model) -> Scaling:
    """Return the scaling of a model's robot from its training set-points and a simulation over them."""
    robot, seconds = model.robot, slowest_seconds(model)
    if robot.motors.nominal is not None:
        return Scaling.of(robot, time_constant=seconds)
    ports = model.block().inputs[: len(robot.motors.names)]
    ends = np.array([[getattr(port, end) for port in ports] for end in ("minimum", "maximum")], dtype=np.float64)
    return Scaling.of(robot, set_points=ends, outputs=_simulate_random_levels(model, ends), time_constant=seconds)


def slowest_seconds(model: Model) -> float:
    """Return the time constant of a model's robot [s], else the slowest one identified."""
    return model.robot.time_constant_s or max(model.findings.get("time_constants_s", [TIME_CONSTANT]))


def _simulate_random_levels(model: Model, ends: Matrix) -> Matrix:
    """Simulate random levels between `ends` (2, motors); return the outputs (time, outputs)."""
    block, motors = model.block(), ends.shape[1]
    rows = np.full((_RANDOM_LEVELS * _SAMPLES_PER_LEVEL, len(block.inputs)), np.nan)
    levels = np.random.default_rng(0).uniform(ends[0], ends[1], (_RANDOM_LEVELS, motors))
    rows[:, :motors] = np.repeat(levels, _SAMPLES_PER_LEVEL, axis=0)
    return block.run(block.initial_state(), rows)[1][:, : len(model.robot.outputs.names)]


def motor_ends(robot: Robot, what: str) -> tuple[Vector, Vector]:
    """Return the lowest and highest set-points (motors,) in SI; raise SettingsError if the robot gives none."""
    motors, factor = robot.motors, to_si(robot.motors.unit)[0]
    if motors.setpoint_min is None or motors.setpoint_max is None:
        ends = ["`motors.setpoint_min` and `setpoint_max`"]
        raise robot.error_without(ends, f"{what} needs to know how far its outputs go")
    return factor * np.array(motors.setpoint_min), factor * np.array(motors.setpoint_max)


# The paper's neck reaches 40 deg of those 63 deg.
REACH_OF_STATIC_GAIN = 0.64


def linear_reach(plants: Sequence[AxisPlant], robot: Robot, weights: Matrix) -> float:
    """Return the largest output [SI] that linear plants reach over the range of the motors."""
    low, high = motor_ends(robot, "an observer")
    most = np.abs(weights) @ (0.5 * (high - low))
    return max(REACH_OF_STATIC_GAIN * abs(plant.static_gain) * float(v) for plant, v in zip(plants, most, strict=True))
