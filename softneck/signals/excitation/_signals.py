"""The paper's signals and the excitations beside them; their definitions are frozen by hashes in the tests.

Other robots get them by where their motors pull (see `Pulls`), mapped from the neck's range of set-points, +-6 rad,
onto theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
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

from ..recording._channels import NECK

#: Sample time of the paper's experiments [s].
SAMPLE_TIME = 0.02
# Table 2: columns are motors 1, 2, 3; phi_4 of motor 3 is 0.95 as printed, not 0.095. phi_1 and phi_2 are the tendons'
# angles, to two digits.
_OMEGA = (1.0, 0.25, 1.5, 2.56, 1.75, 1.66, 4.0)
_PHI_1 = np.array([0.0, 2.09, 4.18])
_PHI_4 = np.array([0.095, 0.095, 0.95])
_PHI_3, _PHI_5, _PHI_6, _PHI_7 = 0.32, 0.09, 0.29, 0.67
# [s] of each signal when no other length is asked for, at the neck's pace.
_DURATIONS = {"eq22": 200.0, "steps": 26.0, "sine": 30.0, "rotation": 30.0, "aprbs": 140.0, "multisine": 140.0,
              "mixed": 140.0}  # fmt: skip
# A day at 20 ms: 1 GB as text.
_MOST_ROWS = 4_320_000
# Fixed by definition: these tests have one length.
_FIXED = ("steps", "sine", "rotation")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Excitation(ReprMixin):
    """Motor set-points over time.

    Attributes:
        name: of the signal.
        time: (time,) [s].
        set_points: (time, motors) in SI, of the neck (time, 3) [rad].
        sample_time: [s].
    """

    name: str
    time: Vector
    set_points: Matrix
    sample_time: float = SAMPLE_TIME


@dataclass(frozen=True, slots=True, eq=False)
class Pulls:
    """Where the motors pull, by which signals move them together.

    Attributes:
        angles: (motors,) tendon angles [rad]; evenly around where a robot gives none.
        rows: (outputs, motors) weights of the motors in each output, the largest 1 or -1.
        inverse: (motors, outputs + 1) motors that move each output, and all together.
    """

    angles: Vector
    rows: Matrix
    inverse: Matrix

    @classmethod
    def of(cls, robot: Robot) -> Pulls:
        """Return those of a robot."""
        motors, outputs = len(robot.motors.names), len(robot.outputs.names)
        angles = np.radians(robot.directions.angles_deg or np.arange(motors) * 360.0 / motors)
        weights = robot.weights()
        if weights is None:  # nobody knows yet: waves that run around, one for each output
            weights = np.cos(
                np.outer(np.arange(outputs) // 2 + 1, angles) - np.pi / 2 * (np.arange(outputs) % 2)[:, None]
            )
        size = np.abs(weights).max(axis=1, keepdims=True)
        # Rounded: -1/2 is -1/2, not the nearest that a cosine comes to.
        rows = np.round(weights / np.where(size > 1e-9, size, 1.0), 12)
        if robot.weights() is not None and motors == outputs + 1:
            return cls(angles, rows, robot.redefinition()[1])
        return cls(angles, rows, np.column_stack([2.0 / 3.0 * rows.T, np.ones(motors)]))


def signal_names() -> tuple[str, ...]:
    """Return the names of all signals."""
    return tuple(_DURATIONS)


def signal(name: str, *, duration: float | None = None, seed: int = 0, robot: Robot | None = None) -> Excitation:
    """Return the set-points of a signal of the public face, at the robot's sample time.

    Its frequencies and durations are the neck's by the robot's time constant, where the robot gives one.

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
    pulls, Ts = Pulls.of(robot), robot.require("sample_time_s", "a signal")
    second = (robot.time_constant_s or TIME_CONSTANT) / TIME_CONSTANT
    longest = second * (2.0 + 8.0 * pulls.angles.size if name == "steps" else _DURATIONS[name])
    length = longest if duration is None else duration
    require_between("duration", length, Ts, _MOST_ROWS * Ts, "s")
    if name in _FIXED and length > longest:
        raise SettingsError(f"`{name}` is {longest:g} s long by definition; got a duration of {length:g} s.")
    time = np.arange(round(length / Ts)) * Ts
    t = time / second
    rng = np.random.default_rng(seed)
    makers = {
        "eq22": lambda: eq22(t, pulls),
        "steps": lambda: _steps(t, pulls),
        "sine": lambda: _sine(t, pulls),
        "rotation": lambda: _rotation(t, pulls),
        "aprbs": lambda: _aprbs(t, rng, pulls),
        "multisine": lambda: _multisine(t, rng, pulls),
        "mixed": lambda: _mixed(t, rng, pulls),
    }
    return Excitation(name, time, _in_range(makers[name](), robot), Ts)


