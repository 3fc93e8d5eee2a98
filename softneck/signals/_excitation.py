"""Excitation signals: the paper's and others; tests freeze their definitions by hashes.

Signals for other robots follow their directions (see `PullDirections`) and are scaled from the neck's range of
set-points, +-6 rad, to theirs. `prepare` applies limits of drives and winches, and ramps from rest and back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softneck.core import (
    Matrix,
    ReprMixin,
    SettingsError,
    Vector,
    require_between,
    require_one_of,
    require_whole,
    to_si,
)
from softneck.robot import MOTOR_RANGE, TIME_CONSTANT, Robot

from .recording._channels import NECK

#: Sample time of the paper's experiments [s].
SAMPLE_TIME = 0.02
# Table 2: columns are motors 1, 2, 3; phi_4 of motor 3 is 0.95 as printed, not 0.095. phi_1 and phi_2 are the tendon
# angles to two digits.
_EQ22_OMEGA = (1.0, 0.25, 1.5, 2.56, 1.75, 1.66, 4.0)
_PHI_1 = np.array([0.0, 2.09, 4.18])
_PHI_4 = np.array([0.095, 0.095, 0.95])
_PHI_3, _PHI_5, _PHI_6, _PHI_7 = 0.32, 0.09, 0.29, 0.67
# [s] Default length of each signal at the neck's time constant.
_DURATIONS = {"eq22": 200.0, "steps": 26.0, "sine": 30.0, "rotation": 30.0, "aprbs": 140.0, "multisine": 140.0,
              "mixed": 140.0}  # fmt: skip
# One day at 20 ms; 1 GB as text.
_MAX_ROWS = 4_320_000
# The paper defines the length of these tests.
_FIXED_LENGTH_SIGNALS = ("steps", "sine", "rotation")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Excitation(ReprMixin):
    """Motor set-points over time.

    Attributes:
        time: (time,) [s].
        set_points: (time, motors) in SI, of the neck (time, 3) [rad].
        sample_time: [s].
    """

    name: str
    time: Vector
    set_points: Matrix
    sample_time: float = SAMPLE_TIME


@dataclass(frozen=True, slots=True, eq=False)
class PullDirections:
    """Directions in which the motors pull; signals move the motors along them.

    `angles`: (motors,) tendon angles [rad]; evenly spaced if a robot gives none. `rows`: (outputs, motors) weights of
    the motors in each output, the largest 1 or -1. `inverse`: (motors, outputs + 1) motors that move each output, and
    all together.
    """

    angles: Vector
    rows: Matrix
    inverse: Matrix

    @classmethod
    def of(cls, robot: Robot) -> PullDirections:
        """Return the directions of a robot."""
        motors, outputs = len(robot.motors.names), len(robot.outputs.names)
        angles = np.radians(robot.directions.angles_for(robot.outputs.names) or np.arange(motors) * 360.0 / motors)
        weights = robot.weights()
        if weights is None:  # unknown directions: waves around the axis, one for each output
            weights = np.cos(
                np.outer(np.arange(outputs) // 2 + 1, angles) - np.pi / 2 * (np.arange(outputs) % 2)[:, None]
            )
        size = np.abs(weights).max(axis=1, keepdims=True)
        # Remove the rounding of cosines: -1/2 shall be exact.
        rows = np.round(weights / np.where(size > 1e-9, size, 1.0), 12)
        if robot.weights() is not None and motors == outputs + 1:
            return cls(angles, rows, robot.redefinition()[1])
        return cls(angles, rows, np.column_stack([2.0 / 3.0 * rows.T, np.ones(motors)]))


def signal_names() -> tuple[str, ...]:
    """Return the names of all signals."""
    return tuple(_DURATIONS)


def signal(name: str, *, duration: float | None = None, seed: int = 0, robot: Robot | None = None) -> Excitation:
    """Return the set-points of a named signal at the robot's sample time.

    Frequencies and durations scale with the robot's time constant, if it gives one.

    Args:
        name: eq22, steps, sine, rotation, aprbs, multisine or mixed.
        duration: [s]; the signal's own where None. Longer than its own only for those without a fixed length.
        seed: of aprbs, multisine and mixed.
        robot: whose motors move, within its range of set-points; None: the neck's.

    Raises:
        SettingsError: unknown name, a duration under a sample or beyond 4.3 million, or a robot without sample time.
    """
    require_one_of("signal", name, signal_names())
    robot = Robot.preset() if robot is None else robot
    pulls, Ts = PullDirections.of(robot), robot.require("sample_time_s", "a signal")
    second = (robot.time_constant_s or TIME_CONSTANT) / TIME_CONSTANT
    longest = second * (2.0 + 8.0 * pulls.angles.size if name == "steps" else _DURATIONS[name])
    length = longest if duration is None else duration
    require_between("duration", length, Ts, _MAX_ROWS * Ts, "s")
    if name in _FIXED_LENGTH_SIGNALS and length > longest:
        raise SettingsError(f"`{name}` is {longest:g} s long by definition; got a duration of {length:g} s.")
    time = np.arange(round(length / Ts)) * Ts
    t = time / second
    fixed = {"eq22": eq22, "steps": _make_steps, "sine": _make_sine, "rotation": _make_rotation}
    drawn = {"aprbs": _make_aprbs, "multisine": _make_multisine, "mixed": _make_mixed}
    P = fixed[name](t, pulls) if name in fixed else drawn[name](t, np.random.default_rng(seed), pulls)
    return Excitation(name, time, _in_range(P, robot), Ts)


def _in_range(P: Matrix, robot: Robot) -> Matrix:
    """Map set-points from the neck's range, -6 to 6 rad, to the robot's range in SI."""
    given, scale = (robot.motors.setpoint_min, robot.motors.setpoint_max), to_si(robot.motors.unit)[0]
    low, high = (
        side * MOTOR_RANGE if values is None else scale * np.array(values)
        for side, values in zip((-1.0, 1.0), given, strict=True)
    )
    if np.all(low == -MOTOR_RANGE) and np.all(high == MOTOR_RANGE):
        return P
    return np.clip(0.5 * (low + high) + 0.5 * (high - low) * P / MOTOR_RANGE, low, high)


def eq22(t: Vector, pulls: PullDirections) -> Matrix:
    """Return the identification signal of Eq. 22 with Table 2, (time, motors) [rad]; other robots spread phi_4."""
    w1, w2, w3, w4, w5, w6, w7 = _EQ22_OMEGA
    printed = pulls.angles.size == 3 and np.abs(pulls.angles - _PHI_1).max() < 0.01
    phi_1 = _PHI_1 if printed else pulls.angles
    # Opposite tendons with one phi_4 would mirror each other, and their sum would not be excited.
    phi_4 = _PHI_4 if printed else np.linspace(_PHI_4[0], _PHI_4[-1], phi_1.size)
    T = t[:, None]
    carrier = 0.6 * np.sin(2.0 * np.sin(w1 * T + phi_1) + np.cos(w1 * T + phi_1))
    envelope = (
        3.0
        + np.sin(w2 * T)
        + np.sin(w3 * T + _PHI_3)
        + np.sin(w1 * T - phi_4)
        + np.sin(w4 * T)
        + np.sin(w5 * T + _PHI_5)
        + np.sin(w6 * T + _PHI_6) * np.sin(w7 * T + _PHI_7) / 2.0
    )
    return carrier * np.abs(envelope)


def _make_steps(t: Vector, pulls: PullDirections) -> Matrix:
    """Return test 1: each motor at 3 rad for 8 s, in turn."""
    # Half a sample of tolerance: multiples of 20 ms are rounded.
    now = t + 0.5 * _sample_time(t)
    motors = range(pulls.angles.size)
    return np.column_stack([np.where((now >= 1 + 8 * j) & (now < 9 + 8 * j), 3.0, 0.0) for j in motors])


def _make_sine(t: Vector, pulls: PullDirections) -> Matrix:
    """Return test 2: 0.05 to 0.6 Hz over 30 s, in turn along each output (theta_i and phi_i of the neck)."""
    phase = 2.0 * np.pi * (0.05 * t + (0.6 - 0.05) / 30.0 * t**2 / 2.0)
    s = 2.6 * np.sin(phase)
    outputs = len(pulls.rows)
    part = np.minimum((t + 0.5 * _sample_time(t)) * outputs / 30.0, outputs - 1).astype(int)
    rows = pulls.rows[part]
    return np.where(rows == 0.0, 0.0, s[:, None] * rows)


def _make_rotation(t: Vector, pulls: PullDirections) -> Matrix:
    """Return test 3: the tilt rotates at 1.2 rad/s; its size rises over 3 s."""
    size = 2.8 * np.minimum(1.0, t / 3.0)
    return np.column_stack([size * np.cos(1.2 * t - angle) for angle in pulls.angles])


def _make_aprbs(t: Vector, rng: np.random.Generator, pulls: PullDirections) -> Matrix:
    """Return amplitude-modulated PRBS along each output and co-contraction; levels last 0.4 to 2.4 s."""
    inputs = np.column_stack([_random_levels(t, rng, size) for size in (*(4.0,) * len(pulls.rows), 0.8)])
    return np.clip(inputs @ pulls.inverse.T, -4.5, 4.5)


def _sample_time(t: Vector) -> float:
    return float(t[1] - t[0]) if t.size > 1 else SAMPLE_TIME


def _random_levels(t: Vector, rng: np.random.Generator, size: float) -> Vector:
    values = np.empty_like(t)
    start = 0
    while start < t.size:
        stop = start + max(1, round(rng.uniform(0.4, 2.4) / _sample_time(t)))
        values[start:stop] = rng.uniform(-size, size)
        start = stop
    return values


def _make_multisine(t: Vector, rng: np.random.Generator, pulls: PullDirections) -> Matrix:
    """Return a random-phase multisine up to 4 rad/s with the lowest crest factor of 200 draws per motor."""
    period = max(t.size, 1) * _sample_time(t)
    tones = 2.0 * np.pi / period * np.arange(1, max(2, int(4.0 * period / (2.0 * np.pi)) + 1))
    # 32 tones spread over the band are cheap to draw and keep the crest factor low.
    tones = tones[np.unique(np.linspace(0, tones.size - 1, 32).round().astype(int))]
    return np.column_stack([_low_crest(t, tones, rng) for _ in pulls.angles])


def _low_crest(t: Vector, tones: Vector, rng: np.random.Generator) -> Vector:
    angles = np.outer(t[::5], tones)
    draws = rng.uniform(0.0, 2.0 * np.pi, (200, tones.size)).T
    # cos(a + p) = cos a cos p - sin a sin p: two products for all draws.
    sums = np.cos(angles) @ np.cos(draws) - np.sin(angles) @ np.sin(draws)
    phases = draws[:, np.argmin(np.abs(sums).max(axis=0, initial=0.0))]
    s = np.cos(np.outer(t, tones) + phases).sum(axis=1)
    return 3.2 * s / np.abs(s).max(initial=1e-12)


def _make_mixed(t: Vector, rng: np.random.Generator, pulls: PullDirections) -> Matrix:
    """Return Eq. 22, aprbs, multisine, then single-tendon and co-contraction moves, in fixed shares."""
    edges = np.round(np.array([0.0, 0.34, 0.66, 0.88, 0.95, 1.0]) * t.size).astype(int)
    lengths, motors = np.diff(edges), pulls.angles.size
    local = [np.arange(n) * _sample_time(t) for n in lengths]
    parts = [eq22(local[0], pulls), _make_aprbs(local[1], rng, pulls), _make_multisine(local[2], rng, pulls)]
    parts += [
        _single_tendon(local[3], rng, motors),
        np.repeat(_random_levels(local[4], rng, 2.5)[:, None], motors, axis=1),
    ]
    return np.concatenate(parts)


def _single_tendon(t: Vector, rng: np.random.Generator, motors: int) -> Matrix:
    levels = _random_levels(t, rng, 3.5)
    motor = np.floor(t / 1.6).astype(int) % motors
    return np.where(motor[:, None] == np.arange(motors), levels[:, None], 0.0)


# The first period holds the transient; two more separate noise from nonlinear distortion.
_PERIOD_COUNT = 3
# Lines are spread evenly in log frequency; more lines would be weaker.
_LINE_COUNT = 60
_DRAW_COUNT = 100
# With fewer samples per cycle a zero-order hold leaves no power at that frequency.
_SAMPLES_PER_CYCLE = 4
# Amplitudes and phases (lines, directions).
_Phasors = NDArray[np.complexfloating[Any, Any]]


def multisine_experiments(
    *,
    amplitude: float = 1.0,
    band: tuple[float, float] = (0.5, 25.0),
    realisations: int = 4,
    seed: int = 0,
    robot: Robot = NECK,
) -> list[Excitation]:
    """Return experiments for `frequency_response`, which separates response, noise and nonlinear distortion.

    Each direction (theta_i and phi_i of the neck) gets the same lines with phases of its own. A realisation
    is one experiment for each direction, in which direction a is turned by 360 a e/q deg: the matrix of inputs is
    orthogonal at every line (Pintelon and Schoukens 2012, 2.7).

    Args:
        amplitude: largest value of any direction's input, in the motors' unit.
        band: lowest and highest frequency [rad/s]; a period is one cycle of the lowest.
        robot: whose directions and motors move, at its sample time.

    Raises:
        SettingsError: an empty band, one beyond a quarter of the sampling rate, or directions or a sample time that
            the robot does not give.
    """
    (low, high), sample_time = band, robot.require("sample_time_s", "a signal")
    require_between("amplitude", amplitude, 1e-6, 1e6, robot.motors.unit)
    require_whole("realisations", realisations, 1, 100)
    fastest = 2.0 * np.pi / (_SAMPLES_PER_CYCLE * sample_time)
    slowest = 2.0 * np.pi / (_MAX_ROWS * sample_time)
    if not slowest <= low < high <= fastest:
        raise SettingsError(
            f"`band` must rise within {slowest:.2g} to {fastest:.3g} rad/s, a quarter of the sampling "
            f"rate; got {low:g},{high:g}."
        )
    weights = robot.weights()
    if weights is None:
        raise SettingsError(
            f"robot {robot.label()} gives no directions to move; give `[directions]` as tendons or matrix."
        )
    rows = round(2.0 * np.pi / (low * sample_time))
    lines = np.arange(1, max(1, int(high / low + 1e-9)) + 1)
    chosen = np.unique(np.geomspace(1, lines[-1], _LINE_COUNT).round().astype(int))
    inputs = _realisations(weights.shape[0], realisations, chosen, np.random.default_rng(seed))
    waves = [_period(phasors, chosen, rows) for phasors in inputs]
    scale = to_si(robot.motors.unit)[0] * amplitude / max(float(np.abs(wave).max()) for wave in waves)
    to_motors = np.linalg.pinv(weights).T
    time = np.arange(_PERIOD_COUNT * rows) * sample_time
    return [
        Excitation("multisine", time, np.tile(scale * wave @ to_motors, (_PERIOD_COUNT, 1)), sample_time)
        for wave in waves
    ]


def _realisations(q: int, count: int, lines: np.ndarray, rng: np.random.Generator) -> list[_Phasors]:
    """Return phasors (lines, q) of all experiments, the q of each realisation in sequence."""
    found = []
    fine = 8 * int(lines[-1])
    for _ in range(count):
        # The draw with the smallest peak: more power within the same limits.
        drawn = (np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (lines.size, q))) for _ in range(_DRAW_COUNT))
        phases = min(drawn, key=lambda phasors: float(np.abs(_period(phasors, lines, fine)).max()))
        for e in range(q):
            found.append(phases * np.exp(2j * np.pi * e * np.arange(q) / q))
    return found


def _period(phasors: _Phasors, lines: np.ndarray, rows: int) -> Matrix:
    """Return one period (rows, q) of the sum of the lines."""
    spectrum = np.zeros((rows, phasors.shape[1]), dtype=complex)
    spectrum[lines] = phasors
    return rows * np.real(np.fft.ifft(spectrum, axis=0))


# Rounding of sums of steps of a few rad: smaller differences satisfy a limit.
_STEP_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class SetPointLimits:
    """Bounds on every motor's set-point; an infinite bound is none.

    Attributes:
        position: largest magnitude of a set-point [rad]; 6 in the paper (section 3.1).
        speed: largest change between samples, divided by the sample time [rad/s].
        slack: largest pay-out of a winch below rest [rad]: the magnitude of the lowest set-point. A tendon paid out
            beyond the neck's motion goes slack and may leave its winch.
    """

    position: float = 6.0
    speed: float = math.inf
    slack: float = math.inf

    def __post_init__(self) -> None:
        _require_bound("position", self.position, "rad", zero=False)
        _require_bound("speed", self.speed, "rad/s", zero=False)
        _require_bound("slack", self.slack, "rad", zero=True)

    @property
    def lowest(self) -> float:
        """Return the lowest set-point allowed [rad]."""
        return -min(self.position, self.slack)


@dataclass(frozen=True, slots=True, kw_only=True)
class Changes:
    """Shares of the samples (of all three motors, 0 to 1) that `prepare` changed, by rule.

    `ramp`: faded in or out. `position`: clipped at the largest magnitude. `slack`: clipped at the largest pay-out.
    `speed`: limited in speed.
    """

    ramp: float = 0.0
    position: float = 0.0
    slack: float = 0.0
    speed: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON values in %."""
        return {
            "ramped_pct": 100 * self.ramp,
            "position_clipped_pct": 100 * self.position,
            "slack_clipped_pct": 100 * self.slack,
            "rate_limited_pct": 100 * self.speed,
        }

    def __str__(self) -> str:
        shares = {"ramped": self.ramp, "clipped in position": self.position, "clipped in slack": self.slack,
                  "limited in speed": self.speed}  # fmt: skip
        # Two digits, and a hundred as one.
        parts = [f"{float(f'{100 * share:.2g}'):g} % {rule}" for rule, share in shares.items() if share > 0]
        return ", ".join(parts) or "unchanged"


