"""One controller of all axes at once: verified on every sample, its reference filter chosen, assembled."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError

from ..plants._coupled import AnyAxes, close_loop, radius, sensitivity
from ._axis_loop import LOWEST, bisect, frequencies, rise_time
from ._controller import LinearController, ReferenceFilter, assemble_law
from ._settings import AxisSettings, _slowest_filter, least_filter, reference_numbers

# Steps are looked at for so many times the slowest time constant, dead time and filter.
_STEP_WINDOW_RATIO = 8.0
_BISECTION_STEPS = 20
# Samples are judged on frequencies 4 % apart, as those of one axis are.
_COARSE_POINTS = 4


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class MultivariableDesign:
    """A multivariable controller with the plants of its design.

    Attributes:
        law: A, Br, By, C, Dr, Dy and the conditioning L, see `LinearArrays`.
        samples: all axes of every plant that it must hold on; the first is nominal.
        redefinition: T and its inverse.
        gains: numbers for people.
        notes: more findings, of each axis.
    """

    law: tuple[Matrix, ...]
    samples: Sequence[AnyAxes]
    redefinition: tuple[Matrix, Matrix]
    gains: dict[str, float]
    notes: dict[str, Any]

    @property
    def parts(self) -> tuple[Matrix, Matrix, Matrix, Matrix]:
        """A, B, C, D from references and outputs to redefined inputs."""
        A, Br, By, C, Dr, Dy, _ = self.law
        return A, np.hstack([Br, By]), C, np.hstack([Dr, Dy])

    def worst(self, extra_delay: int) -> float:
        """Return the largest Ms of all samples; inf where one is not stable."""
        nominal = self.samples[0][0]
        w = frequencies(nominal.sample_time, lowest=LOWEST / nominal.second)[::-_COARSE_POINTS][::-1]
        if any(radius(self.parts, plants, extra_delay) >= 1.0 for plants in self.samples):
            return math.inf
        return max(sensitivity(self.parts, plants, extra_delay, w) for plants in self.samples)


def multivariable_controller(
    settings: AxisSettings, made: MultivariableDesign, robot: Any, *, filtered: bool
) -> LinearController:
    """Return the controller.

    `settings`: order of the loop, limits, and what its references are filtered by. `made`: the controller's law and its
    plants. `robot`: whose plant it is. `filtered`: whether a reference filter is chosen where none is given. Raises
    SettingsError: a loop that is not stable around one of the samples, or a filter that does not help.
    """
    extra, plants = settings.extra_delay, made.samples[0]
    for k, sample in enumerate(made.samples):
        if (found := radius(made.parts, sample, extra)) >= 1.0:
            raise SettingsError(
                f"the loop is not stable around sample {k} of {len(made.samples)} (spectral radius {found:.4f}); "
                "design the controller for less."
            )
    given, lead, feedforward = reference_numbers(settings.reference_time)
    if lead + feedforward > 0.0:
        raise SettingsError(
            "a lead in `reference_time`, or feedforward, is of plants whose axes do not answer to each other; leave it "
            "out."
        )
    time = given or 0.0
    if settings.rise_s is not None:
        time = _filter_for(settings.rise_s, made, extra)
    elif given is None and filtered:
        time = _least_filter(settings, made)
    sample_time, limits = plants[0].sample_time, settings.limits(robot)
    found = {
        name: {
            "gains": {**made.gains, "reference_time_s": time},
            "dead_time_s": (plant.delay + extra) * sample_time,
            "states": len(made.law[0]),
            "samples": len(made.samples),
            **made.notes,
        }
        for name, plant in zip(robot.outputs.names, plants, strict=True)
    }
    return LinearController(
        kind=settings.KIND,
        sample_time=sample_time,
        arrays=assemble_law(
            made.law,
            filters=[ReferenceFilter(time)] * (len(plants) + 1),
            redefinition=made.redefinition,
            constants=limits.constants(sample_time),
        ),
        limits=limits,
        order=settings.order,
        design={"settings": settings._settings_json(), "extra_delay": extra, **found},
    )


def bisect_speed(keeps: Callable[[float], bool], low: float, high: float) -> float | None:
    """Bisect the largest speed from `low` to `high` that passes `keeps`, to 3 %; None if `low` fails."""
    if not keeps(low):
        return None
    return bisect(keeps, low, high, math.ceil(math.log2(math.log(high / low) / 0.03)), ratio=True)[0]


def _steps(made: MultivariableDesign, plants: AnyAxes, extra_delay: int, time: float) -> Matrix:
    """Return each output (rows, outputs) after a unit step of its own reference alone, no limit acting."""
    A, B, C = close_loop(made.parts, plants, extra_delay)
    Ts, m = plants[0].sample_time, len(plants)
    slowest = max(plant.time_constant for plant in plants)
    late = max(plant.delay for plant in plants) + extra_delay
    rows = math.ceil(_STEP_WINDOW_RATIO * ((slowest + time) / Ts + late))
    keep, at = ReferenceFilter(time).pole(Ts), 0.0
    x, y = np.zeros((len(A), m)), np.zeros((rows, m))
    for k in range(rows):
        at = keep * at + 1.0 - keep
        x = A @ x + at * B
        y[k] = np.diag(C @ x)
    return y


def _least_filter(settings: AxisSettings, made: MultivariableDesign) -> float:
    """Return the smallest filter time [s], from half the plant's lag on, that keeps the overshoot of all samples."""
    plants, Ts = made.samples[0], made.samples[0][0].sample_time
    slowest: Any = max(plants, key=lambda plant: plant.time_constant)
    high = _slowest_filter(slowest)
    low = min(round(0.5 * slowest.time_constant / Ts), high // 2)

    def keeps(samples: int) -> bool:
        peaks = [_steps(made, each, settings.extra_delay, samples * Ts).max() for each in made.samples]
        return max(peaks) <= 1.0 + settings.OVERSHOOT_PCT / 100.0

    return least_filter(keeps, low, high, Ts, settings.OVERSHOOT_PCT)


def _filter_for(asked: float, made: MultivariableDesign, extra_delay: int) -> float:
    """Return the filter time [s] with which the slowest output of the nominal plant rises in the required time [s]."""
    plants = made.samples[0]
    Ts = plants[0].sample_time

    def rise(time: float) -> float:
        return max(rise_time(y, Ts) for y in _steps(made, plants, extra_delay, time).T)

    own = rise(0.0)
    if own > asked:
        raise SettingsError(
            f"`rise_s` = {asked:g}: the loop rises in {own:.2g} s by itself; ask for more, or let the feedback be "
            "faster (`max_sensitivity`)."
        )
    return bisect(lambda time: rise(time) < asked, 0.0, asked, _BISECTION_STEPS)[0]