def _in_range(P: Matrix, robot: Robot) -> Matrix:
    """Return set-points of motors that go from -6 to 6 rad as those of a robot's, in SI."""
    given, scale = (robot.motors.setpoint_min, robot.motors.setpoint_max), to_si(robot.motors.unit)[0]
    low, high = (
        side * MOTOR_RANGE if values is None else scale * np.array(values)
        for side, values in zip((-1.0, 1.0), given, strict=True)
    )
    if np.all(low == -MOTOR_RANGE) and np.all(high == MOTOR_RANGE):
        return P
    return np.clip(0.5 * (low + high) + 0.5 * (high - low) * P / MOTOR_RANGE, low, high)


def eq22(t: Vector, pulls: Pulls) -> Matrix:
    """Return the identification signal of Eq. 22 with Table 2, (time, motors) [rad]; others spread its phi_4."""
    w1, w2, w3, w4, w5, w6, w7 = _OMEGA
    printed = pulls.angles.size == 3 and np.abs(pulls.angles - _PHI_1).max() < 0.01
    phi_1 = _PHI_1 if printed else pulls.angles
    # Each motor another: tendons that face each other would mirror each other else, and nothing be known of their sum.
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


def _steps(t: Vector, pulls: Pulls) -> Matrix:
    """Test 1: each motor at 3 rad for 8 s, one after the other."""
    # Half a sample of tolerance: instants are multiples of 20 ms only to rounding.
    now = t + 0.5 * _sample_time(t)
    motors = range(pulls.angles.size)
    return np.column_stack([np.where((now >= 1 + 8 * j) & (now < 9 + 8 * j), 3.0, 0.0) for j in motors])


def _sine(t: Vector, pulls: Pulls) -> Matrix:
    """Test 2: 0.05 to 0.6 Hz over 30 s; one part along each output, of the neck theta_i and phi_i."""
    phase = 2.0 * np.pi * (0.05 * t + (0.6 - 0.05) / 30.0 * t**2 / 2.0)
    s = 2.6 * np.sin(phase)
    outputs = len(pulls.rows)
    part = np.minimum((t + 0.5 * _sample_time(t)) * outputs / 30.0, outputs - 1).astype(int)
    rows = pulls.rows[part]
    return np.where(rows == 0.0, 0.0, s[:, None] * rows)


def _rotation(t: Vector, pulls: Pulls) -> Matrix:
    """Test 3: the tilt turns at 1.2 rad/s, its size ramped in over 3 s."""
    size = 2.8 * np.minimum(1.0, t / 3.0)
    return np.column_stack([size * np.cos(1.2 * t - angle) for angle in pulls.angles])


def _aprbs(t: Vector, rng: np.random.Generator, pulls: Pulls) -> Matrix:
    """Amplitude-modulated PRBS along each output and on co-contraction; each level held for 0.4 to 2.4 s."""
    inputs = np.column_stack([_levels(t, rng, size) for size in (*(4.0,) * len(pulls.rows), 0.8)])
    return np.clip(inputs @ pulls.inverse.T, -4.5, 4.5)


def _sample_time(t: Vector) -> float:
    return float(t[1] - t[0]) if t.size > 1 else SAMPLE_TIME


def _levels(t: Vector, rng: np.random.Generator, size: float) -> Vector:
    values = np.empty_like(t)
    start = 0
    while start < t.size:
        stop = start + max(1, round(rng.uniform(0.4, 2.4) / _sample_time(t)))
        values[start:stop] = rng.uniform(-size, size)
        start = stop
    return values


def _multisine(t: Vector, rng: np.random.Generator, pulls: Pulls) -> Matrix:
    """Random-phase multisine up to 4 rad/s, the least crest factor of 200 draws per motor."""
    period = max(t.size, 1) * _sample_time(t)
    tones = 2.0 * np.pi / period * np.arange(1, max(2, int(4.0 * period / (2.0 * np.pi)) + 1))
    # 32 tones spread over the band keep the draw cheap and leave the crest factor low.
    tones = tones[np.unique(np.linspace(0, tones.size - 1, 32).round().astype(int))]
    return np.column_stack([_low_crest(t, tones, rng) for _ in pulls.angles])


