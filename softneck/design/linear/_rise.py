"""One meaning of speed for every kind: the rise of a step on the nominal plant, set by the reference filter alone.

The feedback stays as robust as its own settings make it. What is asked faster than it rises by itself is led by the
filter `(1 + T1 s)/(1 + T2 s)`, what is asked slower is lagged by it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.estimation import AxisPlant

from ..plants._step_and_load import StepAndLoad
from ._assembly import AxisController, ReferenceFilter
from ._axis_loop import make_sweep

# A lag of time constant T rises from 10 to 90 % in ln(9) T.
LAG = math.log(9.0)
# The lead over the lag: beyond it a step asks the motors for little but their limits.
_MOST_LEAD = 6.0
# A step is looked at for so many times what is asked, or the loop's own time.
_LONG = 12.0
_HALVINGS = 30
# No limit acts on a linear loop.
_FAR = 1e9


def check_rise(rise: float, plant: AxisPlant, test: StepAndLoad) -> None:
    """Raise SettingsError where the motors cannot make the plant rise so fast, however they are led.

    Args:
        rise: from 10 to 90 % [s].
        plant: the nominal one.
        test: the step and its limits on the plant's input.
    """
    least = least_rise(plant, test)
    if rise < least:
        raise SettingsError(
            f"`rise_s` = {rise:g}: within the motors' slew and range no step of two ninths of their range rises in "
            f"less than {least:.2g} s; ask for more."
        )


def least_rise(plant: AxisPlant, test: StepAndLoad, size: float | None = None) -> float:
    """Return the rise [s] with the input led to its end as fast as the slew allows; inf where 90 % is never reached.

    Args:
        plant: the nominal one.
        test: the limits on its input.
        size: of the step [rad]; that of the test if not given.
    """
    from scipy.signal import lfilter

    dt = plant.sample_time
    rows = math.ceil(_LONG * max(plant.time_constant, test.position_limit / test.slew_limit * dt) / dt)
    u = np.minimum(test.slew_limit * np.arange(1, rows + 1), test.position_limit)
    y = np.asarray(lfilter(np.append(0.0, plant.numerator), plant.denominator, u)) * math.copysign(
        1.0, plant.static_gain
    )
    return rise_time(y / (test.reference if size is None else size), dt)


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

    Raises:
        SettingsError: the loop is too slow to be led.
    """
    alone = _rise_with(ReferenceFilter(0.0), rise, axis, plant, extra_delay)
    if rise >= alone:
        guess = math.sqrt(max(rise**2 - alone**2, 0.0)) / LAG
        return _solved(lambda T: ReferenceFilter(T), 2.0 * guess + plant.sample_time, rise, axis, plant, extra_delay)
    T2 = rise / LAG
    most = ReferenceFilter(T2, _MOST_LEAD * T2)
    if not math.isfinite(alone) or _rise_with(most, rise, axis, plant, extra_delay) > rise:
        own = "does not rise by itself" if not math.isfinite(alone) else f"rises in {alone:.2g} s by itself"
        raise SettingsError(
            f"`rise_s` = {rise:g}: the loop {own}, and no reference filter leads it so far; ask for more, or let the "
            "feedback be faster (`max_sensitivity`)."
        )
    return _solved(lambda T: ReferenceFilter(T2, most.lead - T), most.lead, rise, axis, plant, extra_delay)


def leading_filter(
    time: float, lead: float, axis: AxisController, plant: AxisPlant, extra_delay: int
) -> ReferenceFilter:
    """Return the reference filter with T2 = `time` [s] whose zero cancels the part `lead` of the nominal loop's lag.

    Raises:
        SettingsError: a loop that does not rise by itself has none.
    """
    if lead == 0.0:
        return ReferenceFilter(time)
    alone = _rise_with(ReferenceFilter(0.0), time, axis, plant, extra_delay)
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


def _solved(
    make: Callable[[float], ReferenceFilter], most: float, rise: float, axis: AxisController, plant: AxisPlant,
    extra_delay: int,
) -> ReferenceFilter:  # fmt: skip
    """Return make(T) for the T in 0..most with that rise, by halves: it rises the slower the larger T is."""
    low, high = 0.0, most
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        if _rise_with(make(middle), rise, axis, plant, extra_delay) > rise:
            high = middle
        else:
            low = middle
    return make(0.5 * (low + high))


def _rise_with(
    reference: ReferenceFilter, asked: float, axis: AxisController, plant: AxisPlant, extra_delay: int
) -> float:
    dt = plant.sample_time
    long = _LONG * max(asked, plant.time_constant, (plant.delay + extra_delay) * dt)
    test = StepAndLoad(
        reference=1.0, position_limit=_FAR, slew_limit=_FAR, load=0.0, load_at=long, duration=long + dt, sample_time=dt
    )
    sweep = make_sweep([plant], extra_delay=extra_delay, test=test)
    with np.errstate(over="ignore", invalid="ignore"):
        y = sweep.run(replace(axis, L=np.zeros_like(axis.Br)), reference, np.zeros_like(axis.Br)).angles[0]
    return rise_time(y, dt) if np.isfinite(y).all() else math.inf
