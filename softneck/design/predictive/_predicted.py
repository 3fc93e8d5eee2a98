"""The plant that is predicted, its samples, and what a design takes for given of it: of a neck, or another robot.

And what it takes from its loop's observer: look-ahead, and how taut a payload wants tendons.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError
from softneck.estimation import AxisPlant, LinearNeck, axis_plant
from softneck.estimation._axis import HasTransferFunctions, robot_of
from softneck.identification import Model
from softneck.robot import Robot
from softneck.robot._neck_default import NeckCount, NeckDefault
from softneck.robot._redefined import redefinition_of
from softneck.signals import redefinition_matrix

from ..plants._coupled import CoupledPlant, coupled_plant
from ..plants._coupled_axis import AnyAxis, CoupledAxis, times
from ..plants._uncertain import UncertainPlant, uncertain_plant
from ._scale import SizedPlant
from ._tuning import Pair, samples_ahead

# What stands for the defaults of an identified neck where the plant is one's own or another robot's.
_BELIEVED: dict[str, Any] = {
    # The paper's own dead time (Eq. 31).
    "least_delay": NeckDefault(0.08), "taut_pole": 0.0, "reference_time": NeckDefault(0.2), "minimum_tautness": None,
}  # fmt: skip
# Of another robot than the neck, stretched by its slowest pole: the neck's 30 samples of 20 ms [s].
_HORIZON = 0.6
_LONGEST = 200
# That many samples of a family judge robustness; they are spread evenly over all.
_JUDGES = 12

# Small moves that tell whether tendons hang [rad of a redefined input], and how long the model settles before [s].
_MOVE, _SETTLED = 0.3, 3.0
# Tendons are taut where such a move does this part of the most that it does anywhere.
_TAUT = 0.9
# Co-contractions that are tried, from rest on [rad].
_STEP, _MOST = 0.25, 4.0

# Part of `least_delay` that is a sensor's at most.
_BEHIND = 0.5


S = TypeVar("S", bound=Any)


def settings_for(settings: S, model: HasTransferFunctions) -> S:
    """Return the settings for what was identified of a neck, or for any other plant."""
    if not (robot_of(model).is_neck and hasattr(model, "findings")):
        settings = _with(settings, _BELIEVED)
    # It adds to a tautness that is wished for.
    return settings if settings.minimum_tautness is not None else replace(settings, payload_tautness=0.0)


def settings_of_robot(settings: S, plant: UncertainPlant | CoupledPlant) -> S:
    """Return the settings for another robot: seconds stretched by its slowest pole, nothing that is known of necks."""
    stretch = max(axis.nominal.stretch for axis in plant.axes.values())
    horizon = min(max(3, round(_HORIZON * stretch / plant.sample_time)), _LONGEST)
    others = {"least_delay": 0.0, "small_move_pole": 0.0, "horizon": horizon,
              "reference_time": stretch * settings.reference_time}  # fmt: skip
    if isinstance(settings.moves, NeckCount):
        length = horizon if isinstance(settings.horizon, NeckCount) else settings.horizon
        others["moves"] = min(int(settings.moves), length)
    return _with(settings, others)


def _with(settings: S, others: Mapping[str, Any]) -> S:
    """Return the settings with others in the place of a neck's defaults that nobody gave."""
    changed = {k: v for k, v in others.items() if isinstance(getattr(settings, k), NeckDefault | NeckCount)}
    return replace(settings, **changed)


def predicted_plants(settings: Any, model: HasTransferFunctions) -> Pair:
    """Return the plant of each output that is predicted.

    Raises:
        SettingsError: different sample times.
    """
    names = robot_of(model).outputs.names
    plants = tuple(_predicted(settings, model, axis) for axis in names)
    times = [plant.sample_time for plant in plants]
    if not all(math.isclose(time, times[0], rel_tol=1e-9) for time in times):
        each = " and ".join(f"{time:g} s" for time in times)
        raise SettingsError(f"{' and '.join(names)} have different sample times, {each}.")
    return plants


def with_taken(made: S, settings: Any, model: HasTransferFunctions) -> S:
    """Return a controller that says what of the paper's neck, and not of this plant, it takes for nobody said other."""
    plants = [axis_plant(model, axis) for axis in robot_of(model).outputs.names]
    late = [plant.delayed(settings.least_delay) for plant in plants]
    changed = {"least_delay": any(item.delay > plant.delay for item, plant in zip(late, plants, strict=True))}
    for name in ("small_move_pole", "taut_pole"):
        pole = float(getattr(settings, name))
        changed[name] = pole > 0.0 and any(plant.faster(pole) is not plant for plant in plants)
    taken = {name: float(getattr(settings, name)) for name, changes in changed.items()
             if changes and isinstance(getattr(settings, name), NeckDefault)}  # fmt: skip
    return replace(made, design={**made.design, "assumed": taken})


