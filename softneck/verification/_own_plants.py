"""The user's own nonlinear plants, in the loops of a verification: models, calibrated necks, FMUs of any tool."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from softneck.core import SettingsError, SoftneckError
from softneck.cosim import FmuPart
from softneck.estimation._axis import robot_of
from softneck.loop import BlockPart, Part
from softneck.plant import NeckParameters, VirtualNeck
from softneck.plant._presets import PRESETS
from softneck.robot import Robot
from softneck.robot._opened import opened
from softneck.runtime import Block

from ._requirements import Requirements
from ._steps import Steps

# Set by hand [rad]: pretension changes by some 3 % of itself.
_SAME = 0.1
# Of `adaptive` on foreign necks such margins were up to four times the true ones.
ALONE = (
    "not supported by the data: found by experiment on models alone; a controller without linear form (`ss()`) is not "
    "held against the weight over the recordings"
)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OwnPlant:
    """A plant that steps.

    Attributes:
        name: of its file.
        make: returns a new part, given the seed of its sensor's noise and the loop's sample time [s].
        quiet: as `make`, without noise where the plant knows how.
        payload: "inputs" or "parameters", as what it takes one; "" for none.
        parameters: of a virtual neck; None of another plant.
        conditions: payload and co-contraction that a model was trained at; nothing where it does not say.
    """

    name: str
    make: Callable[[int, float], Part]
    quiet: Callable[[float], Part]
    payload: str
    parameters: NeckParameters | None = None
    conditions: Mapping[str, list[float]] = field(default_factory=dict)

    def payloads(self, asked: Sequence[float]) -> list[float]:
        """Return which of the payloads asked for loops of it carry [kg]; one that is not said is 0."""
        if self.payload == "parameters":  # a model knows those between its recordings
            seen = self.conditions["payload_kg"]
            return [kg for kg in asked if _within(kg, seen)] or [min(seen)]
        return list(asked) if self.payload else [0.0]

    def carrying(self, payload: float) -> dict[str, Any]:
        """Return what says a payload [kg] to a `Loop` whose plant it is."""
        return {f"plant_{self.payload}": {"payload": payload}} if self.payload else {}


def named_plants(plants: Any, robot: str | Path | Robot | None = None) -> dict[str, Any]:
    """Return name -> plant of one, several or named plants.

    Args:
        plants: linear models, families, plants that step, or the files of any, FMUs and presets of necks among them.
        robot: whose plants they are; None: what the files say.

    Raises:
        SettingsError: what is no plant.
    """
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
        # FMUs are loaded in several threads, each of which works in the FMU's own folder for a moment.
        return partial(FmuPart, Path(item).absolute(), role="plant")
    path = Path(item) if isinstance(item, str | Path) else None
    if path is not None and (path.suffix == ".toml" or (str(item) in PRESETS and not path.exists())):
        return NeckParameters.preset(str(item))
    thing = opened(item, robot=robot)
    if not hasattr(thing, "tf") and (path is not None or not is_own_plant(thing)):
        raise SettingsError(f"{item}: a MODEL, FAMILY, NECK or FMU is needed; this is a {type(thing).__name__}.")
    return thing


def is_own_plant(thing: Any) -> bool:
    """Return whether a thing steps as a plant and has no linear form that a model or a family is judged by."""
    if isinstance(thing, NeckParameters | VirtualNeck | Block):
        return True
    if not hasattr(thing, "tf"):
        return callable(thing) or hasattr(thing, "block")
    try:
        # Every identified model has the method; nonlinear ones refuse.
        thing.tf(robot_of(thing).outputs.names[0])
    except SoftneckError:
        return hasattr(thing, "block")
    return False


def own_plant(thing: Any, name: str, robot: Robot | None = None) -> OwnPlant:
    """Return a neck's parameters, a nonlinear model, a block, or a function that returns a part, as a plant.

    Raises:
        SettingsError: no plant, or one that does not show pitch and roll, or another robot's outputs.
    """
    if isinstance(thing, NeckParameters | VirtualNeck):
        neck = thing if isinstance(thing, VirtualNeck) else VirtualNeck(thing)
        still = VirtualNeck(neck.parameters.without_noise(), neck.robot)
        return OwnPlant(
            name=name, payload="inputs", parameters=neck.parameters,
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
        raise SettingsError(f"{name}: a function that is a plant returns a part; this one a {type(part).__name__}.")
    names = [port.name for port in part.outputs]
    part.close()
    outputs = (robot or Robot.preset()).outputs.names
    if part.role != "plant" or not set(outputs) <= set(names):
        raise SettingsError(
            f"{name}: is no plant with the outputs {' and '.join(outputs)} (it has {', '.join(names)})."
        )
    known = getattr(thing, "findings", {}).get("conditions", {})
    settable = part.block.parameters if isinstance(part, BlockPart) and "payload_kg" in known else ()
    taken = {"inputs": part.inputs, "parameters": settable}
    payload = next((how for how, ports in taken.items() if any(port.name == "payload" for port in ports)), "")
    return OwnPlant(
        name=name, make=lambda _seed, _Ts: make(), quiet=lambda _Ts: make(), payload=payload, conditions=known
    )  # fmt: skip


def not_recorded(tested: Mapping[str, Any], own: Sequence[OwnPlant], steps: Steps) -> dict[str, str]:
    """Return why nothing is known of the "loop" and of plants that step, "neck"; nothing where all was recorded.

    Args:
        tested: by the names of families, what each says of its recordings.
        own: plants that step.
        steps: which show where the loop holds the motors.
    """
    half = steps.motors.shape[2] // 2
    # Of most plants: where motors reach their limits their mean is another.
    held = float(np.median(steps.motors[:, :, half - 1].mean(axis=-1)))
    found: dict[str, str] = {}
    for name, item in tested.items():
        made = item.get("conditions", [])
        for kg in sorted({value for part in made for value in part["payload_kg"]}):
            if not any(_carries(plant, kg, held) for plant in own):
                found["neck"] = (
                    f"not supported by the data: {name} was recorded with {kg:g} kg, and no plant that steps carries "
                    f"that at a co-contraction of {held:.2g} rad; `softneck identify greybox` a recording that does, "
                    "or calibrate a neck to it (`softneck.calibrate` in Python)"
                )
            at = [end for part in made if _within(kg, part["payload_kg"]) for end in part["cocontraction"]]
            if not _within(held, at, _SAME):
                found["loop"] = (
                    f"not supported by the data: the loop holds its motors at a co-contraction of {held:.2g} rad, and "
                    f"with {kg:g} kg {name} was recorded at {min(at):.2g} to {max(at):.2g} rad; design with such a "
                    "`least_cocontraction`, or record around the loop's (`softneck record --cocontraction`)"
                )
    return found


def payloads_left_out(own: Sequence[OwnPlant], asked: Requirements) -> dict[str, str]:
    """Return which of the payloads asked for no loop of a plant carried, as it knows none; nothing where all did."""
    wanted = [kg for kg in asked.neck["payloads_kg"] if kg > 0.0]
    left = {plant.name: [f"{kg:g}" for kg in wanted if kg not in plant.payloads(wanted)] for plant in own}
    said = [
        f"no loop of {name} carries {', '.join(heavy)} kg, which it does not know"
        for name, heavy in left.items()
        if heavy
    ]
    if not (said and asked.robot.is_neck):
        return {}
    way = "`softneck identify greybox` recordings that say theirs, in a column `payload [kg]`"
    return {"loops with payload": f"{'; '.join(said)}; {way}"}


def _carries(plant: OwnPlant, kg: float, held: float) -> bool:
    """Return whether a plant takes any payload, or was made from recordings with this one and where the loop is."""
    known = plant.conditions
    return plant.payload == "inputs" or (
        _within(kg, known.get("payload_kg", [0.0])) and _within(held, known.get("cocontraction", [held]), _SAME)
    )


def _within(value: float, ends: Sequence[float], more: float = 0.0) -> bool:
    return min(ends) - more <= value <= max(ends) + more
