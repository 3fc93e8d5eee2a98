"""One kind that `identify auto` tried: its model, and what it is judged by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ..models._arrays import members
from ..models._model import Model
from ..validation._score_tables import INFINITE
from ..validation._validation import Validation

EXAM, HOLD_OUT, COLD = "agreement", "hold-out", "cold start"
# What is in a model file but was not found from data: sizes, tables, copies of rows in another order; and what says how
# far a model is known, which every kind has.
_NOT_FOUND = ("history", "memory", "table", "redefinition", "nodes", "frame", "scale", "input_scale", "output_scale",
              "range", "widths", "source", "seen", "ground", "doubt")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class KindTrial:
    """One kind that was tried.

    Attributes:
        kind: its name.
        seconds: of training.
        model: None where it failed.
        judged: on the rows held out; None where it failed or was stopped before it was trained on all rows.
        failure: why it failed; empty otherwise.
        left_out: what was left out of a training -> free-run fit on it [%], the mean of the outputs; "agreement" is
            that with the other kinds on motions that nobody recorded.
        errors: the same names -> standard error [%], over blocks of 2 s; "agreement" has none.
        whole: whether `model` was trained on all rows; the others were stopped before that.
    """

    kind: str
    seconds: float
    model: Model | None = None
    judged: Validation | None = None
    failure: str = ""
    left_out: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    whole: bool = True

    @property
    def scores(self) -> dict[str, float]:
        """What it is judged by -> mean free-run fit of the outputs [%]; -inf where it failed or diverged."""
        if self.model is None or self.judged is None:
            return dict(self.left_out)
        return {**self.left_out, HOLD_OUT: _mean(self.judged.fits[INFINITE]), COLD: _mean(self.judged.cold_fits)}

    @property
    def fit(self) -> float:
        """The least of `scores` [%], by which kinds are ranked; -inf where it failed or diverged."""
        return min(self.scores.values(), default=float("-inf"))

    @property
    def worst(self) -> str:
        """The name of the least score; empty where there is none."""
        return min(self.scores, key=lambda name: self.scores[name], default="")

    @property
    def hold_out_fit(self) -> float:
        """Mean free-run fit on the rows held out [%]; -inf where it failed or diverged."""
        return self.scores.get(HOLD_OUT, float("-inf"))

    @property
    def numbers(self) -> int:
        """How many numbers of the model were found from data."""
        return 0 if self.model is None else numbers_of(self.model)


def numbers_of(model: Model) -> int:
    """Return how many numbers of a model were found from data; a set's points are, what finds them is not."""
    parts = members(model.arrays)
    inner = [Model(kind=kind, sample_time=model.sample_time, arrays=part) for kind, part in parts]
    own = sum(values.size for name, values in model.arrays.items() if name not in _NOT_FOUND and "." not in name)
    return own + sum(numbers_of(part) for part in inner)


def _mean(fits: Mapping[str, float | None]) -> float:
    known = [fit for fit in fits.values() if fit is not None]
    return float(np.mean(known)) if known and len(known) == len(fits) else float("-inf")
