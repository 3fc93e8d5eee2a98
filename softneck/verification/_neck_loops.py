"""Loops over simulation models: the user's, or a robot's virtual plant and random ones near it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np

from softneck.core import DataError, Progress, SettingsError, SoftneckError, Vector, to_si, worst
from softneck.cosim import FmuPart
from softneck.estimation import robot_of
from softneck.loop import BlockPart, Loop, LoopResult, Part, Reference, RobotReference, metrics, run_loop
from softneck.plant import PRESETS, NeckParameters, VirtualNeck
from softneck.robot import Robot, Scaling, load_for_robot
from softneck.runtime import Block

from ._experiments import LEAD_IN_S, REST_S, LoopUnderTest, connections_without_preview, smooth_rise
from ._metrics import Scale
from ._requirements import Requirements
from ._steps import Steps, middle_motors, middle_of

# Set by hand: the pretension changes by some 3 %.
_COCONTRACTION_TOLERANCE_RAD = 0.1
# On held-out robots such margins of `adaptive` were up to four times the true ones.
ALONE = (
    "not supported by the data: found by experiment on models alone; a controller without linear form (`ss()`) is not "
    "checked against the recordings"
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SimulationModel:
    """A simulation model of the robot.

    `name`: of its file. `make`: returns a new part, given the seed of its sensor's noise and the loop's sample time
    [s]. `quiet`: as `make`, without noise if the plant can. `payload`: "inputs" or "parameters" that set it, or "".
    `parameters`: of a virtual neck; else None. `conditions`: payload and co-contraction of the training data, if known.
    `thing`: what it was made of.
    """

    name: str
    make: Callable[[int, float], Part]
    quiet: Callable[[float], Part]
    payload: str
    parameters: NeckParameters | None = None
    conditions: Mapping[str, list[float]] = field(default_factory=dict)
    thing: Any = None

    def payloads(self, asked: Sequence[float]) -> list[float]:
        """Return the payloads [kg] that stand for those asked: the nearest known ones, and the ends of the recordings.

        A plant without payload has 0 alone.
        """
        if self.payload != "parameters":
            return sorted({float(kg) for kg in asked}) if self.payload else [0.0]
        ends = {float(min(self.conditions["payload_kg"])), float(max(self.conditions["payload_kg"]))}
        return sorted(ends | {self.nearest_payload(kg) for kg in asked})

    def nearest_payload(self, asked: float) -> float:
        """Return the payload [kg] at which one that is asked is judged: a model is valid between its recordings."""
        if self.payload != "parameters":
            return float(asked) if self.payload else 0.0
        seen = self.conditions["payload_kg"]
        return float(min(max(asked, min(seen)), max(seen)))

    def carrying(self, payload: float) -> dict[str, Any]:
        """Return the arguments of `Loop` that set a payload [kg]."""
        return {f"plant_{self.payload}": {"payload": payload}} if self.payload else {}


def named_plants(plants: Any, robot: str | Path | Robot | None = None) -> dict[str, Any]:
    """Return name -> plant of one, several or named plants, objects or files; else raise SettingsError."""
    if isinstance(plants, Mapping):
        named = {str(name): plant for name, plant in plants.items()}
    else:
        named, items = {}, list(plants) if isinstance(plants, list | tuple) else [plants]
        for number, item in enumerate(items, start=1):
            own = Path(item).name if isinstance(item, str | Path) else f"plant {number}" if len(items) > 1 else "plant"
            named[str(item) if own in named else own] = item
    return {name: _opened_plant(item, robot) for name, item in named.items()}


def _opened_plant(item: Any, robot: str | Path | Robot | None) -> Any:
    if isinstance(item, str | Path) and Path(item).suffix == ".fmu":
        # Loading an FMU changes the folder for a moment, in several threads.
        return partial(FmuPart, Path(item).absolute(), role="plant")
    path = Path(item) if isinstance(item, str | Path) else None
    if path is not None and (path.suffix == ".toml" or (str(item) in PRESETS and not path.exists())):
        return NeckParameters.preset(str(item))
    thing = load_for_robot(item, robot=robot)
    if not hasattr(thing, "tf") and (path is not None or not is_simulation_model(thing)):
        raise SettingsError(f"{item}: a MODEL, FAMILY, NECK or FMU is needed; this is a {type(thing).__name__}.")
    return thing


def is_simulation_model(thing: Any) -> bool:
    """Return whether an object steps as a plant and has no linear form."""
    if isinstance(thing, NeckParameters | VirtualNeck | Block):
        return True
    if not hasattr(thing, "tf"):
        return callable(thing) or hasattr(thing, "block")
    try:
        # Every identified model has the method; nonlinear ones raise.
        thing.tf(robot_of(thing).outputs.names[0])
    except SoftneckError:
        return hasattr(thing, "block")
    return False


def make_simulation_model(thing: Any, name: str, robot: Robot | None = None) -> SimulationModel:
    """Return neck parameters, a nonlinear model, a block, or a function that returns a part, as a simulation model."""
    if isinstance(thing, NeckParameters | VirtualNeck):
        neck = thing if isinstance(thing, VirtualNeck) else VirtualNeck(thing)
        still = VirtualNeck(neck.parameters.without_noise(), neck.robot)
        return SimulationModel(
            name=name, payload="inputs", parameters=neck.parameters, thing=neck,
            make=lambda seed, Ts: BlockPart(neck.block(noise_seed=seed, sample_time=Ts)),
            quiet=lambda Ts: BlockPart(still.block(sample_time=Ts)),
        )  # fmt: skip
    if callable(thing) and not hasattr(thing, "block"):
        make = cast("Callable[[], Part]", thing)
    else:
        block: Block = thing if isinstance(thing, Block) else cast("Any", thing).block()
        make = partial(BlockPart, block)
    part = make()
    if not hasattr(part, "outputs"):
        raise SettingsError(f"{name}: a plant function must return a part; got a {type(part).__name__}.")
    names = [port.name for port in part.outputs]
    part.close()
    outputs = (robot or Robot.preset()).outputs.names
    if part.role != "plant" or not set(outputs) <= set(names):
        raise SettingsError(
            f"{name}: needs the outputs {' and '.join(outputs)} of a plant (it has {', '.join(names)})."
        )
    known = getattr(thing, "findings", {}).get("conditions", {})
    settable = part.block.parameters if isinstance(part, BlockPart) and "payload_kg" in known else ()
    taken = {"inputs": part.inputs, "parameters": settable}
    payload = next((how for how, ports in taken.items() if any(port.name == "payload" for port in ports)), "")
    return SimulationModel(
        name=name, make=lambda _seed, _Ts: make(), quiet=lambda _Ts: make(), payload=payload, conditions=known,
        thing=thing,
    )  # fmt: skip


def unrecorded_conditions(
    tested: Mapping[str, Any], own: Sequence[SimulationModel], steps: Steps, robot: Robot | None = None
) -> dict[str, str]:
    """Return why the recordings do not support "loop" or "sim"; `steps` give the loop's co-contraction."""
    robot = robot or Robot.preset()
    if robot.tendon_angles is None:
        return {}
    factor, unit = to_si(robot.motors.unit)[0], robot.motors.unit
    same = _COCONTRACTION_TOLERANCE_RAD * Scaling.of(robot).motor_unit
    half = steps.motors.shape[2] // 2
    # The median, as the mean of motors at their limits differs.
    held = float(np.median(steps.motors[:, :, half - 1].mean(axis=-1)))
    found: dict[str, str] = {}
    for name, item in tested.items():
        made = item.get("conditions", [])
        for kg in sorted({value for part in made for value in part["payload_kg"]}):
            if not any(_covers(plant, kg, held) for plant in own):
                found["sim"] = (
                    f"not supported by the data: {name} was recorded with {kg:g} kg, and no simulation model covers "
                    f"that at a co-contraction of {held / factor:.2g} {unit}; run `softneck identify greybox` on a "
                    "recording that does, or calibrate a neck to it (`softneck.calibrate` in Python)"
                )
            at = [end for part in made if _within(kg, part["payload_kg"]) for end in part["cocontraction"]]
            if not _within(held, at, same):
                found["loop"] = (
                    f"not supported by the data: the loop holds its motors at a co-contraction of {held / factor:.2g} "
                    f"{unit}, and with {kg:g} kg {name} was recorded at {min(at) / factor:.2g} to "
                    f"{max(at) / factor:.2g} {unit}; design with such a "
                    "`least_cocontraction`, or record around the loop's (`softneck record --cocontraction`)"
                )
    return found


