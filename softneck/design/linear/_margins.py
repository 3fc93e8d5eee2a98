"""Margins of discrete loops, many at once: crossings and peaks of S = 1/(1 + L), bracketed and refined.

S(z) is 1 plus a sum of r/(z - p) over the closed loop's poles p. A peak narrower than a grid, or two crossings between
two of its points, can only lie beside a pole close to the unit circle; there a finer grid is laid. L is real and
negative where Im S = 0 and S < 0 or S > 1, and |L| = 1 where Re S = 1/2 (Skogestad and Postlethwaite 2005, sec. 2.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from softneck.core import SettingsError, Vector


@dataclass(frozen=True, slots=True)
class Margins:
    """How far a loop is from instability.

    Attributes:
        gain: factor above 1 on the loop gain until instability; inf where there is none.
        phase: [rad]; inf where the gain never reaches 1.
        sensitivity: Ms, the largest `|1/(1 + L)|`.
        crossover: gain crossover of the phase margin [rad/s]; NaN where there is none.
        delay: [s] that the loop stands beyond its own.
        gain_down: factor below 1 on the loop gain until instability; 0 where there is none.
        complementary: Mt, the largest `|L/(1 + L)|`.
    """

    gain: float
    phase: float
    sensitivity: float
    crossover: float
    delay: float
    gain_down: float = 0.0
    complementary: float = math.nan


@dataclass(frozen=True, slots=True, eq=False)
class LoopMargins:
    """Margins of n loops with c channels, each (n, c), as in `Margins`; `difference` is the largest |S - T|.

    `more`: (n, q) peaks of the other sizes.
    """

    gain: np.ndarray
    gain_down: np.ndarray
    phase: np.ndarray
    delay: np.ndarray
    crossover: np.ndarray
    sensitivity: np.ndarray
    complementary: np.ndarray
    difference: np.ndarray
    more: np.ndarray

    def of(self, row: int, channel: int = 0) -> Margins:
        """Return the margins of one loop."""
        return Margins(**{item.name: float(getattr(self, item.name)[row, channel]) for item in fields(Margins)})

    def worst(self) -> Margins:
        """Return the worst of each over all loops; the crossover is the highest."""
        least = {name: float(getattr(self, name).min()) for name in ("gain", "phase", "delay")}
        largest = {name: float(getattr(self, name).max()) for name in ("gain_down", "sensitivity", "complementary")}
        crossed = self.crossover[~np.isnan(self.crossover)]
        return Margins(**least, **largest, crossover=float(crossed.max()) if crossed.size else math.nan)


def require_stable(poles: np.ndarray) -> None:
    """Raise SettingsError unless all closed-loop poles (n,) are inside the unit circle."""
    radius = float(np.abs(poles).max(initial=0.0))
    if not radius < 1.0:
        raise SettingsError(f"the closed loop is not stable (spectral radius {radius:.4f}); ask for less.")


def sensitivity_of(L: np.ndarray) -> np.ndarray:
    """Return S = 1/(1 + L); 0 at a pole of L on the unit circle."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(np.isinf(L), 0.0, 1.0 / (1.0 + L))


