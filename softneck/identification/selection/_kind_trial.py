"""One kind that `identify auto` tried: its model, and what it is judged by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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


# Fits closer than this are alike [points]: seeds of noise and training move them by as much.
ALIKE = 0.5
# Below this [%] no kind has understood the recording.
_POOR = 70.0


def reasons(ranking: Sequence[KindTrial]) -> str:
    """Return why kinds failed, each reason once."""
    said: dict[str, list[str]] = {}
    for one in ranking:
        said.setdefault(one.failure or "its free run diverged", []).append(one.kind)
    if len(said) == 1:
        return next(iter(said))
    return "; ".join(f"{', '.join(kinds)}: {why}" for why, kinds in said.items())


def word(kind: str, tried: list[KindTrial]) -> str:
    """Return what is tried, and the best so far."""
    best = max(tried, key=lambda one: one.fit, default=None)
    return kind if best is None or best.fit == float("-inf") else f"{kind} (best so far {best.kind}, {best.fit:.1f} %)"


def why(chosen: KindTrial, alike: list[KindTrial]) -> str:
    """Return why a kind is taken before those that are alike."""
    said = f"{chosen.kind} runs free with {chosen.fit:.1f} % at its worst ({chosen.worst})"
    if not alike:
        return f"{said}, better than all others at theirs."
    others = ", ".join(f"{one.kind} {one.fit:.1f} % with {one.numbers} numbers" for one in alike)
    return (
        f"{said}; {others} are not worse by more than {ALIKE:g} points, and of such kinds the one of the fewest "
        f"numbers is taken ({chosen.numbers})."
    )


def guarded_why(best: KindTrial, chosen: KindTrial) -> str:
    """Return what the guarded form of the best is, where it was taken."""
    if chosen is best or chosen.model is None:
        return ""
    settings = chosen.model.settings
    return (
        f" Its guarded form is taken: {settings['members']} models of {best.kind} that fade to `{settings['base']}` "
        f"where they part or nothing was seen; {chosen.hold_out_fit:.1f} % on the rows held out, {best.kind} alone "
        f"{best.hold_out_fit:.1f} %."
    )


def remarks(ranking: tuple[KindTrial, ...], other_excitation: bool) -> tuple[str, ...]:
    """Return what to be wary of in a ranking."""
    remarks = []
    if not other_excitation:
        remarks.append(
            "The rows held out are of the excitation that was trained on: this ranking may not hold for other "
            "motions. Give a second recording with another signal; the last one is held out."
        )
    if ranking[0].fit < _POOR:
        remarks.append(
            f"No kind reaches {_POOR:g} % in free run. Look for a drifting sensor, a wrong sample time or sign, motors "
            "that were not logged, or an excitation that hardly moves the robot."
        )
    failed = [one.kind for one in ranking if one.fit == float("-inf")]
    if failed:
        remarks.append(f"Not identified or diverged: {', '.join(failed)}.")
    return tuple(remarks)