def judged_elsewhere(own: Sequence[SimulationModel], asked: Requirements) -> dict[str, str]:
    """Return condition -> what is judged instead of it, for each that was asked and is not judged as it is."""
    found: dict[str, str] = {}
    way = "run `softneck identify greybox` on recordings with a column `payload [kg]`"
    for plant in own:
        seen = plant.conditions.get("payload_kg", [0.0])
        span = f"{min(seen):g} kg" if min(seen) == max(seen) else f"{min(seen):g} to {max(seen):g} kg"
        for kg in asked.sim["payloads_kg"]:
            # Nobody loads another robot's plant that has no payload.
            known = plant.payload == "parameters" or (not plant.payload and asked.robot.neck is not None)
            if known and not _within(kg, seen):
                at = f"judged at {plant.nearest_payload(kg):g} kg" if plant.payload else "judged as recorded"
                found[f"payload {kg:g} kg of {plant.name}"] = f"{at}, it was recorded with {span}; {way}"
    names, angles = asked.robot.outputs.names, asked.own.get("sim", {}).get("orientations_deg")
    if len(names) == 1 and angles:
        found["directions"] = f"{names[0]} is the only output, so all of `orientations_deg` are one step"
    if len(names) > 2:
        found["directions"] = f"simulated steps are of {names[0]} and {names[1]} alone, not of {', '.join(names[2:])}"
    return found


