"""Disturbances that are measured and whose effect on the angles is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_between, require_finite
from softneck.robot import Robot

# An estimated payload trembles: co-contraction follows it as slowly as nobody waits for [s].
_SEEN = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredDisturbance:
    """An input of the controller that adds `gain / (1 + time s)` times itself to the outputs.

    Attributes:
        name: of the port, such as "base_tilt_pitch".
        unit: SI unit of the port.
        pitch, roll: static gains [rad per unit].
        time: time constant [s]; 0 for at once.
        gains: static gains on the outputs of another robot, by their names [SI unit of the output per unit].
        tautness: what it adds to `minimum_tautness` of a neck, over the same time [rad of motor per unit].
    """

    name: str
    pitch: float = 0.0
    roll: float = 0.0
    time: float = 0.0
    unit: str = "1"
    gains: Mapping[str, float] = field(default_factory=dict)
    tautness: float = 0.0

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise SettingsError(f"`{self.name}` cannot be the name of a port; use letters, digits and _.")
        for axis in ("pitch", "roll"):
            require_finite(axis, getattr(self, axis), f"rad per {self.unit}")
        for name, gain in self.gains.items():
            require_finite(f"gains.{name}", gain, f"per {self.unit}")
        require_between("time", self.time, 0.0, 1e6, "s")
        require_finite("tautness", self.tautness, f"rad per {self.unit}")

    def saved(self) -> dict[str, Any]:
        """Return what a file says of it: nothing of what is not there."""
        return {name: v for name, v in asdict(self).items() if v or name not in ("gains", "tautness")}

    def on(self, robot: Robot) -> Vector:
        """Return the static gains (outputs,) on the outputs of a robot.

        Raises:
            SettingsError: a gain on what the robot does not have.
        """
        if self.tautness and not robot.is_neck:
            raise SettingsError(f"`tautness` of `{self.name}` is of necks; {robot.label()} is none. Leave it out.")
        gains = {name: gain for name, gain in {"pitch": self.pitch, "roll": self.roll, **self.gains}.items() if gain}
        names = robot.outputs.names
        if unknown := sorted(set(gains) - set(names)):
            raise SettingsError(
                f"the disturbance `{self.name}` moves `{unknown[0]}`, which robot {robot.label()} does not have; its "
                f"outputs are {', '.join(names)}."
            )
        return np.array([gains.get(name, 0.0) for name in names])


def effects(disturbances: Sequence[MeasuredDisturbance], robot: Robot) -> Matrix:
    """Return (k, outputs + 2) gains on the outputs, time constant and tautness of each."""
    rows = [[*item.on(robot), item.time, item.tautness] for item in disturbances]
    return np.array(rows).reshape(-1, len(robot.outputs.names) + 2)


def with_payload(disturbances: tuple[MeasuredDisturbance, ...], tautness: float) -> tuple[MeasuredDisturbance, ...]:
    """Return the disturbances and a payload that wishes for so much tautness [rad/kg]; none for 0."""
    if tautness == 0.0 or any(item.name == "payload" for item in disturbances):
        return disturbances
    return *disturbances, MeasuredDisturbance(name="payload", unit="kg", tautness=tautness, time=_SEEN)
