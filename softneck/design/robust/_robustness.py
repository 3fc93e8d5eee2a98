"""Disk margins, robust stability and worst-case gain of python-control's systems, by the field's names.

Systems may be continuous or discrete, state space or transfer functions (delays of a discrete plant as poles at zero,
exactly), or `control.FrequencyResponseData`, of which stability cannot be checked and is taken for granted.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector, require_between

from ._mu import Array, Blocks, Structure, mu_lower, mu_upper

# Points over the range in which a loop does anything; peaks are refined between them.
_POINTS = 400
# Candidates for the highest peak that are refined, each to this part of its frequency.
_PEAKS, _ACCURACY = 3, 1e-7
# The complex part that purely real uncertainty gets in `robstab`: its peaks are that wide, its bound that much higher.
_SOFT = 0.02


@dataclass(frozen=True, slots=True)
class DiskMargin:
    """How much a loop stands in gain and phase at once (Seiler, Packard and Gahinet 2020, IEEE Control Systems 40:78).

    Attributes:
        margin: alpha_max, radius of the disk of perturbations; 0 where the nominal loop is not stable.
        gain: factors on the gain of each channel, all at once, that keep it stable.
        phase: [rad] of each channel, all at once.
        frequency: at which the disk is smallest [rad/s].
        skew: sigma: 0 balanced (S - T), 1 by the sensitivity S, -1 by T.
    """

    margin: float
    gain: tuple[float, float]
    phase: float
    frequency: float
    skew: float


@dataclass(frozen=True, slots=True)
class RobustStability:
    """How much of the modelled uncertainty a system stands.

    Attributes:
        lower: part of the uncertainty, 1 is all of it, that it stands for certain.
        upper: part at which an uncertainty was found that makes it unstable; inf where none was.
        frequency: of the largest structured singular value [rad/s].
    """

    lower: float
    upper: float
    frequency: float


@dataclass(frozen=True, slots=True)
class WorstCaseGain:
    """The largest gain over all of the uncertainty.

    Attributes:
        lower: a gain that an uncertainty was found for.
        upper: that no uncertainty exceeds; inf where stability itself is not certain.
        frequency: of the upper bound [rad/s].
    """

    lower: float
    upper: float
    frequency: float


def diskmargin(L: Any, *, skew: float = 0.0, frequency: Vector | None = None) -> DiskMargin:
    """Return the disk margin of a negative-feedback loop with open loop `L`, all channels of a square one at once.

    Args:
        L: open loop, one channel or several.
        skew: sigma of the disks.
        frequency: (m,) [rad/s]; chosen from the poles if not given.

    Raises:
        SettingsError: not square, or not a system of python-control.
    """
    require_between("skew", skew, -10.0, 10.0)
    n = _square(L)
    stable = _closed_loop_is_stable(L)
    if not stable:
        return DiskMargin(0.0, (1.0, 1.0), 0.0, math.nan, skew)
    eye = np.eye(n)
    structure = Structure.of([(1, 0)] * n)

    def peaks(w: Vector) -> Vector:
        S = np.linalg.inv(eye + response(L, w))
        M = S + 0.5 * (skew - 1.0) * eye
        return np.abs(M[:, 0, 0]) if n == 1 else mu_upper(M, structure)[0]

    w, peak = highest(peaks, grid(L, frequency), refine=not is_data(L))
    return disk(1.0 / max(peak, 1e-12), w, skew)


def disk(alpha: float, frequency: float, skew: float) -> DiskMargin:
    """Return gains and phases of the disk of radius `alpha`: (2 + (1 - s) a)/(2 - (1 + s) a) and its other end."""
    high = 2.0 - alpha * (1.0 + skew)
    low = 2.0 + alpha * (1.0 + skew)
    greatest = (2.0 + alpha * (1.0 - skew)) / high if high > 1e-12 else math.inf
    least = (2.0 - alpha * (1.0 - skew)) / low
    if math.isfinite(greatest):
        cosine = (1.0 + least * greatest) / (least + greatest)
        phase = math.acos(cosine) if abs(cosine) <= 1.0 else math.inf
    else:
        phase = math.acos(least) if abs(least) <= 1.0 else math.inf
    return DiskMargin(alpha, (least, greatest), phase, frequency, skew)


def robstab(M: Any, blocks: Blocks, *, frequency: Vector | None = None, seed: int = 0) -> RobustStability:
    """Return how much of the uncertainty `w = Delta z`, `|Delta| <= 1`, the system `z = M w` stands.

    Where all blocks are real, each gets a complex part of 2 %: real ones alone may have peaks that no grid meets.

    Args:
        M: stable system from the uncertainty's outputs to its inputs.
        blocks: of Delta: (-1, 0) real scalar, (1, 0) complex scalar, (rows, columns) full.
        frequency: (m,) [rad/s]; chosen from the poles if not given.
        seed: of the values tried for the upper end.

    Raises:
        SettingsError: a nominal system that is not stable, blocks that do not fit.
    """
    structure = Structure.of(blocks)
    _require_stable(M, "robstab")
    wider = Structure.of([*blocks, *[(1, 0)] * len(blocks)]) if structure.real.all() else structure

    def bounds(at: Vector) -> Vector:
        stack = structure.check(response(M, at))
        return mu_upper(_softened(stack) if structure.real.all() else stack, wider)[0]

    w, largest = highest(bounds, grid(M, frequency), refine=not is_data(M))
    around = np.asarray(M.omega) if is_data(M) else _with_ends(M, w * np.array([0.9, 0.97, 1.0, 1.03, 1.1]))
    found = mu_lower(structure.check(response(M, around)), structure, seed=seed)
    least = min(float(found.max()), largest)
    return RobustStability(1.0 / largest if largest > 0.0 else math.inf, 1.0 / least if least > 1e-9 else math.inf, w)


def wcgain(M: Any, blocks: Blocks, *, frequency: Vector | None = None, seed: int = 0) -> WorstCaseGain:
    """Return bounds of the largest gain from the last inputs to the last outputs over all `|Delta| <= 1`.

    The upper bound is the least gamma with `mu [M11 M12; M21/gamma M22/gamma] <= 1` at every frequency (skewed mu,
    Smith and Fan 1991); the lower one is of perturbations that were tried.

    Args:
        M: stable system; its first inputs and outputs belong to `w = Delta z`, the others are judged.
        blocks: of Delta.
        frequency: (m,) [rad/s]; chosen from the poles if not given.
        seed: of the perturbations tried.

    Raises:
        SettingsError: a nominal system that is not stable, blocks that do not fit.
    """
    structure = Structure.of(blocks)
    _require_stable(M, "wcgain")
    w = grid(M, frequency)
    if frequency is None and not is_data(M):
        w = w[::4]
    stack = response(M, w)
    nz, nw = structure.out_of.shape[0], structure.into.shape[0]
    if stack.shape[1] <= nz or stack.shape[2] <= nw:
        raise SettingsError(f"M must have more than {nz} outputs and {nw} inputs, the judged ones last.")
    upper = worst_gains(stack, blocks)
    lower = _gain_lower(stack, structure, seed)
    at = int(np.argmax(upper))
    return WorstCaseGain(float(lower.max()), float(upper[at]), float(w[at]))


def worst_gains(M: Array, blocks: Blocks) -> Vector:
    """Return for each of M (m, rows, columns) what `wcgain` bounds from above: inf where stability is not certain."""
    inside = Structure.of(blocks)
    nz, nw = inside.out_of.shape[0], inside.into.shape[0]
    outputs, inputs = M.shape[1] - nz, M.shape[2] - nw
    structure = Structure.of([*blocks, (inputs, outputs)])
    inner = mu_upper(M[:, :nz, :nw], inside)[0]
    certain = inner < 1.0

    def fits(gamma: Vector, which: Array) -> Array:
        scaled = M[which].copy()
        scaled[:, nz:] /= gamma[:, None, None]
        return mu_upper(scaled, structure)[0] <= 1.0

    gamma = np.full(M.shape[0], math.inf)
    which = np.flatnonzero(certain)
    if which.size == 0:
        return gamma
    low = np.maximum(np.linalg.norm(M[which, nz:, nw:], 2, axis=(1, 2)), 1e-12)
    high = 2.0 * low
    short = np.ones(which.size, dtype=bool)
    for _ in range(20):
        short = ~fits(high, which)
        if not short.any():
            break
        low, high = np.where(short, high, low), np.where(short, 4.0 * high, high)
    else:
        high = np.where(short, math.inf, high)
    # To 1 %: the bound itself is no sharper.
    for _ in range(9):
        middle = np.sqrt(low * high)
        ok = fits(middle, which)
        low, high = np.where(ok, low, middle), np.where(ok, middle, high)
    gamma[which] = high
    return gamma


def _gain_lower(M: Array, structure: Structure, seed: int) -> Vector:
    """Return the largest gain (m,) over perturbations at random on the border, real ones at their ends too."""
    rng = np.random.default_rng(seed)
    nz, nw = structure.out_of.shape[0], structure.into.shape[0]
    best = np.zeros(M.shape[0])
    eye = np.eye(nw)
    for trial in range(60):
        Delta = np.zeros((nw, nz), dtype=complex)
        for k, real in enumerate(structure.real):
            rows, columns = np.flatnonzero(structure.into[:, k]), np.flatnonzero(structure.out_of[:, k])
            if real:
                value = rng.choice([-1.0, 1.0]) if trial % 2 else rng.uniform(-1.0, 1.0)
                Delta[rows[0], columns[0]] = value
                continue
            left = rng.standard_normal((rows.size, 2)) @ [1.0, 1.0j]
            right = rng.standard_normal((columns.size, 2)) @ [1.0, 1.0j]
            Delta[rows[:, None], columns[None, :]] = (
                np.outer(left, right) / np.linalg.norm(left) / np.linalg.norm(right)
            )
        inner = np.linalg.solve(eye - Delta @ M[:, :nz, :nw], np.broadcast_to(Delta, (M.shape[0], nw, nz)))
        closed = M[:, nz:, nw:] + M[:, nz:, :nw] @ inner @ M[:, :nz, nw:]
        best = np.maximum(best, np.linalg.norm(closed, 2, axis=(1, 2)))
    return best


def _softened(M: Array) -> Array:
    """Return M for real scalars with a small complex part each: real ones alone have peaks of no width."""
    wide = np.concatenate([M, _SOFT * M], axis=2)
    return np.concatenate([wide, wide], axis=1)


def _with_ends(system: Any, w: Vector) -> Vector:
    """Return `w` with the frequencies at which a real system is real, where real uncertainties alone can break it."""
    return np.concatenate([[0.0], w, [] if _continuous(system) else [math.pi / _dt(system)]])


def response(system: Any, frequency: Vector) -> Array:
    """Return the complex response (m, outputs, inputs) at `frequency` [rad/s]."""
    if is_data(system):
        values = np.asarray(system.eval(frequency))
    else:
        values = np.asarray(system(frequency * 1j if _continuous(system) else np.exp(1j * frequency * _dt(system))))
    values = values.reshape(system.noutputs, system.ninputs, -1)
    return np.moveaxis(values, -1, 0)


def highest(function: Callable[[Vector], Vector], w: Vector, *, refine: bool = True) -> tuple[float, float]:
    """Return where the largest of `function` over the grid is, refined between its neighbours, and its value."""
    from scipy.optimize import minimize_scalar

    values = function(w)
    best = int(np.argmax(values))
    where, value = float(w[best]), float(values[best])
    if not refine or w.size < 3:
        return where, value
    inner = np.flatnonzero((values[1:-1] >= values[:-2]) & (values[1:-1] >= values[2:])) + 1
    for k in inner[np.argsort(values[inner])[::-1][:_PEAKS]]:
        found: Any = minimize_scalar(
            lambda x: -float(function(np.array([math.exp(x)]))[0]),
            bounds=(math.log(w[k - 1]), math.log(w[k + 1])), method="bounded", options={"xatol": _ACCURACY},
        )  # fmt: skip
        if -float(found.fun) > value:
            where, value = math.exp(float(found.x)), -float(found.fun)
    return where, value


def grid(system: Any, frequency: Vector | None) -> Vector:
    """Return `frequency`, or a grid [rad/s] from far below the slowest pole up to Nyquist or far above the fastest."""
    if frequency is not None:
        return np.asarray(frequency, dtype=np.float64)
    if is_data(system):
        return np.asarray(system.omega, dtype=np.float64)
    # Other systems have no zeros but by chance, and python-control finds those with Slycot alone.
    zeros = system.zeros() if system.ninputs == system.noutputs else []
    features = np.concatenate([np.asarray(system.poles()), np.asarray(zeros)])
    if _continuous(system):
        sizes = np.abs(features[np.abs(features) > 1e-8])
        low, high = (sizes.min(), sizes.max()) if sizes.size else (1.0, 1.0)
        return np.geomspace(low / 1e3, high * 1e2, _POINTS)
    dt = _dt(system)
    nyquist = math.pi / dt
    kept = features[(np.abs(features) > 1e-3) & (np.abs(features - 1.0) > 1e-8)]
    rates = np.abs(np.log(kept.astype(complex))) / dt
    low = min(float(rates.min()), nyquist) if rates.size else nyquist
    return np.append(np.geomspace(low / 1e3, nyquist, _POINTS)[:-1], nyquist)


def is_data(system: Any) -> bool:
    """Return whether `system` is frequency response data; refuse what is not a system."""
    import control

    if not isinstance(system, control.StateSpace | control.TransferFunction | control.FrequencyResponseData):
        raise SettingsError(
            f"a control.StateSpace, TransferFunction or FrequencyResponseData is needed; got {type(system).__name__}."
        )
    return isinstance(system, control.FrequencyResponseData)


def _square(L: Any) -> int:
    is_data(L)
    if L.ninputs != L.noutputs:
        raise SettingsError(f"`L` must be square; it has {L.noutputs} outputs and {L.ninputs} inputs.")
    return int(L.ninputs)


def _closed_loop_is_stable(L: Any) -> bool:
    import control

    if is_data(L):
        return True
    back: Any = control.StateSpace([], [], [], np.eye(L.ninputs), L.dt)
    closed: Any = control.feedback(control.ss(L), back)
    return is_stable(closed.poles(), L)


def is_stable(poles: Any, system: Any) -> bool:
    """Return whether `poles` lie where those of a stable system of that time domain do."""
    return bool(np.all(poles.real < 0.0)) if _continuous(system) else bool(np.all(np.abs(poles) < 1.0))


def _require_stable(M: Any, name: str) -> None:
    if not is_data(M) and not is_stable(np.asarray(M.poles()), M):
        raise SettingsError(f"`M` is not stable without uncertainty, so that `{name}` has no answer.")


def _continuous(system: Any) -> bool:
    return system.dt == 0 or system.dt is None


def _dt(system: Any) -> float:
    return 1.0 if isinstance(system.dt, bool) else float(system.dt)