def _covers(plant: SimulationModel, kg: float, held: float) -> bool:
    """Return whether a plant takes any payload, or was identified at this payload and co-contraction."""
    known = plant.conditions
    return plant.payload == "inputs" or (
        _within(kg, known.get("payload_kg", [0.0]))
        and _within(held, known.get("cocontraction", [held]), _COCONTRACTION_TOLERANCE_RAD)
    )


def _within(value: float, ends: Sequence[float], more: float = 0.0) -> bool:
    return min(ends) - more <= value <= max(ends) + more


# Time of the step: after the controller took over the motors, or has tightened the tendons.
_STEP_AT_S, _STEP_AT_TAUT_S = 0.5, 3.0
_AXIS_METRICS = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg")
_MOTOR_METRICS = ("max_rad", "limit_violation_s", "slack_s")
# Smallest share of the step for an axis to count as stepped.
_STEPPED_SHARE = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class LoopRun:
    """One loop over a simulation model.

    `name`: "paper, 0.5 kg, 45 deg". `parameters`: of a virtual neck; else None. `payload`: [kg]. `orientation`: of the
    step [rad]. `seed`: of the sensor's noise. `metrics`: name -> value of the worst stepped axis, or of the motors; inf
    where a level is never reached. `result`: its signals; None if the loop diverged.
    """

    name: str
    parameters: NeckParameters | None
    payload: float
    orientation: float
    seed: int
    metrics: dict[str, float]
    result: LoopResult | None


def why_no_virtual_plant(robot: Robot, asked: Requirements) -> str:
    """Return why there are no loops over a virtual plant, or ""."""
    if not asked.sim["necks"]:
        return "loops over the virtual neck are switched off (necks = 0)"
    try:
        virtual_plant(robot, asked)
    except SettingsError as error:
        if robot.neck is not None or "preset" in asked.own.get("sim", {}):
            raise
        return f"no virtual plant stands for `{robot.name}`: {error}"
    return ""


def preset_of(asked: Requirements) -> str:
    """Return the preset or neck file of the loops: the required one, else the robot's."""
    own = asked.own.get("sim", {}).get("preset", asked.robot.neck)
    return str(asked.sim["preset"] if own is None else own)


def virtual_plant(robot: Robot, asked: Requirements) -> tuple[str, VirtualNeck]:
    """Return name and plant of the required preset, else of the robot."""
    given = asked.own.get("sim", {}).get("preset")
    plant = VirtualNeck.of(robot, None if given is None else NeckParameters.preset(str(given)))
    return preset_of(asked), plant


def neck_file_of(robot: Robot, asked: Requirements) -> Path:
    """Return the preset or the path of the neck file of the loops."""
    given = "preset" in asked.own.get("sim", {})
    return Path(preset_of(asked)) if given or robot.folder is None else robot.folder / preset_of(asked)


def direction(orientation: float, robot: Robot) -> tuple[float, ...]:
    """Return the share of each output in a step of an orientation [rad]."""
    outputs = len(robot.outputs.names)
    return (math.cos(orientation), math.sin(orientation), *[0.0] * (outputs - 2))[:outputs]


def step_time(controller: Block, asked: Requirements) -> float:
    """Return the time of the step [s]."""
    pulls = any(port.name == "least_cocontraction" and (port.start or 0.0) > 0.0 for port in controller.parameters)
    away = start_of(asked.robot).any()
    return asked.scale.time * (REST_S if away else _STEP_AT_TAUT_S if pulls else _STEP_AT_S)


