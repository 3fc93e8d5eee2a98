"""Experiments for a frequency response: periodic random-phase multisines, orthogonal between the directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from softneck.core import Matrix, SettingsError, require_between, require_whole, to_si
from softneck.robot import Robot

from ..recording._channels import NECK
from ._signals import Excitation

# The first period holds the transient; two more tell noise from the rest.
_PERIODS = 3
# Of a sine, whose cycles are short beside the transient.
_CYCLES = 12
# Lines are spread evenly in log frequency: more of them would only be weaker each.
_LINES = 60
_DRAWS = 100
# Fewer samples per cycle than this and a held input has no power left at its frequency.
_SAMPLES_PER_CYCLE = 4
_LONGEST = 86_400.0
# Amplitudes and phases (lines, directions).
_Phasors = NDArray[np.complexfloating[Any, Any]]


def multisine_experiments(
    *,
    amplitude: float = 1.0,
    band: tuple[float, float] = (0.5, 25.0),
    realisations: int | None = None,
    seed: int = 0,
    robot: Robot = NECK,
) -> list[Excitation]:
    """Return the experiments that `frequency_response` takes apart into response, noise and nonlinear distortion.

    Each direction (theta_i and phi_i of the neck) gets the same lines with phases of its own. A realisation
    is one experiment for each direction, in which direction a is turned by 360 a e/q deg: the matrix of inputs is
    orthogonal at every line (Pintelon and Schoukens 2012, 2.7). A band of one frequency is a sine, on one direction
    after the other.

    Args:
        amplitude: largest value of any direction's input, in the motors' unit.
        band: lowest and highest frequency [rad/s]; a period is one cycle of the lowest.
        realisations: draws of the phases, 4 where not given; of a sine repetitions, 1.
        seed: of the phases.
        robot: whose directions and motors move, at its sample time.

    Raises:
        SettingsError: an empty band, one beyond a quarter of the sampling rate, or directions or a sample time that
            the robot does not give.
    """
    (low, high), sample_time = band, robot.require("sample_time_s", "a signal")
    require_between("amplitude", amplitude, 1e-6, 1e6, robot.motors.unit)
    count = realisations if realisations is not None else 1 if low == high else 4
    require_whole("realisations", count, 1, 100)
    fastest = 2.0 * np.pi / (_SAMPLES_PER_CYCLE * sample_time)
    if not 2.0 * np.pi / _LONGEST <= low <= high <= fastest:
        raise SettingsError(
            f"`band` must rise within {2.0 * np.pi / _LONGEST:.2g} to {fastest:.3g} rad/s, a quarter of the sampling "
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
    inputs = _sines(weights.shape[0], count) if lines.size == 1 else None
    if inputs is None:
        inputs = _realisations(weights.shape[0], count, chosen, np.random.default_rng(seed))
    waves = [_period(phasors, chosen, rows) for phasors in inputs]
    scale = to_si(robot.motors.unit)[0] * amplitude / max(float(np.abs(wave).max()) for wave in waves)
    to_motors = np.linalg.pinv(weights).T
    repeated = _CYCLES if lines.size == 1 else _PERIODS
    time = np.arange(repeated * rows) * sample_time
    return [
        Excitation("multisine", time, np.tile(scale * wave @ to_motors, (repeated, 1)), sample_time) for wave in waves
    ]


def _sines(q: int, repetitions: int) -> list[_Phasors]:
    """Return phasors (lines, q) of one line on one direction after the other."""
    return [np.eye(q)[a : a + 1] + 0j for _ in range(repetitions) for a in range(q)]


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
