"""Loops over the user's own plants, or over a robot's virtual plant and plausible ones around it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from softneck.core import DataError, Progress, SettingsError
from softneck.loop import BlockPart, Loop, LoopResult, StepReference, metrics, run_loop
from softneck.loop._robot_references import RobotReference
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot
from softneck.runtime import Block

from ._experiments import LoopUnderTest
from ._own_plants import OwnPlant, own_plant
from ._requirements import Requirements, metric_ends

# When the step comes [s]: after the controller took over the motors, or has pulled tendons taut.
_STEP_AT, _TAUT_AT = 0.5, 3.0
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


def no_virtual_plant(robot: Robot, asked: Requirements) -> str:
    """Return why there are no loops over a virtual plant; "" where there are."""
    if not asked.neck["necks"]:
        return "no loops over the virtual neck were asked for (necks = 0)"
    try:
        virtual_plant(robot, asked)
    except SettingsError as error:
        if robot.is_neck or "preset" in asked.own.get("neck", {}):
            raise
        return f"no virtual plant stands for `{robot.name}`: {error}"
    return ""


def virtual_plant(robot: Robot, asked: Requirements) -> tuple[str, VirtualNeck]:
    """Return the virtual plant that is asked for, of another robot its own where nobody says otherwise, by its name."""
    if robot.is_neck:
        return str(asked.neck["preset"]), VirtualNeck(NeckParameters.preset(str(asked.neck["preset"])))
    given = asked.own.get("neck", {}).get("preset")
    plant = VirtualNeck.of(robot, None if given is None else NeckParameters.preset(str(given)))
    return str(robot.neck if given is None else given), plant


def neck_file_of(robot: Robot, asked: Requirements) -> Path:
    """Return what names the physics of the loops: a preset or a neck file."""
    if robot.is_neck or "preset" in asked.own.get("neck", {}):
        return Path(str(asked.neck["preset"]))
    return (robot.folder or Path()) / str(robot.neck)


def direction(orientation: float, robot: Robot) -> tuple[float, ...]:
    """Return the share of each output in a step of an orientation [rad]."""
    outputs = len(robot.outputs.names)
    return (math.cos(orientation), math.sin(orientation), *[0.0] * (outputs - 2))[:outputs]


def step_at(controller: Block) -> float:
    """Return when the step comes [s]."""
    pulls = any(port.name == "least_cocontraction" and (port.start or 0.0) > 0.0 for port in controller.parameters)
    return _TAUT_AT if pulls else _STEP_AT


def run_necks(
    controller: Block,
    asked: Requirements,
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
    table, robot = asked.neck, asked.robot
    plants = own or _virtual(asked, seed)
    # One output bends in one plane: other orientations are the same step, or none.
    angles = table["orientations_deg"] if len(robot.outputs.names) > 1 else [0.0]
    cases = [
        (plant, payload, angle) for plant in plants
        for payload in plant.payloads(table["payloads_kg"]) for angle in angles
    ]  # fmt: skip
    runs = []
    for number, (plant, payload, angle) in enumerate(cases):
        name = f"{plant.name}, {payload:g} kg, {angle:g} deg"
        progress(number / len(cases), name)
        loop = _loop(controller, plant, float(payload), math.radians(angle), asked, order, observer, seed + number)
        values, result = judge_loop(loop)
        runs.append(NeckRun(name, plant.parameters, float(payload), math.radians(angle), seed + number, values, result))
    return runs


def _virtual(asked: Requirements, seed: int) -> list[OwnPlant]:
    """Return the virtual plant that the table [neck] asks for and plausible ones around it."""
    table = asked.neck
    base, plant = virtual_plant(asked.robot, asked)
    rng = np.random.default_rng(seed)
    spread = table["spread_pct"] / 100.0
    count = int(table["necks"])
    necks = [plant.parameters, *(_near(plant, rng, spread) for _ in range(count - 1))][:count]
    return [
        own_plant(VirtualNeck(neck, asked.robot), base if k == 0 else f"{base} varied {k}")
        for k, neck in enumerate(necks)
    ]


def _near(plant: VirtualNeck, rng: np.random.Generator, spread: float) -> NeckParameters:
    """Return a plausible neck around a robot's that its tendons do not buckle."""
    for _ in range(100):
        found = plant.parameters.sample(rng, spread=spread)
        try:
            return VirtualNeck(found, plant.robot).parameters
        except SettingsError:
            continue
    raise SettingsError(f"no plausible neck within a spread of {spread:g} holds its tendons; lower `spread_pct`.")