def start_of(robot: Robot) -> Vector:
    """Return the outputs (outputs,) [SI] from which loops step: their middle, but zero where tendons bend to it."""
    ends = zip(robot.outputs.min or (), robot.outputs.max or (), strict=True)
    upright = robot.tendon_angles is not None and all(low <= 0.0 <= high for low, high in ends)
    return np.zeros(len(robot.outputs.names)) if upright else middle_of(robot)


@dataclass(frozen=True, slots=True)
class AroundMiddle:
    """A smooth motion to `outputs` and `cocontraction` [SI] over `lead` [s], to which a reference is added."""

    reference: Reference
    outputs: tuple[float, ...]
    cocontraction: float
    lead: float
    repeats: ClassVar[bool] = True  # equal ones have equal samples: `run_loop` keeps them

    @classmethod
    def of(cls, reference: Reference, controller: Block, asked: Requirements) -> Reference:
        """Return a reference about the middle of the robot; as it is where loops start there."""
        start = start_of(asked.robot)
        if not start.any():
            return reference
        common = float(middle_motors(asked.robot, controller).mean())
        return cls(reference, tuple(start.tolist()), common, asked.scale.time * LEAD_IN_S)

    def __call__(self, time: float, /) -> tuple[float, ...]:
        """Return the reference at `time` [s]: all outputs, then co-contraction."""
        led, (*values, common) = smooth_rise(time, self.lead), self.reference(time)
        moved = (led * there + value for there, value in zip(self.outputs, values, strict=True))
        return (*moved, common or led * self.cocontraction)


def without_lead(result: LoopResult, reference: object) -> LoopResult:
    """Return the rows of a result after the motion to the middle, if the reference begins with one."""
    first = int(np.searchsorted(result.time, reference.lead)) if isinstance(reference, AroundMiddle) else 0
    return rows_of(result, first, result.time.size) if first else result


def rows_of(result: LoopResult, first: int, stop: int) -> LoopResult:
    """Return rows `first` to `stop` of a result."""
    signals = {name: values[first:stop] for name, values in result.signals.items()}
    return replace(result, time=result.time[first:stop], signals=signals)


def run_loops(
    controller: Block, asked: Requirements, *, order: str, observer: Block | None, seed: int, progress: Progress,
    own: Sequence[SimulationModel] = (),
) -> list[LoopRun]:  # fmt: skip
    """Run all loops of the table [sim], over the user's simulation models if there are any."""
    table, robot = asked.sim, asked.robot
    plants = own or _virtual(asked, seed)
    # With one output all orientations are the same step.
    angles = table["orientations_deg"] if len(robot.outputs.names) > 1 else [0.0]
    cases = [
        (plant, payload, angle) for plant in plants
        for payload in plant.payloads(table["payloads_kg"]) for angle in angles
    ]  # fmt: skip
    runs, size, at = [], asked.scale.si(float(table["size_deg"])), step_time(controller, asked)
    for number, (plant, payload, angle) in enumerate(cases):
        words = [f"{payload:g} kg"] * bool(plant.payload) + [f"{angle:g} deg"] * (len(robot.outputs.names) > 1)
        name = ", ".join([plant.name, *words])
        progress(number / len(cases), name)
        ends = tuple(size * share for share in direction(math.radians(angle), robot))
        loop = step_loop(
            controller, plant.make(seed + number, controller.sample_time), plant, float(payload),
            RobotReference(kind="step", values=ends, at=at), asked, duration=at + float(table["duration_s"]),
            order=order, observer=observer,
        )  # fmt: skip
        values, result = judge_loop(loop)
        runs.append(LoopRun(name, plant.parameters, float(payload), math.radians(angle), seed + number, values, result))
    return runs


def _virtual(asked: Requirements, seed: int) -> list[SimulationModel]:
    """Return the virtual plant of the table [sim] and random ones near it."""
    table = asked.sim
    base, plant = virtual_plant(asked.robot, asked)
    rng = np.random.default_rng(seed)
    spread = table["spread_pct"] / 100.0
    count = int(table["necks"])
    necks = [plant.parameters, *(_sample_neck(plant, rng, spread) for _ in range(count - 1))][:count]
    return [
        make_simulation_model(VirtualNeck(neck, asked.robot), base if k == 0 else f"{base} varied {k}")
        for k, neck in enumerate(necks)
    ]