def prepare(
    excitation: Excitation, limits: SetPointLimits | None = None, *, ramp_s: float = 0.0
) -> tuple[Excitation, Changes]:
    """Return an excitation within the limits, and the shares of changed samples; a pure function.

    In this order:

    1. *Ramp*: a signal that does not start at rest (P = 0) is multiplied by `(1 - cos(pi t / ramp_s)) / 2` over its
       first `ramp_s`; one that does not end at rest by the mirror image over its last.
    2. *Position and slack*: set-points are clipped to `[-min(position, slack), position]`.
    3. *Speed*: from the first sample on, each set-point moves towards the wanted one by at most `speed * T`
       (a slew-rate limiter). With a ramp the signal ends at rest, so set-points stay where they can return in time.

    Samples within the limits are unchanged; preparing twice changes nothing more.

    Args:
        ramp_s: time from and to rest [s]; 0 for no ramps.

    Raises:
        SettingsError: a ramp that is negative or longer than half of the signal.
    """
    wanted = np.asarray(excitation.set_points, dtype=np.float64)
    if wanted.size == 0:
        return excitation, Changes()
    ramped = _ramp(wanted, excitation.sample_time, ramp_s)
    clipped, P = ramped, ramped
    shares = {"ramp": float(np.mean(ramped != wanted))}
    if limits is not None:
        clipped = np.clip(ramped, limits.lowest, limits.position)
        shares |= {
            "position": float(np.mean(np.abs(ramped) > limits.position)),
            # The tighter of the two lower bounds counts.
            "slack": float(np.mean(ramped < -limits.slack)) if limits.slack < limits.position else 0.0,
        }
        if limits.slack < limits.position:
            shares["position"] = float(np.mean(ramped > limits.position))
        P = _slew(clipped, limits.speed * excitation.sample_time, to_rest=ramp_s > 0)
        shares["speed"] = float(np.mean(clipped != P))
    return replace(excitation, set_points=P), Changes(**shares)


