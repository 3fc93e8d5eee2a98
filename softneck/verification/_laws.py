"""What of a controller can be judged by linear methods, and what the loop's order adds to the plant's delay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softneck.core import SettingsError, require_one_of
from softneck.estimation._axis import robot_of
from softneck.loop._loop import ORDERS
from softneck.robot import Robot
from softneck.runtime import Block

from ._linear import LinearLaw


@dataclass(frozen=True, slots=True, eq=False)
class ControllerUnderTest:
    """A controller as verification sees it.

    Attributes:
        block: what runs.
        robot: whose it is.
        laws: name -> linear form: one named "" of a linear controller, one for each frozen point of another.
        order: of the loop.
        extra: samples that the order adds to the plant's delay.
        why: why there is no linear form; "" where there is one.
    """

    block: Block
    robot: Robot
    laws: Mapping[str, LinearLaw]
    order: str
    extra: int
    why: str


def judge(controller: Any, *, order: str | None, observer: bool) -> ControllerUnderTest:
    """Return what of `controller` can be judged.

    A linear controller has `ss()` (or `to_lti()`), from (pitch_reference, roll_reference, pitch, roll) to (theta_i,
    phi_i); one that is linear at each point of operation has `ss_at(point)` and `points()`, name -> point.

    Args:
        controller: anything with `block()`.
        order: of the loop; None for the one that it was designed for.
        observer: whether the loop has one.

    Raises:
        SettingsError: no controller, or a linear form with other channels.
    """
    if not hasattr(controller, "block"):
        raise SettingsError(f"a controller is needed, one with `block()`; got {type(controller).__name__}.")
    block = controller.block()
    if block.role != "controller":
        raise SettingsError(f"a controller is needed; {block.kind} is of role {block.role}.")
    designed = str(getattr(controller, "order", "sequential"))
    chosen = designed if order is None else order
    require_one_of("order", chosen, ORDERS)
    design = getattr(controller, "design", {}) or {}
    if chosen == "sequential":
        extra = 0
    elif chosen == designed and "extra_delay" in design:
        extra = int(design["extra_delay"])
    else:
        extra = 1 + int(observer)
    laws, why = _laws(controller)
    return ControllerUnderTest(block, robot_of(controller), laws, chosen, extra, why)


def _laws(controller: Any) -> tuple[dict[str, LinearLaw], str]:
    robot = robot_of(controller)
    for name in ("ss", "to_lti"):
        if hasattr(controller, name):
            return {"": LinearLaw.of(getattr(controller, name)(), robot)}, ""
    if hasattr(controller, "ss_at") and hasattr(controller, "points"):
        points = controller.points()
        return {name: LinearLaw.of(controller.ss_at(point), robot) for name, point in points.items()}, ""
    return (
        {},
        f"the controller {controller.block().kind} has no linear form (`ss()`, or `ss_at(point)` with `points()`)",
    )