def _sample_neck(plant: VirtualNeck, rng: np.random.Generator, spread: float) -> NeckParameters:
    """Return random parameters near those of a neck that its tendons do not buckle."""
    for _ in range(100):
        found = plant.parameters.sample(rng, spread=spread)
        try:
            return VirtualNeck(found, plant.robot).parameters
        except SettingsError:
            continue
    raise SettingsError(f"no random neck within a spread of {spread:g} supports its tendons; lower `spread_pct`.")


def step_loop(
    controller: Block, part: Part, plant: SimulationModel, payload: float, reference: Any, asked: Requirements, *,
    duration: float, order: str, observer: Block | None, faults: Sequence[Any] = (),
) -> Loop:  # fmt: skip
    """Return the loop over a part of a simulation model."""
    return Loop(
        plant=part, controller=BlockPart(controller), observer=None if observer is None else BlockPart(observer),
        reference=AroundMiddle.of(reference, controller, asked), duration=duration, order=order, robot=asked.robot,
        **plant.carrying(payload),
        faults=tuple(faults),
        connections=connections_without_preview(controller),
    )  # fmt: skip


def judge_loop(
    loop: Loop, *, compiled: bool = False, angle: str = "true"
) -> tuple[dict[str, float], LoopResult | None]:
    """Run a step; return metrics of the worst axis and the motors, and signals (inf and None if it diverged).

    `angle` is "true" or "measured".
    """
    try:
        result = run_loop(loop, compiled=compiled)
    except DataError:
        # Overflow: the loop is unstable.
        return step_metrics(None), None
    return step_metrics(without_lead(result, loop.reference), angle=angle), result


def step_metrics(result: LoopResult | None, *, angle: str = "true") -> dict[str, float]:
    """Return the metrics of the worst stepped axis and of the motors; inf for a loop that diverged, None."""
    if result is None:
        return dict.fromkeys((*_AXIS_METRICS, *_MOTOR_METRICS), math.inf)
    table, robot = metrics(result, angle=angle), result.robot
    names = Scale(robot=robot).name_of
    sizes = {axis: float(np.ptp(result[f"{axis}_reference"])) for axis in robot.outputs.names}
    stepped = [axis for axis, size in sizes.items() if size > _STEPPED_SHARE * max(sizes.values())]
    values = {}
    for name in _AXIS_METRICS:
        found = [table[axis][names(name)] for axis in stepped]
        values[name] = worst(name, [math.nan if value is None else value for value in found])
    told = {name: table["motors"][names(name)] for name in _MOTOR_METRICS}
    # A plant without tension outputs has no slack metric.
    values |= {name: math.nan if value is None else float(value) for name, value in told.items()}
    return values


def loops_under_test(
    controller: Block, own: Sequence[SimulationModel], asked: Requirements, *, order: str, observer: Block | None
) -> list[LoopUnderTest]:
    """Return the loops for margins by experiment: each simulation model with its lightest and heaviest payload."""
    robot, scale = asked.robot, asked.scale
    names = robot.outputs.names
    axes = names if len(names) == 1 else (*names, "both")
    known = [(plant, plant.payloads(asked.sim["payloads_kg"])) for plant in own]
    return [
        LoopUnderTest(
            name=f"{plant.name}, {kg:g} kg" if plant.payload else plant.name, controller=controller,
            plant=lambda plant=plant: plant.quiet(controller.sample_time), observer=observer,
            order=order, constants=plant.carrying(kg),
            # The heavy payload is tested with all axes at once, the harder test.
            axes=axes if kg == min(payloads) else axes[-1:], robot=robot, time=scale.time,
            size=scale.si(scale.size) / math.radians(1.0), noise=scale.si(scale.noise) / math.radians(1.0),
        )
        for plant, payloads in known for kg in sorted({float(min(payloads)), float(max(payloads))})
    ]  # fmt: skip


def neck_changes(parameters: NeckParameters, robot: Robot) -> dict[str, float]:
    """Return the parameters of a robot's neck that differ from the scaled preset `paper`."""
    plain = VirtualNeck.of(robot, NeckParameters.paper()).parameters
    names = [item.name for item in dataclasses.fields(parameters)]
    return {name: getattr(parameters, name) for name in names if getattr(parameters, name) != getattr(plain, name)}


def check_blocks(controller: Block, observer: Block | None) -> None:
    """Raise SettingsError if the observer has another sample time than the controller."""
    if observer is not None and not math.isclose(observer.sample_time, controller.sample_time, rel_tol=1e-9):
        raise SettingsError(
            f"the observer has a sample time of {observer.sample_time:g} s, the controller one of "
            f"{controller.sample_time:g} s."
        )
