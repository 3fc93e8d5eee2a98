"""An identification experiment as a few numbers: the same numbers give the same set-points, here and at replay."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from softneck.core import FileFormatError, SettingsError
from softneck.signals import Excitation, SetPointLimits, prepare, signal
from softneck.signals.excitation._limits import Changes

from ..running._signal import SignalPilot
from ._record import joined


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What `softneck drives record` plays.

    Attributes:
        signal: name of it.
        limits: of the set-points, see `drive_limits`.
        duration: [s]; None: the signal's own.
        seed: of the first run; it rises by one with each.
        runs: how often it is played.
        ramp: from rest and to it [s].
    """

    signal: str
    limits: SetPointLimits
    duration: float | None = None
    seed: int = 0
    runs: int = 1
    ramp: float = 2.0

    def prepared(self) -> list[tuple[Excitation, Changes]]:
        """Return for each run the signal within its limits, and what they changed.

        Raises:
            SettingsError: no such signal, or limits that it cannot keep.
        """
        return [
            prepare(signal(self.signal, duration=self.duration, seed=self.seed + number), self.limits, ramp_s=self.ramp)
            for number in range(self.runs)
        ]

    def pilot(self) -> SignalPilot:
        """Return what plays all runs with their pauses."""
        parts = [excitation for excitation, _ in self.prepared()]
        return SignalPilot(joined(parts, parts[0].sample_time)[0])

    def facts(self) -> dict[str, Any]:
        """Return what a log holds of it."""
        return asdict(self)

    @classmethod
    def of(cls, facts: Mapping[str, Any]) -> Experiment:
        """Return the experiment that `facts` tells.

        Raises:
            FileFormatError: they are damaged, or of another version.
        """
        try:
            return cls(**{**facts, "limits": SetPointLimits(**facts["limits"])})
        except (KeyError, TypeError, SettingsError) as error:
            raise FileFormatError(f"the log's experiment does not fit this softneck ({error}).") from error