def _loop(
    controller: Block,
    plant: OwnPlant,
    payload: float,
    orientation: float,
    asked: Requirements,
    order: str,
    observer: Block | None,
    seed: int,
) -> Loop:
    size, robot, at = asked.si(float(asked.neck["size_deg"])), asked.robot, step_at(controller)
    ends = tuple(size * share for share in direction(orientation, robot))
    reference = (
        StepReference(pitch=ends[0], roll=ends[1], at=at) if robot.is_neck
        else RobotReference(kind="step", values=ends, at=at)
    )  # fmt: skip
    return Loop(
        plant=plant.make(seed, controller.sample_time),
        controller=BlockPart(controller),
        observer=None if observer is None else BlockPart(observer),
        reference=reference,
        duration=at + float(asked.neck["duration_s"]),
        order=order,
        robot=robot,
        **plant.carrying(payload),
        # Nobody knows the step before it comes: a predictive controller sees the reference of now as that of later.
        connections={
            f"controller.{port.name}": f"reference.{port.name.removesuffix('_ahead')}"
            for port in controller.inputs
            if port.name.endswith("_reference_ahead")
        },
    )


def judge_loop(
    loop: Loop, *, compiled: bool = False, angle: str = "true"
) -> tuple[dict[str, float], LoopResult | None]:
    """Return the metrics of a step, the worse axis and the motors, and the signals; all inf and None if it broke.

    Args:
        loop: that is run.
        compiled: as one function where all parts are blocks.
        angle: "true", or "measured" as the sensor tells.
    """
    try:
        result = run_loop(loop, compiled=compiled)
    except DataError:
        # Numbers overflowed: the loop is not stable, whatever its margins say.
        return dict.fromkeys((*_AXIS, *_MOTORS), math.inf), None
    table, robot = metrics(result, angle=angle), result.robot
    names = metric_ends(robot)
    sizes = {axis: float(np.abs(result[f"{axis}_reference"]).max()) for axis in robot.outputs.names}
    stepped = [axis for axis, size in sizes.items() if size > _SMALL * max(sizes.values())]
    values = {}
    for name in _AXIS:
        found = [table[axis][names(name)] for axis in stepped]
        values[name] = (
            math.inf if any(value is None for value in found) else max(float(value or 0.0) for value in found)
        )
    told = {name: table["motors"][names(name)] for name in _MOTORS}
    # A plant that tells no tension says nothing of slack tendons.
    values |= {name: math.nan if value is None else float(value) for name, value in told.items()}
    return values, result


def loops_under_test(
    controller: Block, own: Sequence[OwnPlant], asked: Requirements, *, order: str, observer: Block | None, robot: Robot
) -> list[LoopUnderTest]:
    """Return the loops for margins by experiment: each plant that steps, with its lightest and its heaviest payload.

    Args:
        controller, observer: that are judged.
        own: plants that step.
        asked: whose payloads count, and how slow and large the robot is.
        order: of the loop.
        robot: whose it is.
    """
    names = robot.outputs.names
    axes = names if len(names) == 1 else (*names, "both")  # one output is all of them
    known = [(plant, plant.payloads(asked.neck["payloads_kg"])) for plant in own]
    return [
        LoopUnderTest(
            name=f"{plant.name}, {kg:g} kg" if plant.payload else plant.name, controller=controller,
            plant=lambda plant=plant: plant.quiet(controller.sample_time), observer=observer,
            order=order, constants=plant.carrying(kg),
            # Each axis alone with the light payload; with the heavy one both at once, which is the harder test.
            axes=axes if kg == min(payloads) else axes[-1:], robot=robot, time=asked.scale[0],
            size=1.0 if robot.is_neck else asked.si(math.degrees(asked.scale[1])),
        )
        for plant, payloads in known for kg in sorted({float(min(payloads)), float(max(payloads))})
    ]  # fmt: skip


def neck_changes(parameters: NeckParameters, robot: Robot) -> dict[str, float]:
    """Return the parameters of a robot's neck that differ from the preset `paper` standing for it."""
    plain = NeckParameters.paper() if robot.is_neck else VirtualNeck.of(robot, NeckParameters.paper()).parameters
    names = [item.name for item in dataclasses.fields(parameters)]
    return {name: getattr(parameters, name) for name in names if getattr(parameters, name) != getattr(plain, name)}


def check_blocks(controller: Block, observer: Block | None) -> None:
    """Raise SettingsError where an observer has another sample time than the controller."""
    if observer is not None and not math.isclose(observer.sample_time, controller.sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the observer has a sample time of {observer.sample_time:g} s, the controller one of "
            f"{controller.sample_time:g} s."
        )
