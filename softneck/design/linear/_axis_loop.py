"""The loop of one axis around one plant: stability, margins, conditioning, step responses and reference filters."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.estimation import AxisPlant
from softneck.runtime import load_functions

from ..plants._coupled import grid_response
from ..plants._uncertain import StepAndLoad, StepAndLoadResult, judge
from ._controller import AxisController, ReferenceFilter
from ._margins import Evaluate, LoopMargins, margins_of_loops, polynomials_at, sensitivities_of_loops, sensitivity_of

# Lowest frequency on which a neck's loop is judged [rad/s]; loops of slower robots are from where their times are.
LOWEST = 0.05


def frequencies(sample_time: float, *, lowest: float = LOWEST) -> Vector:
    """Return the frequencies [rad/s] on which loops are judged, up to the Nyquist frequency."""
    # 1 % apart: the peak of |S| of a well-damped loop changes by less than 1e-4 between two of them.
    highest = math.pi / sample_time
    return np.geomspace(lowest, highest, math.ceil(math.log(highest / lowest) / 0.01))


# Samples are judged on a coarser grid than margins: 4 % apart, a peak of |S| changes by less than 2e-3 between two.
_SAMPLE_DECIMATION = 4
# Besides the reference, the state is disturbed by this part of it everywhere: it keeps the conditioning's poles
# off the border where a zero of the controller lies on it.
_STATE_NOISE_RATIO = 1e-3
# Hanus' gain is taken where it forgets within a second or so.
_MAX_CONDITIONING_POLE = 0.98
# Noise ascribed to the output, in units of what the reference does to it at once (squared).
_OUTPUT_NOISE_RATIOS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)


def error_feedback(K: Any) -> AxisController:
    """Return the axis of `v = K (r - y)` for a discrete scalar K."""
    A, B, C, D = (np.asarray(part, dtype=np.float64) for part in (K.A, K.B, K.C, K.D))
    d = float(D[0, 0])
    return AxisController(A=A, Br=B, By=-B, C=C, Dr=d, Dy=-d, L=conditioning_gain(A, B, C, d))


def conditioning_gain(A: Matrix, B: Matrix, C: Matrix, D: float) -> Matrix:
    """Return L (n, 1) for `x+ = A x + B r + L (v_limited - v)`, v = C x + D r.

    Hanus' B/D where D is not zero and the conditioned state forgets quickly (Hanus et al. 1987, Automatica 23:729).
    Otherwise the gain of the innovations form of v: the Kalman predictor of a state driven by r as by noise, which
    is B/D with its unstable zeros mirrored (Anderson and Moore 1979, sec. 9.3), and exists for D = 0.
    """
    if abs(D) > 1e-9:
        L = B / D
        if float(np.abs(np.linalg.eigvals(A - L @ C)).max(initial=0.0)) <= _MAX_CONDITIONING_POLE:
            return L
    return innovations_gain(A, B, C, np.array([[D]]))


def innovations_gain(A: Matrix, B: Matrix, C: Matrix, D: Matrix) -> Matrix:
    """Return the gain L (n, m) of the innovations form of `v = C x + D r`, x+ = A x + B r, for r as white noise.

    Raises SettingsError: a mode that is not stable does not show in v.
    """
    from scipy.linalg import solve_discrete_are

    Q, v = _noise_of_reference(B, C, D)
    R, S = v * v * (1.0 + _STATE_NOISE_RATIO) * np.eye(len(C)), B @ D.T
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SettingsError(
            "no conditioning keeps the controller stable at its limits: a mode that is not stable does not show in "
            "its output. Ask for less."
        ) from error
    return np.asarray(np.linalg.solve((C @ P @ C.T + R).T, (A @ P @ C.T + S).T).T)


def _noise_of_reference(B: Matrix, C: Matrix, D: Matrix) -> tuple[Matrix, float]:
    """Return the covariance (n, n) of the state under r as white noise, and the size of what r does to v at once."""
    # In units of what a reference does, so that the spread is relative.
    size = max(float(np.linalg.norm(B)), 1e-12)
    Q = B @ B.T + (_STATE_NOISE_RATIO * size) ** 2 * np.eye(len(B))
    return Q, max(float(np.linalg.norm(D, 2)), 1e-3 * float(np.abs(C @ B).max(initial=0.0)), 1e-9)


def conditioning_candidates(axis: AxisController) -> list[Matrix]:
    """Return gains L that may do better than Hanus' under slew limits: predictors that trust the limited output more.

    The smaller the noise ascribed to the output, the faster the state follows what the motors could do.
    """
    from scipy.linalg import solve_discrete_are

    Q, v = _noise_of_reference(axis.Br, axis.C, np.array([[axis.Dr]]))
    found = []
    for noise in _OUTPUT_NOISE_RATIOS:
        R = np.array([[noise * v * v]])
        try:
            P = solve_discrete_are(axis.A.T, axis.C.T, Q, R)
        except (np.linalg.LinAlgError, ValueError):
            continue
        L = np.asarray(axis.A @ P @ axis.C.T / (axis.C @ P @ axis.C.T + R))
        if (
            np.isfinite(L).all()
            and float(np.abs(np.linalg.eigvals(axis.A - L @ axis.C)).max(initial=0.0)) < _MAX_CONDITIONING_POLE
        ):
            found.append(L)
    return found


def feedback_response(axis: AxisController, z: np.ndarray) -> np.ndarray:
    """Return K(z) (m,) of `v = -K y`."""
    return -grid_response(axis.A, axis.By, axis.C, np.array([[axis.Dy]]), z)[:, 0, 0]


def closed_poles(axis: AxisController, plants: Sequence[AxisPlant], extra_delay: int) -> np.ndarray:
    """Return the poles (plants, n) of the loops with their exact delay, padded with zeros."""
    forms, n = [delayed_form(plant, extra_delay) for plant in plants], len(axis.A)
    sizes = np.array([len(C) for _, _, C in forms])
    poles = np.zeros((len(forms), int(sizes.max()) + n), complex)
    for size in np.unique(sizes):
        alike = np.flatnonzero(sizes == size)
        A, B, C = (np.array(part) for part in zip(*(forms[k] for k in alike), strict=True))
        whole = np.empty((alike.size, size + n, size + n))
        whole[:, :size, :size] = A + axis.Dy * B[:, :, None] * C[:, None, :]
        whole[:, :size, size:] = B[:, :, None] * axis.C
        whole[:, size:, :size] = axis.By * C[:, None, :]
        whole[:, size:, size:] = axis.A
        poles[alike, : size + n] = np.linalg.eigvals(whole)
    return poles


def delayed_form(plant: AxisPlant, extra_delay: int = 0) -> tuple[Matrix, Vector, Vector]:
    """Return A, B, C of the plant with its delay as states: the inputs that are on their way, oldest first."""
    A, B, C = plant.observable_form()
    n, d = len(A), plant.delay + extra_delay
    if d == 0:
        return A, B, C
    whole, entry = np.zeros((n + d, n + d)), np.zeros(n + d)
    whole[:n, :n], whole[:n, n] = A, B
    whole[n : n + d - 1, n + 1 : n + d] = np.eye(d - 1)
    entry[-1] = 1.0
    return whole, entry, np.concatenate([C, np.zeros(d)])


def axis_margins(axis: AxisController, plants: Sequence[AxisPlant], extra_delay: int) -> LoopMargins:
    """Return the margins of the loops around `plants` with their exact delay; a loop that is not stable has none."""
    return margins_of_loops(*_loops_around(axis, plants, extra_delay))


def _loops_around(
    axis: AxisController, plants: Sequence[AxisPlant], extra_delay: int
) -> tuple[Evaluate, np.ndarray, float, int]:
    """Return what `margins_of_loops` takes."""
    dt, order = plants[0].sample_time, max(plant.order for plant in plants)
    above, below = np.zeros((len(plants), order)), np.zeros((len(plants), order + 1))
    for k, plant in enumerate(plants):
        above[k, order - plant.order :], below[k, order - plant.order :] = plant.numerator, plant.denominator
    delays = np.array([plant.delay + extra_delay for plant in plants])

    def evaluate(rows: np.ndarray, w: Vector) -> tuple[np.ndarray, np.ndarray]:
        z = np.exp(1j * w * dt)
        each, back = np.unique(w, return_inverse=True)
        K = feedback_response(axis, np.exp(1j * each * dt))[back]
        L = K * polynomials_at(above[rows], z) / polynomials_at(below[rows], z) * z ** -delays[rows].astype(float)
        return sensitivity_of(L)[:, None], np.zeros((w.size, 0))

    return evaluate, closed_poles(axis, plants, extra_delay), dt, int(delays.max())


def sensitivities(axis: AxisController, plants: Sequence[AxisPlant], extra_delay: int) -> Vector:
    """Return Ms of every plant (plants,); inf where the loop is not stable."""
    return sensitivities_of_loops(*_loops_around(axis, plants, extra_delay))[:, 0]


def coarse_frequencies(plant: AxisPlant) -> Vector:
    """Return frequencies [rad/s] for many samples, 4 % apart, the Nyquist frequency among them."""
    return frequencies(plant.sample_time, lowest=LOWEST / plant.second)[::-_SAMPLE_DECIMATION][::-1]


def unstable_samples(axis: AxisController, plants: Sequence[AxisPlant], extra_delay: int) -> list[int]:
    """Return the indices of the plants around which the loop is not stable."""
    radius = np.abs(closed_poles(axis, plants, extra_delay)).max(axis=1, initial=0.0)
    return np.flatnonzero(~(radius < 1.0)).tolist()


_SWEEP_RUNTIME = "softneck.design.linear._sweep_runtime"


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """A family of plants made ready for many runs of the bake-off.

    `plants`: (plants, 2, order) numerators and denominators. `delays`: (plants,) [samples]. `test`: what is asked.
    `nominal`: index of the nominal plant.
    """

    plants: Matrix
    delays: Vector
    test: StepAndLoad
    nominal: int = 0

    def run(self, axis: AxisController, reference: ReferenceFilter | float, L: Matrix) -> StepAndLoadResult:
        """Return how the axis does; equal to `run_bake_off` with the assembled controller."""
        test = self.test
        led = reference if isinstance(reference, ReferenceFilter) else ReferenceFilter(reference)
        numbers = np.array([
            test.reference, led.pole(test.sample_time), test.position_limit, test.slew_limit, test.load, test.load_row,
            led.jump,
        ])  # fmt: skip
        angles = np.zeros((self.delays.size, test.rows))
        functions: Any = load_functions(_SWEEP_RUNTIME)
        functions.sweep_run(
            np.ascontiguousarray(axis.A),
            np.ascontiguousarray(np.hstack([axis.Br, axis.By])),
            np.ascontiguousarray(axis.C[0]),
            np.array([axis.Dr, axis.Dy]),
            np.ascontiguousarray(L[:, 0]),
            numbers,
            self.plants,
            self.delays,
            angles,
        )
        return judge(angles, np.zeros((0, 0)), test, self.nominal)


def make_sweep(plants: Sequence[AxisPlant], *, extra_delay: int = 0, test: StepAndLoad | None = None) -> Sweep:
    """Return `plants`, the nominal one first, ready to be swept with `extra_delay` samples more."""
    asked = test or StepAndLoad(sample_time=plants[0].sample_time)
    order = max(plant.order for plant in plants)
    numbers = np.zeros((len(plants), 2, order))
    for row, plant in zip(numbers, plants, strict=True):
        row[0, : plant.order] = plant.numerator
        row[1, : plant.order] = plant.denominator[1:]
    return Sweep(numbers, np.array([float(plant.delay + extra_delay) for plant in plants]), asked)


# A lag of time constant T rises from 10 to 90 % in ln(9) T.
LAG = math.log(9.0)
# The lead over the lag: beyond it a step asks the motors for little but their limits.
_MAX_LEAD_RATIO = 6.0
# A step is looked at for so many times what is asked, or the loop's own time.
_RISE_WINDOW_RATIO = 12.0
_BISECTION_STEPS = 30
# No limit acts on a linear loop.
_NO_LIMIT = 1e9


def check_rise(rise: float, plant: AxisPlant, test: StepAndLoad) -> None:
    """Raise SettingsError where the motors cannot make the plant rise so fast, however they are led.

    `rise`: from 10 to 90 % [s]. `plant`: the nominal one. `test`: the step and its limits on the plant's input.
    """
    least = least_rise(plant, test)
    if rise < least:
        raise SettingsError(
            f"`rise_s` = {rise:g}: within the motors' slew and range no step of two ninths of their range rises in "
            f"less than {least:.2g} s; ask for more."
        )


def least_rise(plant: AxisPlant, test: StepAndLoad, size: float | None = None) -> float:
    """Return the rise [s] with the input led to its end as fast as the slew allows; inf where 90 % is never reached.

    `plant`: the nominal one. `test`: the limits on its input. `size`: of the step [rad]; that of the test if not given.
    """
    from scipy.signal import lfilter

    dt = plant.sample_time
    rows = math.ceil(_RISE_WINDOW_RATIO * max(plant.time_constant, test.position_limit / test.slew_limit * dt) / dt)
    u = np.minimum(test.slew_limit * (np.arange(rows) + 1), test.position_limit)
    y = np.asarray(lfilter(np.append(0.0, plant.numerator), plant.denominator, u)) * math.copysign(
        1.0, plant.static_gain
    )
    return rise_time(y / (test.reference if size is None else size), dt)


def bisect(
    keeps: Callable[[float], bool], low: float, high: float, halvings: int, *, ratio: bool = False
) -> tuple[float, float]:
    """Halve the range from `low`, which keeps something, to `high`, which does not; `ratio`: at geometric means."""
    for _ in range(halvings):
        middle = math.sqrt(low * high) if ratio else 0.5 * (low + high)
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return low, high


def rise_time(y: Vector, dt: float) -> float:
    """Return the time [s] from 10 to 90 % of a response (n,) towards 1, between samples; inf if it never gets there."""
    times = []
    for level in (0.1, 0.9):
        above = np.flatnonzero(y >= level)
        if not above.size:
            return math.inf
        k = int(above[0])
        before = float(y[k - 1]) if k else 0.0
        times.append(k - (float(y[k]) - level) / (float(y[k]) - before))
    return float(times[1] - times[0]) * dt


def filter_for(rise: float, axis: AxisController, plant: AxisPlant, extra_delay: int) -> ReferenceFilter:
    """Return the reference filter with which the nominal loop rises in `rise` [s], no limit acting.

    A loop that rises by itself in r0 is taken for a lag: T2 = sqrt(rise^2 - r0^2)/ln 9 and no lead where it is faster
    than asked, else T2 = rise/ln 9 and T1 = r0/ln 9; the one that is free is then corrected on the loop's own response.
    Raises SettingsError: the loop is too slow to be led.
    """
    alone = _rise_time_with(ReferenceFilter(0.0), rise, axis, plant, extra_delay)
    if rise >= alone:
        guess = math.sqrt(max(rise**2 - alone**2, 0.0)) / LAG
        return _bisect_filter(ReferenceFilter, 2.0 * guess + plant.sample_time, rise, axis, plant, extra_delay)
    T2 = rise / LAG
    most = ReferenceFilter(T2, _MAX_LEAD_RATIO * T2)
    if not math.isfinite(alone) or _rise_time_with(most, rise, axis, plant, extra_delay) > rise:
        own = "does not rise by itself" if not math.isfinite(alone) else f"rises in {alone:.2g} s by itself"
        raise SettingsError(
            f"`rise_s` = {rise:g}: the loop {own}, and no reference filter leads it so far; ask for more, or let the "
            "feedback be faster (`max_sensitivity`)."
        )
    return _bisect_filter(lambda T: ReferenceFilter(T2, most.lead - T), most.lead, rise, axis, plant, extra_delay)


def leading_filter(
    time: float, lead: float, axis: AxisController, plant: AxisPlant, extra_delay: int
) -> ReferenceFilter:
    """Return the reference filter with T2 = `time` [s] whose zero cancels the part `lead` of the nominal loop's lag.

    Raises SettingsError: a loop that does not rise by itself has none.
    """
    if lead == 0.0:
        return ReferenceFilter(time)
    alone = _rise_time_with(ReferenceFilter(0.0), time, axis, plant, extra_delay)
    if not math.isfinite(alone):
        raise SettingsError(
            "the lead of `reference_time`: the loop does not rise by itself; raise `max_sensitivity`, or leave it out."
        )
    return ReferenceFilter(time, lead * alone / LAG)


def filter_for_lag(rise: float, lag: float) -> ReferenceFilter:
    """Return the filter with which a lag of time constant `lag` [s] rises in `rise` [s]: a lead cancels its pole."""
    own = LAG * lag
    if rise < own:
        return ReferenceFilter(rise / LAG, lag)
    # Two lags a >= b in series rise in ln 9 sqrt(a^2 + b^2), or 8 % longer at worst.
    return ReferenceFilter(math.sqrt(rise**2 - own**2) / LAG)


def _bisect_filter(
    make: Callable[[float], ReferenceFilter], most: float, rise: float, axis: AxisController, plant: AxisPlant,
    extra_delay: int,
) -> ReferenceFilter:  # fmt: skip
    """Return make(T) for the T in 0..most with that rise, by halves: it rises the slower the larger T is."""
    ends = bisect(
        lambda T: _rise_time_with(make(T), rise, axis, plant, extra_delay) <= rise, 0.0, most, _BISECTION_STEPS
    )
    return make(0.5 * sum(ends))


def _rise_time_with(
    reference: ReferenceFilter, asked: float, axis: AxisController, plant: AxisPlant, extra_delay: int
) -> float:
    dt = plant.sample_time
    long = _RISE_WINDOW_RATIO * max(asked, plant.time_constant, (plant.delay + extra_delay) * dt)
    test = StepAndLoad(
        reference=1.0,
        position_limit=_NO_LIMIT,
        slew_limit=_NO_LIMIT,
        load=0.0,
        load_at=long,
        duration=long + dt,
        sample_time=dt,
    )
    sweep = make_sweep([plant], extra_delay=extra_delay, test=test)
    with np.errstate(over="ignore", invalid="ignore"):
        y = sweep.run(replace(axis, L=np.zeros_like(axis.Br)), reference, np.zeros_like(axis.Br)).angles[0]
    return rise_time(y, dt) if np.isfinite(y).all() else math.inf