def _ramp(P: Matrix, sample_time: float, ramp_s: float) -> Matrix:
    """Return set-points (time, 3) that start and end at rest."""
    if not (math.isfinite(ramp_s) and ramp_s >= 0.0):
        raise SettingsError(f"`ramp_s` must be 0 or positive [s]; got {ramp_s:g}.")
    rows = math.ceil(ramp_s / sample_time - 1e-9)
    if rows == 0 or not (P[0].any() or P[-1].any()):
        return P
    if 2 * rows > len(P):
        raise SettingsError(
            f"a ramp of {ramp_s:g} s in and out needs a signal of {2 * ramp_s:g} s; this one has "
            f"{len(P) * sample_time:g} s. Shorten the ramp or lengthen the signal."
        )
    rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(rows) / rows)
    ramped = P.copy()
    if P[0].any():
        ramped[:rows] *= rise[:, None]
    if P[-1].any():
        ramped[len(P) - rows :] *= rise[::-1, None]
    return ramped


def _slew(P: Matrix, step: float, *, to_rest: bool) -> Matrix:
    """Limit the change of set-points (time, 3) to `step` [rad] a sample; `to_rest` makes them end at rest."""
    limited = np.column_stack([_slew_one(P[:, j], step) for j in range(P.shape[1])])
    if not to_rest or not np.isfinite(step):
        return limited
    # Steps summed backwards from rest; the minimum and maximum of limited signals are limited too.
    reach = np.concatenate([np.cumsum(np.full(len(P) - 1, step))[::-1], [0.0]])[:, None]
    return np.clip(limited, -reach, reach)


def _slew_one(wanted: Vector, step: float) -> Vector:
    if wanted.size < 2 or np.abs(np.diff(wanted)).max() <= step + _STEP_ROUNDING:
        return wanted
    values = wanted.tolist()
    for k in range(1, len(values)):
        move = values[k] - values[k - 1]
        if abs(move) > step + _STEP_ROUNDING:
            values[k] = values[k - 1] + math.copysign(step, move)
    return np.array(values)


def _require_bound(name: str, value: float, unit: str, *, zero: bool) -> None:
    if math.isnan(value) or value < 0 or (value == 0 and not zero):
        rule = "0 or positive" if zero else "positive"
        raise SettingsError(f"`{name}` must be {rule} [{unit}]; got {value:g}.")
