"""Try the kinds, rank them by free run over rows held out, and say why one is chosen."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from softneck.core import KINDS, DataError, Progress, SettingsError, SoftneckError, resolve, silent
from softneck.signals import Recording

from ..models._fitting import ANY_ROBOT, one_recording
from ..models._model import Model
from ..uncertainty._ensemble import combine
from ..uncertainty._residual import Residual
from ..validation._score_tables import INFINITE
from ..validation._validation import Validation, validate

# From what can be read to what cannot: of fits that are alike the first is taken.
_SIMPLE_FIRST = ("rls", "oe", "srivc", "subspace", "greybox", "play", "nlsm", "nn", "nss", "residual", "ensemble")
# Settings other than the default: that form of set membership which can run free.
_SETTINGS: dict[str, dict[str, Any]] = {"nlsm": {"form": "residual"}}
# Mean free-run fits closer than this are alike [points]: seeds of noise and training move them by as much.
ALIKE = 0.5
# Below this [%] no kind has understood the recording.
_POOR = 70.0
_MOST_MEMBERS = 3
REFITTED = "trained on all rows after the choice; its scores are those of the model before, which had not seen them all"


@dataclass(frozen=True, slots=True, eq=False)
class KindTrial:
    """One kind that was tried.

    Attributes:
        kind: its name.
        seconds: of training.
        model: None where it failed.
        judged: on the rows held out; None where it failed.
        failure: why it failed; empty otherwise.
    """

    kind: str
    seconds: float
    model: Model | None = None
    judged: Validation | None = None
    failure: str = ""

    @property
    def fit(self) -> float:
        """Mean free-run fit of both axes [%]; -inf where it failed or diverged."""
        fits = [] if self.judged is None else list(self.judged.fits[INFINITE].values())
        known = [fit for fit in fits if fit is not None]
        return sum(known) / len(known) if fits and len(known) == len(fits) else float("-inf")


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """The outcome of `choose`: all kinds by their free run, and the one that was taken.

    Attributes:
        ranking: all kinds, best free run first.
        chosen: the one to take.
        why: sentences for people.
        remarks: what to be wary of.
        seed: of kinds that start at random.
    """

    ranking: tuple[KindTrial, ...]
    chosen: KindTrial
    why: str
    remarks: tuple[str, ...]
    seed: int = 0


def kinds_to_try() -> tuple[str, ...]:
    """Return the kinds that `choose` tries when it is not told."""
    return tuple(kind for kind in _SIMPLE_FIRST if kind in KINDS)


def choose(
    train: Recording,
    hold_out: Recording,
    *,
    kinds: Sequence[str] = (),
    other_excitation: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Choice:
    """Identify every kind on `train`, judge each by its free run on `hold_out`, and choose.

    `residual` is put on the best of the others, `ensemble` is the median of the best three. A kind that fails is
    listed with its reason.

    Args:
        train: to identify from.
        hold_out: never shown to any kind.
        kinds: all where empty, those that take the robot where it is not a neck.
        other_excitation: whether `hold_out` is another experiment than `train`.
        seed: of kinds that start at random.
        progress: called with the part done and a word on it.

    Raises:
        DataError: no kind could be identified.
    """
    taken = kinds_to_try() if train.robot.is_neck else [kind for kind in kinds_to_try() if kind in ANY_ROBOT]
    wanted = list(kinds) or list(taken)
    unknown = [kind for kind in wanted if kind not in kinds_to_try()]
    if unknown:
        raise SettingsError(f"`{unknown[0]}` cannot be tried; known: {', '.join(kinds_to_try())}.")
    tried: list[KindTrial] = []
    for number, kind in enumerate(sorted(wanted, key=_SIMPLE_FIRST.index)):
        progress(number / len(wanted), _word(kind, tried))
        tried.append(_try(kind, train, hold_out, tried, seed))
    ranking = tuple(sorted(tried, key=lambda one: -one.fit))
    best = ranking[0]
    if best.fit == float("-inf"):
        reasons = "; ".join(f"{one.kind}: {one.failure or 'its free run diverged'}" for one in ranking)
        raise DataError(f"no kind could be identified: {reasons}")
    alike = [one for one in ranking if one.fit > best.fit - ALIKE]
    chosen = min(alike, key=lambda one: _SIMPLE_FIRST.index(one.kind))
    progress(1.0, f"chosen: {chosen.kind}")
    return Choice(ranking, chosen, _why(best, chosen, alike), _remarks(ranking, other_excitation), seed)


def refit(choice: Choice, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
    """Identify the chosen kind again, with what it is made of, from all recordings there are.

    Nothing is left to judge this model by: `findings["refit"]` says so, and holds the fits of the model that was
    chosen, which had not seen the rows held out.

    Raises:
        DataError: the chosen kind could not be identified.
    """
    chosen, whole = choice.chosen, one_recording(recordings)
    if chosen.model is None:
        raise DataError(f"{chosen.kind} was not identified, so that there is nothing to identify again.")
    settings = chosen.model.settings
    parts = {"residual": [settings.get("base")], "ensemble": list(settings.get("members", ()))}.get(chosen.kind, [])
    models: list[Model] = []
    for number, kind in enumerate([*parts, chosen.kind]):
        progress(number / (len(parts) + 1), f"{kind} on all rows")
        models.append(_model(str(kind), whole, models, choice.seed))
    said = {"hold_out_fit_before": chosen.fit, "remark": REFITTED}
    progress(1.0, "done")
    return replace(models[-1], findings={**models[-1].findings, "refit": said})


def _try(kind: str, train: Recording, hold_out: Recording, before: list[KindTrial], seed: int) -> KindTrial:
    begin = time.perf_counter()
    good = sorted((one for one in before if one.fit > float("-inf")), key=lambda one: -one.fit)
    try:
        model = _model(kind, train, [one.model for one in good if one.model is not None], seed)
        seconds = time.perf_counter() - begin
        judged = validate(model, hold_out, names=(kind, "hold-out"), horizons=(1, INFINITE))
    except SoftneckError as error:
        return KindTrial(kind, time.perf_counter() - begin, failure=str(error))
    return KindTrial(kind, seconds, model, judged)


def _model(kind: str, train: Recording, best: list[Model], seed: int) -> Model:
    if kind == "residual" and best:
        return Residual().on(best[0], train)
    if kind == "ensemble":
        plain = [model for model in best if model.kind != "residual"]
        return combine(plain[:_MOST_MEMBERS])
    settings = resolve(KINDS[kind].settings)
    values = dict(_SETTINGS.get(kind, {}))
    if "seed" in settings.__dataclass_fields__:
        values["seed"] = seed
    return settings(**values).fit(train)


def _word(kind: str, tried: list[KindTrial]) -> str:
    best = max(tried, key=lambda one: one.fit, default=None)
    return kind if best is None or best.fit == float("-inf") else f"{kind} (best so far {best.kind}, {best.fit:.1f} %)"


def _why(best: KindTrial, chosen: KindTrial, alike: list[KindTrial]) -> str:
    if len(alike) == 1:
        return f"{chosen.kind} has the best free run over the rows held out, {chosen.fit:.1f} %."
    others = ", ".join(f"{one.kind} {one.fit:.1f} %" for one in alike if one is not chosen)
    if chosen is best:
        return (
            f"{chosen.kind} has the best free run over the rows held out, {chosen.fit:.1f} %, and is simpler than "
            f"those that come within {ALIKE:g} points ({others})."
        )
    return (
        f"{chosen.kind} runs free with {chosen.fit:.1f} %; {others} differ by less than {ALIKE:g} points, which seeds "
        "of noise do as well, so the simplest is taken."
    )


def _remarks(ranking: tuple[KindTrial, ...], other_excitation: bool) -> tuple[str, ...]:
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
