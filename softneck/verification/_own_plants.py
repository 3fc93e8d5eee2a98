"""The user's own nonlinear plants, in the loops of a verification: models, calibrated necks, FMUs of any tool."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from softneck.core import SettingsError, SoftneckError
from softneck.estimation._axis import robot_of
from softneck.loop import BlockPart, Part
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OwnPlant:
    """A plant that steps.

    Attributes:
        name: of its file.
        make: returns a new part, given the seed of its sensor's noise and the loop's sample time [s].
        quiet: as `make`, without noise where the plant knows how.
        payload: whether it takes one.
        parameters: of a virtual neck; None of another plant.
    """

    name: str
    make: Callable[[int, float], Part]
    quiet: Callable[[float], Part]
    payload: bool
    parameters: NeckParameters | None = None


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


def own_plant(thing: Any, name: str) -> OwnPlant:
    """Return a neck's parameters, a nonlinear model, a block, or a function that returns a part, as a plant.

    Raises:
        SettingsError: no plant, or one that does not show pitch and roll.
    """
    if isinstance(thing, NeckParameters | VirtualNeck):
        neck = thing if isinstance(thing, VirtualNeck) else VirtualNeck(thing)
        still = VirtualNeck(neck.parameters.without_noise(), neck.robot)
        return OwnPlant(
            name=name, payload=True, parameters=neck.parameters,
            make=lambda seed, Ts: BlockPart(neck.block(noise_seed=seed, sample_time=Ts)),
            quiet=lambda Ts: BlockPart(still.block(sample_time=Ts)),
        )  # fmt: skip
    if callable(thing) and not hasattr(thing, "block"):
        make = cast("Callable[[], Part]", thing)
    else:
        block: Block = thing if isinstance(thing, Block) else cast("Any", thing).block()
        make = partial(BlockPart, block)
    part = make()
    names = [port.name for port in part.outputs]
    part.close()
    if part.role != "plant" or "pitch" not in names or "roll" not in names:
        raise SettingsError(f"{name}: is no plant with the outputs pitch and roll (it has {', '.join(names)}).")
    payload = any(port.name == "payload" for port in part.inputs)
    return OwnPlant(name=name, make=lambda _seed, _Ts: make(), quiet=lambda _Ts: make(), payload=payload)
