"""What a commissioning finds, by name, and what is to be done about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# Name -> what it is. Those up to `wrong type` are known before anything moves, and the first three keep it from moving.
FINDINGS: Mapping[str, str] = {
    "duplicate node": "several devices answer at one node number",
    "no drive": "a drive does not answer, or something else does",
    "exchanged nodes": "a drive's serial number is that of another motor",
    "unknown node": "a drive answers that the drives file does not have",
    "wrong type": "a drive's type has another peak current than the drives file says",
    "reversed": "the tendon is pulled when the counts go the other way",
    "exchanged motors": "motors pull other tendons than theirs",
    "gear": "the winch turns further, or less far, for each turn of the motor",
    "encoder lines": "a turn of the motor has another number of counts",
    "current scale": "the current is another one for each unit",
    "sensor axes": "the sensor's axes are exchanged",
    "sensor sign": "an axis of the sensor is reversed",
    "sensor late": "the sensor tells what was",
    "directions": "the tendons stand elsewhere",
    "hangs": "no tendon gets taut within the travel",
    "no tilt": "a tendon gets taut, and the sensor sees no tilt",
    "unclear": "the wiggle tells too little of its tilt",
    "sensor noise": "the sensor is too noisy for gears, currents and lateness",
    "not moved": "the moves ended before this motor",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that is not as the files say.

    Attributes:
        name: key of `FINDINGS`.
        text: what was found, with numbers.
        advice: what to do.
        motors: which it is about, from 1 on; () for the sensor, or the bus.
        instead: what it may be as well, where no move can tell.
        factor: how many times as large it is as the file says, where it is a scale; 0 where it is none.
    """

    name: str
    text: str
    advice: str
    motors: tuple[int, ...] = ()
    instead: tuple[str, ...] = ()
    factor: float = 0.0

    def table(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        table: dict[str, Any] = {
            "name": self.name,
            "motors": list(self.motors),
            "text": self.text,
            "advice": self.advice,
        }
        if self.instead:
            table["or"] = list(self.instead)
        return {**table, "factor": self.factor} if self.factor else table

    def __str__(self) -> str:
        """One line for people."""
        who = "" if not self.motors else f"motor{'s' * (len(self.motors) > 1)} {', '.join(map(str, self.motors))}: "
        return f"{who}{self.name}: {self.text}"
