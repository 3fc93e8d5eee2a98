"""One axis of an identified linear model: a strictly proper part behind a pure delay."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from softneck.core import DataError, Matrix, ReprMixin, SettingsError, Vector
from softneck.identification import weights_of
from softneck.robot import TIME_CONSTANT, Robot

if TYPE_CHECKING:
    import control


AXES = ("pitch", "roll")


class HasTransferFunctions(Protocol):
    """Any linear model: an identified one, a family, or a `LinearNeck`; it may say its `robot`."""

    def tf(self, output: str, /) -> Any:
        """Return the discrete transfer function to an output from its redefined input: to "pitch" from theta_i."""
        ...


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LinearNeck(ReprMixin):
    """Two transfer functions of one's own as a model of the neck, dead time as poles at zero.

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
        second: how many seconds a scaled second is [s], by which frequencies and horizons are chosen; of the neck 1.
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
        """Of the main pole [s]."""
        poles, main = main_pole(self.numerator, self.denominator)
        return -self.sample_time / math.log(max(float(np.abs(poles[main])), 1e-9))

    def faster(self, pole: float) -> AxisPlant:
        """Return the same plant with its main pole moved to `pole` [1/s], gain and delay kept; itself if faster.

        A complex pair is left as it is, and so is a slower pole that the output hardly shows: moved away from the zero
        that hides it, it would multiply the gain of quick motions.
        """
        poles, main = main_pole(self.numerator, self.denominator)
        slow, moved = complex(poles[main]), float(np.exp(-pole * self.sample_time))
        # 1e-9: the same pole, but for the rounding of its root.
        if abs(slow.imag) > 0.0 or slow.real <= moved + 1e-9:
            return self
        a = float(slow.real)
        rest = np.real(np.poly(np.delete(poles, main)))
        numerator = self.numerator * (1.0 - moved) / (1.0 - a)
        return replace(self, numerator=numerator, denominator=np.convolve(rest, [1.0, -moved]))

    def remove_hidden_poles(self) -> AxisPlant:
        """Return the plant without the poles slower than its main one, each with the zero that hides it; gain kept.

        Itself where the main pole is the slowest, or where no zeros hide the others.
        """
        poles, main = main_pole(self.numerator, self.denominator)
        zeros = np.roots(self.numerator)
        if main == 0 or abs(poles[main].imag) > 0.0 or zeros.size < main:
            return self
        for pole in poles[:main]:
            zeros = np.delete(zeros, np.argmin(np.abs(zeros - pole)))
        numerator, denominator = np.atleast_1d(np.poly(zeros)), np.atleast_1d(np.poly(poles[main:]))
        if max(np.abs(numerator.imag).max(), np.abs(denominator.imag).max()) > 0.0:
            return self  # a pair of which one alone is hidden
        scale = self.static_gain * denominator.real.sum() / numerator.real.sum()
        return replace(self, numerator=scale * numerator.real, denominator=denominator.real)

    def with_min_delay(self, least: float) -> AxisPlant:
        """Return the same plant with a dead time of at least `least` [s], in whole samples."""
        return replace(self, delay=max(self.delay, round(least / self.sample_time)))

    def resampled(self, sample_time: float) -> AxisPlant:
        """Return the same plant, between whose samples the input is held, at a shorter `sample_time` [s].

        The augmented matrix [A B; 0 I] to the power of the ratio (Van Loan 1978); at the old instants both agree.

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
                f"the model has a pole at {poles.real.min():.3g}, which no plant has whose input is held: it cannot "
                f"be taken to {sample_time:g} s. Identify it at that sample time."
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
        """Return it as a `control.TransferFunction` with `extra_delay` samples more."""
        import control

        denominator = np.concatenate([self.denominator, np.zeros(self.delay + extra_delay)])
        return control.TransferFunction(self.numerator, denominator, self.sample_time)


def main_pole(numerator: Vector, denominator: Vector) -> tuple[np.ndarray, int]:
    """Return the poles of B/A, the slowest first, and which of them makes most of where a step ends.

    B(p)/(A'(p) (1 - p)) is the part of the pole p in the sum that is the static gain (Kailath 1980, sec. 2.2); of two
    that are nearly alike it is larger for the slower one.
    """
    poles = np.roots(denominator)
    poles = poles[np.argsort(-np.abs(poles), kind="stable")]
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.polyval(numerator, poles) / (np.polyval(np.polyder(denominator), poles) * (1.0 - poles))
    # A pole that is double to the last bit has no part of its own.
    return poles, int(np.argmax(np.nan_to_num(np.abs(part), nan=np.inf)))


def axis_plant(model: HasTransferFunctions, axis: str) -> AxisPlant:
    """Return `axis` ("pitch", "roll" or another robot's output) of a linear model, its dead time split off.

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
    _check(axis, numerator, denominator)
    poles_at_zero = denominator.size - np.trim_zeros(denominator, "b").size
    # One sample stays with B/A, so that it is strictly proper.
    delay = min(poles_at_zero, denominator.size - numerator.size - 1)
    A = denominator[: denominator.size - delay]
    B = np.concatenate([np.zeros(A.size - 1 - numerator.size), numerator])
    return AxisPlant(B / A[0], A / A[0], delay, float(dt), _second(model, B, A, float(dt)))


def robot_of(source: Any) -> Robot:
    """Return whose plant a linear model is; one that does not say is a neck's."""
    return getattr(source, "robot", Robot.preset())


def directions_of(source: Any) -> Matrix:
    """Return the weights (outputs, motors) of the motors in each axis: a family has its own, a model its findings'."""
    own, given = getattr(source, "directions", None), robot_of(source).weights()
    if own is not None:
        return np.asarray(own)
    return weights_of(source) if given is None else given


def _second(model: HasTransferFunctions, numerator: Vector, denominator: Vector, sample_time: float) -> float:
    """Return how many seconds a scaled second of a robot is, by its time constant or else by its main pole."""
    slow = AxisPlant(numerator, denominator, 0, sample_time).time_constant
    return (robot_of(model).time_constant_s or max(slow, sample_time)) / TIME_CONSTANT


def _check(axis: str, numerator: Vector, denominator: Vector) -> None:
    if not (np.isfinite(numerator).all() and np.isfinite(denominator).all()):
        raise DataError(f"the model's {axis} has coefficients that are not finite; identify it again.")
    if numerator.size == 0 or denominator.size <= numerator.size:
        raise DataError(f"the model's {axis} must be strictly proper and not zero; an input acts one sample later.")
    radius = float(np.abs(np.roots(denominator)).max())
    if radius >= 1.0:
        raise SettingsError(
            f"the model's {axis} is not stable (spectral radius {radius:.4f}); identify it on a longer recording."
        )