def polynomials_at(coefficients: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the polynomials (k, ..., order + 1), highest power first, each at its own z (k,), as (k, ...)."""
    z = z.reshape(-1, *[1] * (coefficients.ndim - 2))
    found = np.zeros(coefficients.shape[:-1], complex)
    for power in range(coefficients.shape[-1]):
        found = found * z + coefficients[..., power]
    return found


# The grid: 2.5 % apart over three decades below the Nyquist frequency; a sample of delay turns by at most 0.5 rad.
_STEP, _DECADES, _DELAY_TURN = 0.025, 3.0, 0.5
# As good as zero frequency, as a share of the Nyquist frequency.
_REST = 1e-8
# Points beside a pole closer to the circle than two steps of the grid, by equal steps of asinh: up to 4 grid steps off.
_LOCAL_POINTS, _LOCAL_REACH, _CLOSE = 41, 4.0, 2.0
# Local maxima that are refined, as a share of the largest; those of a resolved peak miss it by less than 2 %.
_NEAR_PEAK = 0.9
# Estimates of crossings that are refined: those up to this factor worse than the worst one.
_NEAR_MARGIN = 1.3
# At a root Im S or Re S - 1/2 is below this; steps at most.
_ROOT_TOLERANCE, _ROOT_STEPS = 1e-7, 60
# Factors on the gain further away are no margin: a pole or a zero of the loop on the circle.
_LARGEST_FACTOR = 1e6

#: Returns S (k, c) and other sizes (k, q) of the loops `rows` (k,) at the frequencies (k,) [rad/s].
Evaluate = Callable[[np.ndarray, Vector], tuple[np.ndarray, np.ndarray]]


def frequency_grid(sample_time: float, delay: int = 0) -> Vector:
    """Return frequencies [rad/s] up to Nyquist that resolve loops with `delay` samples and no lightly damped pole."""
    highest = math.pi / sample_time
    log = np.geomspace(highest * 10.0**-_DECADES, highest, math.ceil(math.log(10.0) * _DECADES / _STEP))
    even = np.linspace(0.0, highest, math.ceil(math.pi * (delay + 1) / _DELAY_TURN))[1:-1]
    return np.union1d(np.append(log[:-1], _REST * highest), np.append(even, highest))


def margins_of_loops(evaluate: Evaluate, poles: np.ndarray, sample_time: float, delay: int) -> LoopMargins:
    """Return the margins of n loops; one that is not stable has none: gain 1, phase and delay 0, infinite peaks.

    `poles`: (n, N) of the closed loops, padded with zeros. `delay`: of the loops [samples], at most.
    """
    stable, tracks = _stable_tracks(evaluate, poles, sample_time, delay)
    c, best = tracks[0].S.shape[2], _peaks(evaluate, tracks, len(poles))
    found = LoopMargins(
        **_crossings(evaluate, tracks, len(poles), c), sensitivity=best[:, :c], complementary=best[:, c : 2 * c],
        difference=best[:, 2 * c : 3 * c], more=best[:, 3 * c :],
    )  # fmt: skip
    lost = np.setdiff1d(np.arange(len(poles)), stable)
    for name, value in _UNSTABLE.items():
        getattr(found, name)[lost] = value
    return found


def sensitivities_of_loops(evaluate: Evaluate, poles: np.ndarray, sample_time: float, delay: int) -> np.ndarray:
    """Return the sensitivity (n, c) of `margins_of_loops` alone, for a third of its time."""
    stable, tracks = _stable_tracks(evaluate, poles, sample_time, delay)
    c = tracks[0].S.shape[2]
    best = _peaks(evaluate, [replace(track, sizes=track.sizes[:, :, :c]) for track in tracks], len(poles))
    best[np.setdiff1d(np.arange(len(poles)), stable)] = math.inf
    return best


def _stable_tracks(
    evaluate: Evaluate, poles: np.ndarray, sample_time: float, delay: int
) -> tuple[np.ndarray, list[_Track]]:
    """Return the rows of the stable loops, and their responses: on the grid, and beside lightly damped poles."""
    stable = np.flatnonzero(np.abs(poles).max(axis=1, initial=0.0) < 1.0)
    w = frequency_grid(sample_time, delay)
    # One row at least, for the number of channels.
    tracked = stable if stable.size else np.arange(1)
    tracks = [_Track.of(evaluate, tracked, np.broadcast_to(w, (tracked.size, w.size)))]
    rows, close = _beside_poles(poles[tracked], sample_time, delay)
    if rows.size:
        tracks.append(_Track.of(evaluate, tracked[rows], close))
    return stable, tracks


# Of a loop that is not stable.
_UNSTABLE = {
    "gain": 1.0, "gain_down": 1.0, "phase": 0.0, "delay": 0.0, "crossover": math.nan, "sensitivity": math.inf,
    "complementary": math.inf, "difference": math.inf, "more": math.inf,
}  # fmt: skip


def _beside_poles(poles: np.ndarray, sample_time: float, delay: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (k,) and frequencies (k, points) around the poles that the grid does not resolve."""
    highest = math.pi / sample_time
    # A pole at 0 is far from the circle.
    s = np.log(np.where(np.abs(poles) < 1e-9, 1e-9, poles).astype(complex)) / sample_time
    at, width = np.abs(s.imag), np.abs(s.real)
    lowest = highest * 10.0**-_DECADES
    step = np.where(at < lowest, lowest, np.minimum(_STEP * at, _DELAY_TURN / ((delay + 1) * sample_time)))
    rows, which = np.nonzero((width < _CLOSE * step) & (s.imag >= 0.0))
    at, step = at[rows, which, None], step[rows, which, None]
    width = np.maximum(width[rows, which, None], 1e-9 * step)
    reach = np.arcsinh(_LOCAL_REACH * step / width)
    w = at + width * np.sinh(reach * np.linspace(-1.0, 1.0, _LOCAL_POINTS))
    return rows, np.clip(w, _REST * highest, highest)


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """Responses of some loops along rising frequencies.

    `rows`: (k,). `w`: (k, m). `S`: (k, m, c). `sizes`: (k, m, 3 c + q).
    """

    rows: np.ndarray
    w: np.ndarray
    S: np.ndarray
    sizes: np.ndarray

    @classmethod
    def of(cls, evaluate: Evaluate, rows: np.ndarray, w: np.ndarray) -> _Track:
        k, m = w.shape
        S, more = evaluate(np.repeat(rows, m), w.reshape(-1))
        return cls(rows, w, S.reshape(k, m, -1), _sizes(S, more).reshape(k, m, -1))


def _sizes(S: np.ndarray, more: np.ndarray) -> np.ndarray:
    return np.concatenate([np.abs(S), np.abs(1.0 - S), np.abs(2.0 * S - 1.0), more], axis=-1)


def _peaks(evaluate: Evaluate, tracks: list[_Track], n: int) -> np.ndarray:
    """Return the largest sizes (n, 3 c + q), each refined at its highest local maxima."""
    best = np.zeros((n, tracks[0].sizes.shape[2]))
    for track in tracks:
        np.maximum.at(best, track.rows, track.sizes.max(axis=1))
    for track in tracks:
        v, w = track.sizes, track.w
        middle = v[:, 1:-1]
        high = (middle > v[:, :-2]) & (middle >= v[:, 2:]) & (middle > _NEAR_PEAK * best[track.rows][:, None])
        k, j, q = np.nonzero(high)
        if not k.size:
            continue
        # Beside a pole 1/|S|^2 is a parabola of the frequency: the peak is at its vertex.
        x = np.stack([w[k, j + i] for i in range(3)])
        y = np.stack([v[k, j + i, q] for i in range(3)]) ** -2.0
        left, right = (y[0] - y[1]) * (x[2] - x[1]), (y[2] - y[1]) * (x[1] - x[0])
        shift = 0.5 * (left * (x[2] - x[1]) - right * (x[1] - x[0])) / np.where(left + right > 0.0, left + right, 1.0)
        at = np.clip(x[1] + np.where(left + right > 0.0, shift, 0.0), x[0], x[2])
        S, more = evaluate(track.rows[k], at)
        np.maximum.at(best, (track.rows[k], q), _sizes(S, more)[np.arange(k.size), q])
    return best


def _crossings(evaluate: Evaluate, tracks: list[_Track], n: int, c: int) -> dict[str, np.ndarray]:
    """Return the margins (n, c) at the crossings of the negative real axis and of the unit circle."""
    up, down = np.full((n, c), math.inf), np.zeros((n, c))
    phase, delay, crossover = np.full((n, c), math.inf), np.full((n, c), math.inf), np.full((n, c), math.nan)
    # Zero and Nyquist frequency, where a loop is real.
    for S in (tracks[0].S[:, 0], tracks[0].S[:, -1]):
        rows, real = tracks[0].rows, np.real(S)
        factor = np.where(np.abs(np.imag(S)) < 1e-3 * np.abs(real), _factors(real), math.nan)
        up[rows] = np.fmin(up[rows], np.where(factor > 1.0, factor, math.nan))
        down[rows] = np.fmax(down[rows], np.where(factor < 1.0, factor, math.nan))
    axis = [_brackets(track, np.imag(track.S), down=down, up=up) for track in tracks]
    rows, channels, w = (np.concatenate(parts) for parts in zip(*axis, strict=True))
    rows, channels, _, S = _roots(evaluate, (rows, channels, w), lambda S: np.imag(S))
    factor = _factors(np.real(S))
    np.fmin.at(up, (rows, channels), np.where(factor > 1.0, factor, math.nan))
    np.fmax.at(down, (rows, channels), np.where(factor < 1.0, factor, math.nan))
    circle = [_brackets(track, np.real(track.S) - 0.5) for track in tracks]
    rows, channels, w = (np.concatenate(parts) for parts in zip(*circle, strict=True))
    rows, channels, w, S = _roots(evaluate, (rows, channels, w), lambda S: np.real(S) - 0.5)
    late = (np.angle(1.0 / S - 1.0) + math.pi) % (2.0 * math.pi)
    angle = np.minimum(late, 2.0 * math.pi - late)
    np.fmin.at(phase, (rows, channels), angle)
    np.fmin.at(delay, (rows, channels), late / w)
    least = angle <= phase[rows, channels]
    crossover[rows[least], channels[least]] = w[least]
    up[up > _LARGEST_FACTOR], down[down < 1.0 / _LARGEST_FACTOR] = math.inf, 0.0
    return {"gain": up, "gain_down": down, "phase": phase, "delay": delay, "crossover": crossover}


def _factors(S: np.ndarray) -> np.ndarray:
    """Return -1/L = S/(S - 1) where S is real and L negative, else NaN."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where((S > 1.0) | (S < 0.0), S / (S - 1.0), math.nan)


def _brackets(
    track: _Track, f: np.ndarray, *, down: np.ndarray | None = None, up: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, channels and both ends (k, 2) of the steps where `f` (k, m, c) changes its sign.

    With `down` and `up`: of those that estimate a gain margin near the smallest one.
    """
    k, j, c = np.nonzero((f[:, 1:] > 0.0) != (f[:, :-1] > 0.0))
    if down is not None and up is not None:
        a, b = f[k, j, c], f[k, j + 1, c]
        real = np.real(track.S)
        factor = _factors(real[k, j, c] + a / (a - b) * (real[k, j + 1, c] - real[k, j, c]))
        rows = track.rows[k]
        nearest_up, nearest_down = up.copy(), down.copy()
        np.fmin.at(nearest_up, (rows, c), np.where(factor > 1.0, factor, math.nan))
        np.fmax.at(nearest_down, (rows, c), np.where(factor < 1.0, factor, math.nan))
        near = (factor <= _NEAR_MARGIN * nearest_up[rows, c]) & (factor >= nearest_down[rows, c] / _NEAR_MARGIN)
        k, j, c = k[near], j[near], c[near]
    return track.rows[k], c, np.stack([track.w[k, j], track.w[k, j + 1]], axis=1)


def _roots(
    evaluate: Evaluate, brackets: tuple[np.ndarray, np.ndarray, np.ndarray], f: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, channels, frequencies and S at the root of `f(S)` in each bracket, by the Illinois method."""
    rows, channels, ends = brackets
    w, S = ends[:, 1].copy(), np.zeros(rows.size, complex)

    def S_at(x: np.ndarray, which: np.ndarray) -> np.ndarray:
        return evaluate(rows[which], x)[0][np.arange(which.size), channels[which]]

    left = np.arange(rows.size)
    a, b = ends.T
    fa, fb = (f(S_at(x, left)) for x in (a, b)) if left.size else (a, b)
    for step in range(_ROOT_STEPS):
        if not left.size:
            break
        # Every third step is a halving, so that each bracket shrinks whatever the function is like.
        flat = (fb == fa) | (step % 3 == 2)
        x = np.where(flat, 0.5 * (a + b), b - fb * (b - a) / np.where(fb == fa, 1.0, fb - fa))
        w[left], S[left] = x, S_at(x, left)
        fx = f(S[left])
        crossed = (fx > 0.0) != (fb > 0.0)
        a, fa = np.where(crossed, b, a), np.where(crossed, fb, 0.5 * fa)
        b, fb = x, fx
        go = np.abs(fx) > _ROOT_TOLERANCE
        left, a, b, fa, fb = left[go], a[go], b[go], fa[go], fb[go]
    return rows, channels, w, S
