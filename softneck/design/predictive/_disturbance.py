"""Disturbances that are measured and whose effect on the angles is known."""

from __future__ import annotations

from dataclasses import dataclass

from softneck.core import SettingsError, require_between, require_finite


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredDisturbance:
    """An input of the controller that adds `gain / (1 + time s)` times itself to the angles.

    Attributes:
        name: of the port, such as "base_tilt_pitch".
        unit: SI unit of the port.
        pitch, roll: static gains [rad per unit].
        time: time constant [s]; 0 for at once.
    """

    name: str
    pitch: float = 0.0
    roll: float = 0.0
    time: float = 0.0
    unit: str = "1"

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise SettingsError(f"`{self.name}` cannot be the name of a port; use letters, digits and _.")
        for axis in ("pitch", "roll"):
            require_finite(axis, getattr(self, axis), f"rad per {self.unit}")
        require_between("time", self.time, 0.0, 60.0, "s")