def _low_crest(t: Vector, tones: Vector, rng: np.random.Generator) -> Vector:
    coarse = t[::5]
    phases = min(
        (rng.uniform(0.0, 2.0 * np.pi, tones.size) for _ in range(200)),
        key=lambda phase: np.abs(np.cos(np.outer(coarse, tones) + phase).sum(axis=1)).max(initial=0.0),
    )
    s = np.cos(np.outer(t, tones) + phases).sum(axis=1)
    return 3.2 * s / np.abs(s).max(initial=1e-12)


def _mixed(t: Vector, rng: np.random.Generator, pulls: Pulls) -> Matrix:
    """Eq. 22, aprbs, multisine, then single-tendon and co-contraction moves, in fixed shares."""
    edges = np.round(np.array([0.0, 0.34, 0.66, 0.88, 0.95, 1.0]) * t.size).astype(int)
    lengths, motors = np.diff(edges), pulls.angles.size
    local = [np.arange(n) * _sample_time(t) for n in lengths]
    parts = [eq22(local[0], pulls), _aprbs(local[1], rng, pulls), _multisine(local[2], rng, pulls)]
    parts += [_single_tendon(local[3], rng, motors), np.repeat(_levels(local[4], rng, 2.5)[:, None], motors, axis=1)]
    return np.concatenate(parts)


def _single_tendon(t: Vector, rng: np.random.Generator, motors: int) -> Matrix:
    levels = _levels(t, rng, 3.5)
    motor = np.floor(t / 1.6).astype(int) % motors
    return np.where(motor[:, None] == np.arange(motors), levels[:, None], 0.0)


# The first period holds the transient; two more tell noise from the rest.
_PERIODS = 3
# Lines are spread evenly in log frequency: more of them would only be weaker each.
_LINES = 60
_DRAWS = 100
# Fewer samples per cycle than this and a held input has no power left at its frequency.
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
    """Return the experiments that `frequency_response` takes apart into response, noise and nonlinear distortion.

    Each direction (theta_i and phi_i of the neck) gets the same lines with phases of its own. A realisation
    is one experiment for each direction, in which direction a is turned by 360 a e/q deg: the matrix of inputs is
    orthogonal at every line (Pintelon and Schoukens 2012, 2.7).

    Args:
        amplitude: largest value of any direction's input, in the motors' unit.
        band: lowest and highest frequency [rad/s]; a period is one cycle of the lowest.
        realisations: draws of the phases.
        seed: of the phases.
        robot: whose directions and motors move, at its sample time.

    Raises:
        SettingsError: an empty band, one beyond a quarter of the sampling rate, or directions or a sample time that
            the robot does not give.
    """
    (low, high), sample_time = band, robot.require("sample_time_s", "a signal")
    require_between("amplitude", amplitude, 1e-6, 1e6, robot.motors.unit)
    require_whole("realisations", realisations, 1, 100)
    fastest = 2.0 * np.pi / (_SAMPLES_PER_CYCLE * sample_time)
    slowest = 2.0 * np.pi / (_MOST_ROWS * sample_time)
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
    chosen = np.unique(np.geomspace(1, lines[-1], _LINES).round().astype(int))
    inputs = _realisations(weights.shape[0], realisations, chosen, np.random.default_rng(seed))
    waves = [_period(phasors, chosen, rows) for phasors in inputs]
    scale = to_si(robot.motors.unit)[0] * amplitude / max(float(np.abs(wave).max()) for wave in waves)
    to_motors = np.linalg.pinv(weights).T
    time = np.arange(_PERIODS * rows) * sample_time
    return [
        Excitation("multisine", time, np.tile(scale * wave @ to_motors, (_PERIODS, 1)), sample_time) for wave in waves
    ]


def _realisations(q: int, count: int, lines: np.ndarray, rng: np.random.Generator) -> list[_Phasors]:
    """Return phasors (lines, q) of all experiments, the q of a realisation behind each other."""
    found = []
    fine = 8 * int(lines[-1])
    for _ in range(count):
        # Of some draws that with the least peak: more power within the same limits.
        drawn = (np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, (lines.size, q))) for _ in range(_DRAWS))
        phases = min(drawn, key=lambda phasors: float(np.abs(_period(phasors, lines, fine)).max()))
        for e in range(q):
            found.append(phases * np.exp(2j * np.pi * e * np.arange(q) / q))
    return found


def _period(phasors: _Phasors, lines: np.ndarray, rows: int) -> Matrix:
    """Return (rows, q): one period of the sum of the lines."""
    spectrum = np.zeros((rows, phasors.shape[1]), dtype=complex)
    spectrum[lines] = phasors
    return rows * np.real(np.fft.ifft(spectrum, axis=0))
