"""The paper's signals and the excitations beside them; their definitions are frozen by hashes in the tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_one_of

from ..recording._redefinition import motors_from

#: Sample time of the paper's experiments [s].
SAMPLE_TIME = 0.02
# Table 2: columns are motors 1, 2, 3; phi_4 of motor 3 is 0.95 as printed, not 0.095.
_OMEGA = (1.0, 0.25, 1.5, 2.56, 1.75, 1.66, 4.0)
_PHI_1 = np.array([0.0, 2.09, 4.18])
_PHI_2 = np.array([0.0, 2.09, 4.18])
_PHI_4 = np.array([0.095, 0.095, 0.95])
_PHI_3, _PHI_5, _PHI_6, _PHI_7 = 0.32, 0.09, 0.29, 0.67
# [s] of each signal when no other length is asked for; None: any length.
_DURATIONS = {"eq22": 200.0, "steps": 26.0, "sine": 30.0, "rotation": 30.0, "aprbs": 140.0, "multisine": 140.0,
              "mixed": 140.0}  # fmt: skip
# A day at 20 ms is 4 million samples and 1 GB as text.
_LONGEST = 86_400.0
# Fixed by definition: these tests have one length.
_FIXED = ("steps", "sine", "rotation")


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """Motor set-points over time.

    Attributes:
        name: of the signal.
        time: (time,) [s].
        set_points: (time, 3) [rad].
        sample_time: [s].
    """

    name: str
    time: Vector
    set_points: Matrix
    sample_time: float = SAMPLE_TIME


def signal_names() -> tuple[str, ...]:
    """Return the names of all signals."""
    return tuple(_DURATIONS)


def signal(name: str, *, duration: float | None = None, seed: int = 0) -> Excitation:
    """Return the set-points of a signal of the public face at 20 ms.

    Args:
        name: eq22, steps, sine, rotation, aprbs, multisine or mixed.
        duration: [s]; the signal's own where None. Longer than its own only for those without a fixed length.
        seed: of aprbs, multisine and mixed.

    Raises:
        SettingsError: unknown name, or a duration under a sample or beyond a day.
    """
    require_one_of("signal", name, signal_names())
    length = _DURATIONS[name] if duration is None else duration
    require_between("duration", length, SAMPLE_TIME, _LONGEST, "s")
    if name in _FIXED and length > _DURATIONS[name]:
        raise SettingsError(f"`{name}` is {_DURATIONS[name]:g} s long by definition; got a duration of {length:g} s.")
    t = np.arange(round(length / SAMPLE_TIME)) * SAMPLE_TIME
    rng = np.random.default_rng(seed)
    makers = {
        "eq22": lambda: eq22(t),
        "steps": lambda: _steps(t),
        "sine": lambda: _sine(t),
        "rotation": lambda: _rotation(t),
        "aprbs": lambda: _aprbs(t, rng),
        "multisine": lambda: _multisine(t, rng),
        "mixed": lambda: _mixed(t, rng),
    }
    return Excitation(name, t, makers[name]())


def eq22(t: Vector) -> Matrix:
    """Return the identification signal of Eq. 22 with Table 2, (time, 3) [rad]."""
    w1, w2, w3, w4, w5, w6, w7 = _OMEGA
    T = t[:, None]
    carrier = 0.6 * np.sin(2.0 * np.sin(w1 * T + _PHI_1) + np.cos(w1 * T + _PHI_2))
    envelope = (
        3.0
        + np.sin(w2 * T)
        + np.sin(w3 * T + _PHI_3)
        + np.sin(w1 * T - _PHI_4)
        + np.sin(w4 * T)
        + np.sin(w5 * T + _PHI_5)
        + np.sin(w6 * T + _PHI_6) * np.sin(w7 * T + _PHI_7) / 2.0
    )
    return carrier * np.abs(envelope)


def _steps(t: Vector) -> Matrix:
    """Test 1: each motor at 3 rad for 8 s, one after the other."""
    # Half a sample of tolerance: instants are multiples of 20 ms only to rounding.
    now = t + 0.5 * SAMPLE_TIME
    return np.column_stack([np.where((now >= 1 + 8 * j) & (now < 9 + 8 * j), 3.0, 0.0) for j in range(3)])


def _sine(t: Vector) -> Matrix:
    """Test 2: 0.05 to 0.6 Hz over 30 s; the first half along theta_i, the second along phi_i."""
    phase = 2.0 * np.pi * (0.05 * t + (0.6 - 0.05) / 30.0 * t**2 / 2.0)
    s = 2.6 * np.sin(phase)
    first = (t + 0.5 * SAMPLE_TIME < 15.0)[:, None]
    zero = np.zeros_like(s)
    return np.where(first, np.column_stack([s, -s / 2, -s / 2]), np.column_stack([zero, s, -s]))


def _rotation(t: Vector) -> Matrix:
    """Test 3: the tilt turns at 1.2 rad/s, its size ramped in over 3 s."""
    size = 2.8 * np.minimum(1.0, t / 3.0)
    return np.column_stack([size * np.cos(1.2 * t - 2.0 * np.pi * j / 3.0) for j in range(3)])


def _aprbs(t: Vector, rng: np.random.Generator) -> Matrix:
    """Amplitude-modulated PRBS on the redefined inputs; each level held for 0.4 to 2.4 s."""
    inputs = np.column_stack([_levels(t, rng, size) for size in (4.0, 4.0, 0.8)])
    return np.clip(motors_from(inputs), -4.5, 4.5)


def _levels(t: Vector, rng: np.random.Generator, size: float) -> Vector:
    values = np.empty_like(t)
    start = 0
    while start < t.size:
        stop = start + round(rng.uniform(0.4, 2.4) / SAMPLE_TIME)
        values[start:stop] = rng.uniform(-size, size)
        start = stop
    return values


def _multisine(t: Vector, rng: np.random.Generator) -> Matrix:
    """Random-phase multisine up to 4 rad/s, the least crest factor of 200 draws per motor."""
    period = max(t.size * SAMPLE_TIME, SAMPLE_TIME)
    tones = 2.0 * np.pi / period * np.arange(1, max(2, int(4.0 * period / (2.0 * np.pi)) + 1))
    # 32 tones spread over the band keep the draw cheap and leave the crest factor low.
    tones = tones[np.unique(np.linspace(0, tones.size - 1, 32).round().astype(int))]
    return np.column_stack([_low_crest(t, tones, rng) for _ in range(3)])


def _low_crest(t: Vector, tones: Vector, rng: np.random.Generator) -> Vector:
    coarse = t[::5]
    phases = min(
        (rng.uniform(0.0, 2.0 * np.pi, tones.size) for _ in range(200)),
        key=lambda phase: np.abs(np.cos(np.outer(coarse, tones) + phase).sum(axis=1)).max(initial=0.0),
    )
    s = np.cos(np.outer(t, tones) + phases).sum(axis=1)
    return 3.2 * s / np.abs(s).max(initial=1e-12)


def _mixed(t: Vector, rng: np.random.Generator) -> Matrix:
    """Eq. 22, aprbs, multisine, then single-tendon and co-contraction moves, in fixed shares."""
    edges = np.round(np.array([0.0, 0.34, 0.66, 0.88, 0.95, 1.0]) * t.size).astype(int)
    lengths = np.diff(edges)
    local = [np.arange(n) * SAMPLE_TIME for n in lengths]
    parts = [eq22(local[0]), _aprbs(local[1], rng), _multisine(local[2], rng)]
    parts += [_single_tendon(local[3], rng), np.repeat(_levels(local[4], rng, 2.5)[:, None], 3, axis=1)]
    return np.concatenate(parts)


def _single_tendon(t: Vector, rng: np.random.Generator) -> Matrix:
    levels = _levels(t, rng, 3.5)
    motor = np.floor(t / 1.6).astype(int) % 3
    return np.where(motor[:, None] == np.arange(3), levels[:, None], 0.0)
