"""What a run of a loop leaves: one table of signals with their units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from softneck.core import DataError, Vector


@dataclass(frozen=True, slots=True, eq=False)
class LoopResult:
    """All signals of one run, named as in a recording.

    At row k stand the outputs of the plant at t_k and what observer and controller held from t_k on.

    Attributes:
        time: (N,) [s].
        signals: name -> (N,), in SI; `pitch` and `roll` are the plant's own, `pitch_estimate` and
            `roll_estimate` the observer's.
        units: name -> unit.
        sample_time: [s].
    """

    time: Vector
    signals: Mapping[str, Vector]
    units: Mapping[str, str]
    sample_time: float

    def __getitem__(self, name: str) -> Vector:
        """Return one signal (N,); raise DataError with the known names if there is none."""
        try:
            return self.signals[name]
        except KeyError:
            raise DataError(f"the result has no signal `{name}`; it has {', '.join(self.signals)}.") from None

    def angle(self, axis: str, which: str = "true") -> Vector:
        """Return an angle (N,) of `axis` ("pitch" or "roll"); the other one where the plant does not offer `which`.

        Args:
            axis: "pitch" or "roll".
            which: "true" or "measured".
        """
        names = (axis, f"{axis}_measured") if which == "true" else (f"{axis}_measured", axis)
        return self.signals[names[0]] if names[0] in self.signals else self[names[1]]
