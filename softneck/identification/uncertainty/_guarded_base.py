"""The base of a guarded model: the simple kind that misses least on rows that it was not trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import KINDS, SoftneckError, Vector, resolve
from softneck.signals import Recording

from ..models._model import Model
from ._left_out import left_out, left_out_error

# What a base may be where none is named: equations where they fit, else a line.
BASES = ("greybox", "oe")
# Of so many parts these are left out in turn to judge a base by: two say how much it misses, five would take longer.
_PARTS, _JUDGED = 5, (1, 3)
# Of the outputs' spread: a base that misses more than this of it saves nothing.
_POOR = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """A base and what it misses.

    Attributes:
        model: trained on all rows.
        error: (outputs,) rms of its free run on rows left out, in the outputs' unit.
        fit: (outputs,) the same as a fit [%].
    """

    model: Model
    error: Vector
    fit: Vector

    @property
    def remark(self) -> str:
        """Return a warning about a poor base, or nothing."""
        if self.fit.min() >= 100.0 * (1.0 - _POOR):
            return ""
        return (
            f"the base `{self.model.kind}` itself reaches {self.fit.min():.0f} % only on rows left out: where the "
            "members part, this model is no better than that"
        )


def fitted_base(kind: str, recording: Recording, settings: Any = None) -> Base:
    """Return a base of that kind, with the kind's defaults where no settings are given.

    Raises:
        DataError: what the kind raises.
    """
    settings = resolve(KINDS[kind].settings)() if settings is None else settings
    model = settings.fit(recording)
    parts = left_out(recording, _PARTS)
    # Its dead time is a property of the sensor: known once, it need not be searched for again.
    again = replace(settings, sensor_delay=int(model.findings["sensor_delay"])) if kind == "greybox" else settings
    error = left_out_error(again.fit, [parts[i] for i in _JUDGED])
    spread = np.nanstd(recording.outputs, axis=0)
    return Base(model, error, 100.0 * (1.0 - error / spread))


def base_or_reason(kind: str, recording: Recording) -> Base | str:
    """Return a base of that kind, or why there is none."""
    try:
        return fitted_base(kind, recording)
    except SoftneckError as error:
        return f"{kind}: {error}"