def plant_of(model: Any, robot: Robot | None) -> Any:
    """Return what is to be predicted of a model or a `control` system: one plant for each axis, or a coupled one."""
    whole = coupled_plant(model, robot=robot)
    if whole is not None:
        return whole
    # A system, or a list of them, is of a neck whose axes do not answer to each other.
    return model if hasattr(model, "tf") else uncertain_plant(model, robot)


def weighed(plant: UncertainPlant | CoupledPlant) -> tuple[Matrix, Matrix]:
    """Return T of another robot's plant, or of a coupled one, and its inverse."""
    if isinstance(plant, CoupledPlant):
        return plant.redefinition
    return redefinition_of(np.asarray(plant.weights), plant.names)


def families(nominal: Pair, small_move_pole: float) -> list[Pair]:
    """Return what the neck may be: as identified, and faster."""
    if small_move_pole == 0.0:
        return [nominal]
    fast = tuple(plant.faster(small_move_pole) for plant in nominal)
    return [nominal] if fast == nominal else [nominal, fast]


def _predicted(settings: Any, model: HasTransferFunctions, axis: str) -> AnyAxis:
    if isinstance(model, SizedPlant) and isinstance(model.axes[axis].nominal, CoupledAxis):
        return timed(model.axes[axis].nominal, settings)
    plant = timed(axis_plant(model, axis), settings)
    if settings.taut_pole == 0.0:
        return plant
    # Recordings in which tendons hang say less than a taut neck does, none says more.
    ratios = [abs(sample.static_gain / plant.static_gain) for sample in samples_of(model, axis)]
    (taut,) = times((plant.faster(settings.taut_pole),), max([1.0, *ratios]))
    return taut


def timed(plant: AnyAxis, timing: Any) -> Any:
    """Return a plant with the dead time that the controller sees: at least so much, less what the observer is ahead."""
    late = plant.delayed(timing.least_delay)
    return replace(late, delay=max(0, late.delay - samples_ahead(timing.look_ahead, plant.sample_time)))


def sample_pairs(model: Any, timing: Any) -> list[Pair]:
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


def samples_of(model: Any, axis: str) -> list[AxisPlant]:
    """Return the samples of an axis of a family; none of a single model."""
    if not hasattr(model, "samples"):
        return []
    if isinstance(model, SizedPlant):
        return list(model.axes[axis].samples)
    return [axis_plant(LinearNeck(pitch=tf, roll=tf), axis) for tf in model.samples(axis)]


def over(settings: S, observer: Any) -> S:
    """Return settings for a loop with this observer; what was given stays.

    Args:
        settings: of `mpc` or `nmpc`.
        observer: whose `lead` becomes `look_ahead`, of `mpc` at most half of `least_delay`; if it tells a payload, its
            model says `payload_tautness`.

    Raises:
        SettingsError: what is no observer.
    """
    if not hasattr(observer, "lead"):
        raise SettingsError(f"an observer is needed, of `softneck observer`; got {type(observer).__name__}.")
    found: dict[str, float] = {}
    if isinstance(settings.look_ahead, NeckDefault):
        # What `least_delay` adds stands for a dead time that recordings hide, and no sensor is later for that.
        found["look_ahead"] = min(observer.lead, _BEHIND * getattr(settings, "least_delay", math.inf))
    told, wished = getattr(observer, "payloads", None), settings.minimum_tautness is not None
    asks = isinstance(getattr(settings, "payload_tautness", None), NeckDefault)
    if asks and wished and told is not None and told[1] > 0.0 and observer.robot.is_neck:
        inverse = np.linalg.inv(redefinition_matrix())
        # On top of `minimum_tautness`: what is in reserve without payload is there with it.
        found["payload_tautness"] = taut_from(observer.model, told[1], inverse) / told[1]
    return replace(settings, **found)


def taut_from(model: Model, payload: float, inverse: Matrix) -> float:
    """Return the least co-contraction [rad] from rest on at which small moves do under a payload what they can."""
    tried = np.arange(0.0, _MOST + _STEP / 2, _STEP)
    gains = np.array([_gain(model, payload, common, inverse) for common in tried])
    return float(tried[np.argmax(gains >= _TAUT * gains.max())])


def _gain(model: Model, payload: float, common: float, inverse: Matrix) -> float:
    """Return the mean static gain of small moves to both sides, of all axes."""
    block, rows = model.block(), round(_SETTLED / model.sample_time)
    motors, found = inverse.shape[0], []
    for axis in range(len(model.robot.outputs.names)):
        inputs = np.full((3 * rows, len(block.inputs)), np.nan)
        for part, side in enumerate((0.0, 1.0, -1.0)):
            inputs[part * rows : (part + 1) * rows, :motors] = common + side * _MOVE * inverse[:, axis]
        _, outputs = block.run(block.initial_state(use_measurement=0.0, payload=payload), inputs)
        found.append(abs(outputs[2 * rows - 1, axis] - outputs[-1, axis]) / (2.0 * _MOVE))
    return float(np.mean(found))
