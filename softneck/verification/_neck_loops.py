"""Loops over the user's own plants, or over the virtual neck and plausible ones around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import DataError, Progress, SettingsError
from softneck.loop import BlockPart, Loop, LoopResult, StepReference, metrics, run_loop
from softneck.plant import NeckParameters
from softneck.runtime import Block

from ._own_plants import OwnPlant, own_plant

# When the step comes [s]: after the controller took over the motors.
STEP_AT = 0.5
_AXIS = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg")
_MOTORS = ("max_rad", "limit_violation_s", "slack_s")
# An axis that moves less than this part of the step is not judged as stepped.
_SMALL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class NeckRun:
    """One loop over an own plant or the virtual neck.

    Attributes:
        name: "paper, 0.5 kg, 45 deg".
        parameters: the neck's; None of a plant that is no virtual neck.
        payload: [kg].
        orientation: of the step [rad].
        seed: of the sensor's noise.
        metrics: name -> the worse stepped axis, or of the motors; inf where a level is never reached.
        result: its signals; None where the loop broke off.
    """

    name: str
    parameters: NeckParameters | None
    payload: float
    orientation: float
    seed: int
    metrics: dict[str, float]
    result: LoopResult | None


def run_necks(
    controller: Block,
    table: Mapping[str, Any],
    *,
    order: str,
    observer: Block | None,
    seed: int,
    progress: Progress,
    own: Sequence[OwnPlant] = (),
) -> list[NeckRun]:
    """Return all runs that the table [neck] of the requirements asks for, over the user's own plants if there are any.

    Raises:
        SettingsError: controller and observer that do not fit the neck.
    """
    plants = own or _presets(table, seed)
    cases = [
        (plant, payload, angle) for plant in plants
        for payload in (table["payloads_kg"] if plant.payload else (0.0,)) for angle in table["orientations_deg"]
    ]  # fmt: skip
    runs = []
    for number, (plant, payload, angle) in enumerate(cases):
        name = f"{plant.name}, {payload:g} kg, {angle:g} deg"
        progress(number / len(cases), name)
        loop = _loop(controller, plant, float(payload), math.radians(angle), table, order, observer, seed + number)
        values, result = _judge(loop)
        runs.append(NeckRun(name, plant.parameters, float(payload), math.radians(angle), seed + number, values, result))
    return runs


def _presets(table: Mapping[str, Any], seed: int) -> list[OwnPlant]:
    """Return the preset of the table [neck] and plausible necks around it."""
    preset = NeckParameters.preset(str(table["preset"]))
    rng = np.random.default_rng(seed)
    spread = table["spread_pct"] / 100.0
    count = int(table["necks"])
    necks = [preset, *(preset.sample(rng, spread=spread) for _ in range(count - 1))][:count]
    return [
        own_plant(neck, table["preset"] if k == 0 else f"{table['preset']} varied {k}") for k, neck in enumerate(necks)
    ]


def _loop(
    controller: Block,
    plant: OwnPlant,
    payload: float,
    orientation: float,
    table: Mapping[str, Any],
    order: str,
    observer: Block | None,
    seed: int,
) -> Loop:
    size = math.radians(table["size_deg"])
    return Loop(
        plant=plant.make(seed, controller.sample_time),
        controller=BlockPart(controller),
        observer=None if observer is None else BlockPart(observer),
        reference=StepReference(pitch=size * math.cos(orientation), roll=size * math.sin(orientation), at=STEP_AT),
        duration=STEP_AT + float(table["duration_s"]),
        order=order,
        plant_inputs={"payload": payload} if plant.payload else {},
        # Nobody knows the step before it comes: a predictive controller sees the reference of now as that of later.
        connections={
            f"controller.{port.name}": f"reference.{port.name.removesuffix('_ahead')}"
            for port in controller.inputs
            if port.name.endswith("_reference_ahead")
        },
    )


def _judge(loop: Loop) -> tuple[dict[str, float], LoopResult | None]:
    try:
        result = run_loop(loop)
    except DataError:
        # Numbers overflowed: the loop is not stable, whatever its margins say.
        return dict.fromkeys((*_AXIS, *_MOTORS), math.inf), None
    table = metrics(result)
    sizes = {axis: float(np.abs(result[f"{axis}_reference"]).max()) for axis in ("pitch", "roll")}
    stepped = [axis for axis, size in sizes.items() if size > _SMALL * max(sizes.values())]
    values = {}
    for name in _AXIS:
        found = [table[axis][name] for axis in stepped]
        values[name] = (
            math.inf if any(value is None for value in found) else max(float(value or 0.0) for value in found)
        )
    told = {name: table["motors"][name] for name in _MOTORS}
    # A plant that tells no tension says nothing of slack tendons.
    values |= {name: math.nan if value is None else float(value) for name, value in told.items()}
    return values, result


def neck_changes(parameters: NeckParameters) -> dict[str, float]:
    """Return the parameters of a neck that differ from the preset `paper`."""
    plain = NeckParameters.paper()
    names = [item.name for item in dataclasses.fields(parameters)]
    return {name: getattr(parameters, name) for name in names if getattr(parameters, name) != getattr(plain, name)}


def check_blocks(controller: Block, observer: Block | None) -> None:
    """Raise SettingsError where an observer has another sample time than the controller."""
    if observer is not None and not math.isclose(observer.sample_time, controller.sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the observer has a sample time of {observer.sample_time:g} s, the controller one of "
            f"{controller.sample_time:g} s."
        )
