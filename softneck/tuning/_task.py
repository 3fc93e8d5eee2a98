"""What is tuned: plants, requirements and whose controller, as one thing that goes to every worker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softneck.core import KINDS, resolve, to_si
from softneck.identification import Model
from softneck.robot import Robot

from ._requirements import TuneRequirements


def has_observer(kind: str) -> bool:
    """Return whether loops of a kind have an observer: designed for it."""
    return hasattr(resolve(KINDS[kind].settings), "over")


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Task:
    """All that a worker must know to judge a candidate.

    Attributes:
        digest: of all that follows; workers keep what they have made ready by it.
        linear: by name, models and families.
        own: by name, plants that step.
        asked: the requirements.
        robot: whose controller is tuned.
        cocontraction: at which the loops are held [rad, else SI]; None: by the controller's own rule.
        seed: of the noise.
        observer: of the loops of kinds that have one (`mpc`, `nmpc`); None: these have none either.
    """

    digest: str
    linear: Mapping[str, Any]
    own: Mapping[str, Any]
    asked: TuneRequirements
    robot: Robot
    cocontraction: float | None = None
    seed: int = 0
    observer: Any = None

    @property
    def said_cocontraction(self) -> float | None:
        """As settings and loop files say it: in the unit of the robot's motors."""
        factor = to_si(self.robot.motors.unit)[0]
        return None if self.cocontraction is None else float(f"{self.cocontraction / factor:.4g}")

    @property
    def tested(self) -> bool:
        """Whether a family was tested against its recordings."""
        return any(getattr(thing, "measured", {}) for thing in self.linear.values())

    @property
    def models(self) -> list[Model]:
        """Nonlinear models among the plants that step."""
        return [thing for thing in self.own.values() if isinstance(thing, Model)]

    @property
    def plant(self) -> Any:
        """What controllers are designed on: the first of several linear sources is the nominal plant."""
        sources = list(self.linear.values())
        return sources[0] if len(sources) == 1 else sources
