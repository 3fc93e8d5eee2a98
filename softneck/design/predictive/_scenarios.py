"""Samples of an uncertain plant as scenarios of the prediction."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from softneck.core import SettingsError
from softneck.estimation import AxisPlant, LinearNeck, axis_plant
from softneck.estimation._axis import robot_of

from ..plants._coupled_axis import AnyAxis
from ._prediction import Scenario
from ._scale import SizedPlant
from ._tuning import Pair, samples_ahead

# The nominal plant counts as much as all other scenarios together.
_NOMINAL_WEIGHT = 0.5
# That many samples of a family judge robustness; they are spread evenly over all.
_JUDGES = 12


class Timing(Protocol):
    """What is read of `MpcSettings` here."""

    @property
    def least_delay(self) -> float: ...
    @property
    def look_ahead(self) -> float: ...
    @property
    def extra_delay(self) -> int: ...


def timed(plant: AnyAxis, timing: Timing) -> Any:
    """Return a plant with the dead time that the controller sees: at least so much, less what the observer is ahead."""
    late = plant.delayed(timing.least_delay)
    return replace(late, delay=max(0, late.delay - samples_ahead(timing.look_ahead, plant.sample_time)))


def sample_pairs(model: Any, timing: Timing) -> list[Pair]:
    """Return samples of a family, axes joined by the order of their static gains; none for a single model."""
    if not hasattr(model, "samples") or (isinstance(model, SizedPlant) and not model.uncertain):
        return []
    axes = []
    for axis in robot_of(model).outputs.names:
        plants = [timed(plant, timing) for plant in samples_of(model, axis)]
        axes.append(sorted(plants, key=lambda plant: plant.static_gain))
    count = min(_JUDGES, *(len(plants) for plants in axes))
    picks = [np.linspace(0, len(plants) - 1, count).round().astype(int) for plants in axes]
    return [tuple(plants[i] for plants, i in zip(axes, chosen, strict=True)) for chosen in zip(*picks, strict=True)]


def chosen_scenarios(model: Any, nominal: Pair, count: int, timing: Timing) -> list[Scenario]:
    """Return the nominal plant and `count` samples, from the lowest to the highest gain.

    Raises:
        SettingsError: scenarios of a model that has no samples.
    """
    if count == 0:
        return [Scenario(nominal, 1.0)]
    pairs = sample_pairs(model, timing)
    if not pairs:
        raise SettingsError("scenarios are samples of a family; give a FAMILY (`softneck family`), or `scenarios=0`.")
    picks = np.unique(np.linspace(0, len(pairs) - 1, min(count, len(pairs))).round().astype(int))
    weight = (1.0 - _NOMINAL_WEIGHT) / picks.size
    others = []
    for pair in (pairs[i] for i in picks):
        delayed = tuple(replace(plant, delay=plant.delay + timing.extra_delay) for plant in pair)
        others.append(Scenario(delayed, weight))
    return [Scenario(nominal, _NOMINAL_WEIGHT), *others]


def samples_of(model: Any, axis: str) -> list[AxisPlant]:
    """Return the samples of an axis of a family; none of a single model."""
    if not hasattr(model, "samples"):
        return []
    if isinstance(model, SizedPlant):
        return list(model.axes[axis].samples)
    return [axis_plant(LinearNeck(pitch=tf, roll=tf), axis) for tf in model.samples(axis)]
