"""Compare the kinds on data left out of their training, train the best on all rows, and give the reason."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from softneck.core import (
    KINDS,
    DataError,
    Matrix,
    Progress,
    ReprMixin,
    SettingsError,
    one_blas_thread,
    resolve,
    side_by_side,
    silent,
)
from softneck.signals import Recording, poor_excitation

from ..models._arrays import members
from ..models._left_out import (
    Fold,
    agreement,
    all_rows,
    exams,
    folds,
    free_runs,
    other_motion,
    samples_to_judge,
)
from ..models._linear_systems import KINDS as LINEAR
from ..models._model import Model
from ..set_membership._set_membership import noise_si
from ..structured._greybox import as_found
from ..uncertainty._guarded import BASES, OF, Guarded, fitted_base
from ..validation._score_tables import INFINITE
from ..validation._validation import Rules, Validation, judge, judged_parts
from ._examination import (
    HOLD_OUT,
    NOT_FITTED,
    POOR_FIT_PCT,
    SHORT,
    Examination,
    Fits,
    examine,
    fits_to_reference,
    part_of_reference,
    shortened,
)

EXAM, COLD = "agreement", "cold start"
# What is in a model file but was not found from data: sizes, tables, copies of rows in another order; and what says how
# far a model is known, which every kind has.
_NOT_FOUND = ("history", "memory", "table", "redefinition", "nodes", "frame", "scale", "input_scale", "output_scale",
              "range", "widths", "source", "seen", "ground", "doubt")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class KindTrial:
    """One kind that was tried; `failure` says why it failed.

    seconds: of training; model: None where it failed; judged: on the rows held out, None where it failed or stopped
    early; left_out, errors: what was left out of a training -> fit on it and standard error over blocks of
    2 s [%] ("agreement": with the other kinds on motions that nobody recorded, without error); whole: trained on all
    rows; examination: of the model of all rows.
    """

    kind: str
    seconds: float
    model: Model | None = None
    judged: Validation | None = None
    failure: str = ""
    left_out: Mapping[str, float] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)
    whole: bool = True
    examination: Examination | None = None

    @property
    def scores(self) -> dict[str, float]:
        """Name of each test -> mean simulation fit of the outputs [%]; -inf if it failed or diverged."""
        if self.model is None or self.judged is None:
            return dict(self.left_out)
        return {**self.left_out, HOLD_OUT: _mean(self.judged.fits[INFINITE]), COLD: _mean(self.judged.cold_fits)}

    @property
    def fit(self) -> float:
        """The lowest of `scores` [%], which ranks the kinds; -inf if it failed or diverged."""
        return min(self.scores.values(), default=float("-inf"))

    @property
    def worst(self) -> str:
        """The name of the lowest score; empty without scores."""
        return min(self.scores, key=lambda name: self.scores[name], default="")

    @property
    def hold_out_fit(self) -> float:
        """Mean simulation fit on the rows held out [%]; -inf where it failed or diverged."""
        return self.scores.get(HOLD_OUT, float("-inf"))

    @property
    def numbers(self) -> int:
        """How many numbers of the model were found from data."""
        return 0 if self.model is None else numbers_of(self.model)


def numbers_of(model: Model) -> int:
    """Return the number of parameters found from data; the points of a set count, its tree does not."""
    parts = members(model.arrays)
    inner = [Model(kind=kind, sample_time=model.sample_time, arrays=part) for kind, part in parts]
    own = sum(values.size for name, values in model.arrays.items() if name not in _NOT_FOUND and "." not in name)
    return own + sum(numbers_of(part) for part in inner)


def _mean(fits: Mapping[str, float | None]) -> float:
    known = [fit for fit in fits.values() if fit is not None]
    return float(np.mean(known)) if known and len(known) == len(fits) else float("-inf")


# Fits closer than this are alike [points]: seeds of noise and training move them by as much.
ALIKE = 0.5


def _failure_reasons(ranking: Sequence[KindTrial]) -> str:
    """Return why kinds failed, each reason once."""
    said: dict[str, list[str]] = {}
    for one in ranking:
        said.setdefault(one.failure or "its simulation diverged", []).append(one.kind)
    if len(said) == 1:
        return next(iter(said))
    return "; ".join(f"{', '.join(kinds)}: {why}" for why, kinds in said.items())


_INTERNAL = "internal error in softneck"


def _reason(error: Exception) -> str:
    """Return why a kind was not identified. What is no fault of the data is an internal error, which says so.

    It ends the choice where SOFTNECK_TRACEBACK asks where it comes from.
    """
    if isinstance(error, NOT_FITTED):
        return str(error)
    if os.environ.get("SOFTNECK_TRACEBACK"):
        raise error
    return f"{_INTERNAL}: {type(error).__name__}: {error} (set SOFTNECK_TRACEBACK=1 and report what it prints)"


def _progress_text(kind: str, tried: list[KindTrial]) -> str:
    """Return the kind being tried and the best so far."""
    best = max(tried, key=lambda one: one.fit, default=None)
    return kind if best is None or best.fit == float("-inf") else f"{kind} (best so far {best.kind}, {best.fit:.1f} %)"


def _explain_choice(chosen: KindTrial, alike: list[KindTrial]) -> str:
    """Return why a kind is taken before those that are alike."""
    said = (
        f"Chosen: {chosen.kind}. Worst simulation fit {chosen.fit:.1f} % ({chosen.worst}), "
        f"{chosen.numbers:,} parameters."
    )
    if not alike:
        return f"{said} The worst fit of every other kind is lower."
    others = "; ".join(f"{one.kind} reaches {one.fit:.1f} % with {one.numbers:,}" for one in alike)
    return f"{said} {others}. Within {ALIKE:g} points the kind with the fewest parameters is chosen."


def _explain_guarded(best: KindTrial, chosen: KindTrial) -> str:
    """Return the description of the guarded form; empty if it was not taken."""
    if chosen is best or chosen.model is None:
        return ""
    settings = chosen.model.settings
    return (
        f" Its guarded form is taken: {settings['members']} models of {best.kind} that fade to `{settings['base']}` "
        f"where they part or nothing was seen; {chosen.hold_out_fit:.1f} % on the rows held out, {best.kind} alone "
        f"{best.hold_out_fit:.1f} %."
    )


def _explain_agreement(ranking: Sequence[KindTrial]) -> str:
    """Return what the test "agreement" is, where it was made."""
    made = any(EXAM in one.scores for one in ranking)
    return f" {EXAM.capitalize()}: fit to the median of all kinds on motions that nobody recorded." if made else ""


def _remarks(ranking: tuple[KindTrial, ...], other_excitation: bool) -> tuple[str, ...]:
    remarks = []
    if not other_excitation:
        remarks.append(
            "The rows held out are of the excitation that was trained on: this ranking may not hold for other "
            "motions. Give a second recording with another signal; the last one is held out."
        )
    # Of the rows held out alone: motions that were left out may lie far outside what was trained on.
    if not any(one.hold_out_fit >= POOR_FIT_PCT for one in ranking):
        remarks.append(
            f"No kind reaches {POOR_FIT_PCT:g} % in simulation of the rows held out. Look for a drifting sensor, a "
            "wrong sample time or sign, motors that were not logged, or an excitation that hardly moves the robot."
        )
    failed = [one.kind for one in ranking if one.fit == float("-inf")]
    if failed:
        remarks.append(f"Not identified or diverged: {', '.join(failed)}.")
    remarks += [f"{one.kind}: {one.failure}" for one in ranking if one.failure.startswith(_INTERNAL)]
    return tuple(remarks)


# From what can be read to what cannot: of kinds that hold as many numbers the first is taken.
_SIMPLE_FIRST = ("rls", "oe", "greybox", "play", "nlsm", "nn")
# Settings other than the default: that form of set membership which can run free.
_SETTINGS: dict[str, dict[str, Any]] = {"nlsm": {"form": "residual"}}
# Of screened sets, whose own choice among many takes several times as long: their output weight, and their epsilon in
# deviations of the noise.
_SCREENED_WEIGHT, _EPSILON_SIGMAS = 5.0, 8.0
# What a guarded form may cost on the rows held out [points]: it is taken for what it does elsewhere.
_GUARD_COST = 2.0
# So many kinds are trained on all rows at most, before the better of them is taken.
_MOST_TRAINED = 2
# How long a kind takes for one of the others, for the time left.
_TIMES = {"greybox": 3, "nn": 7}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Choice(ReprMixin):
    """The outcome of `choose`: all kinds by their lowest scores, and the chosen one.

    Attributes:
        ranking: all kinds, best first.
        chosen: the one to take.
        why: sentences for people.
        remarks: what to be wary of.
    """

    ranking: tuple[KindTrial, ...]
    chosen: KindTrial
    why: str
    remarks: tuple[str, ...]


def kinds_to_try() -> tuple[str, ...]:
    """Return the kinds that `choose` can try."""
    return tuple(kind for kind in _SIMPLE_FIRST if kind in KINDS)


@one_blas_thread
def choose(
    train: Recording,
    hold_out: Recording,
    *,
    kinds: Sequence[str] = (),
    other_excitation: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Choice:
    """Compare every kind by simulation of data left out, train the best on all of `train`, and choose.

    Each kind is identified in a short form on a part of the rows without their largest and fastest motions, and judged
    on these, on `hold_out` and, on motions that nobody recorded, by the grey box where that stands for the robot, else
    by how well it agrees with the others. The least of these scores ranks. One run, recording or phase after the other
    is then left out of the best so far, until no other could still win. The best, of those alike the one of the fewest
    numbers, is trained on all rows and judged on `hold_out` again, from the first row only as well; where it then falls
    behind the next, that one is trained too. So is the best linear kind, which controllers are designed on, or the best
    nonlinear one where the chosen is linear.

    Of a learned kind that wins, the guarded form is taken: it falls back to
    the better of `greybox` and `oe` where its members part. A kind that fails is listed with its reason.

    Args:
        train: to identify from.
        hold_out: never shown to the model that is chosen.
        kinds: all where empty.
        other_excitation: whether `hold_out` is another experiment than `train`.
        seed: of kinds that start at random.
        progress: called with the part done and a word on it.

    Raises:
        DataError: no kind could be identified, or too little is held out to judge by.
    """
    wanted = _kinds_in_order(kinds)
    for name, samples in zip(train.robot.outputs.names, samples_to_judge(hold_out), strict=True):
        if samples < 2:
            raise DataError(
                f"`{name}` has {samples} sample(s) in the rows held out, too few to judge by. Record longer."
            )
    left_out = folds(train, hold_out, other_excitation=other_excitation)
    race = _Race(train, hold_out, left_out, seed, other_excitation=other_excitation)
    race.screen_all(wanted, lambda done, what: progress(0.85 * done, what))
    race.examine()
    best = race.train_best(lambda done, what: progress(0.85 + 0.1 * done, what))
    chosen = race.finish(best, lambda done, what: progress(0.95 + 0.05 * done, what))
    ranking = race.ranking()
    progress(1.0, f"chosen: {chosen.kind}")
    alike = [one for one in ranking if one.fit > best.fit - ALIKE and one not in (best, chosen)]
    wary = (*poor_excitation(train), *_remarks(ranking, other_excitation))
    why = _explain_choice(best, alike) + _explain_guarded(best, chosen) + _explain_agreement(ranking)
    return Choice(ranking, chosen, why, wary)


def _kinds_in_order(kinds: Sequence[str]) -> list[str]:
    known = kinds_to_try()
    unknown = [kind for kind in kinds if kind not in known]
    if unknown:
        raise SettingsError(f"`{unknown[0]}` cannot be tried; known: {', '.join(known)}.")
    return sorted(kinds or known, key=_SIMPLE_FIRST.index)


def best_others(ranking: Sequence[KindTrial], chosen: KindTrial) -> dict[str, KindTrial]:
    """Return the best "nonlinear" kind where the chosen one is linear, and the best "linear" one where it is not."""
    linear = chosen.kind in LINEAR
    others = [one for one in ranking if one.fit > float("-inf") and (one.kind in LINEAR) is not linear]
    return {"nonlinear" if linear else "linear": max(others, key=lambda one: one.fit)} if others else {}


class _Race:
    """The kinds of one choice: short trainings for all, a whole one for the best."""

    def __init__(
        self, train: Recording, hold_out: Recording, left_out: list[Fold], seed: int, *, other_excitation: bool = False
    ) -> None:
        self.train, self.hold_out, self.seed, self.other_excitation = train, hold_out, seed, other_excitation
        self.folds = left_out or [Fold(train, ())]
        self.tried: dict[str, KindTrial] = {}
        self.short: dict[tuple[str, Fold], Model] = {}
        self._whole: dict[str, Model] = {}
        # Baselines of the rows held out, which are the same for all; of the exam its motions, simulations and weights.
        self._known: dict = {}
        self._motions: list[Recording] = []
        self._free: dict[str, list[Matrix]] = {}
        self._worth: dict[str, float] = {}
        # How many folds a kind went through, if more than the first.
        self._left_out: dict[str, int] = {}

    def ranking(self) -> tuple[KindTrial, ...]:
        """Return all kinds, the best first."""
        return tuple(sorted(self.tried.values(), key=lambda one: -one.fit))

    def screen_all(self, kinds: Sequence[str], progress: Progress) -> None:
        """Screen the kinds side by side, the longest training first but for `nn`, which has a thread for each axis."""
        order = sorted(kinds, key=lambda kind: kind != "greybox")
        times = [_TIMES.get(kind, 1) for kind in order]

        def screen(number: int) -> None:
            progress(sum(times[:number]) / sum(times), _progress_text(order[number], list(self.tried.values())))
            self.screen(order[number])

        side_by_side([partial(screen, number) for number in range(len(order))])
        self.tried = {kind: self.tried[kind] for kind in kinds}

    def screen(self, kind: str) -> None:
        """Identify a kind in its short form, and score it on the parts left out and on the hold-out."""
        fold, begin = self.folds[0], time.perf_counter()
        try:
            model = self._short(kind, fold)
            seconds = time.perf_counter() - begin
            found = {part.name: part.fits(model) for part in (*fold.judged, all_rows(HOLD_OUT, self.hold_out))}
        except Exception as error:  # one kind never ends the search
            self.tried[kind] = KindTrial(kind, time.perf_counter() - begin, failure=_reason(error))
            return
        self.tried[kind] = _with(KindTrial(kind, seconds, model, whole=False), found)

    def examine(self) -> None:
        """Add the fits to the grey box on the paper's tests, or the agreement of the kinds elsewhere, to the scores.

        Where another experiment is held out, that is what tells: kinds that share a bias would outvote the best.
        """
        if self.other_excitation or not self.folds[0].judged or self._by_grey_box():
            return
        self._motions = self._motions or exams(self.folds[0].train)
        for one in self.tried.values():
            if one.model is not None and one.kind not in self._free:
                self._free[one.kind] = free_runs(one.model, self._motions)
                self._worth[one.kind] = one.fit
        # Linear kinds share their bias: the best of them has a vote, or they would outvote what bends.
        linear = sorted((kind for kind in self._worth if kind in LINEAR), key=lambda kind: -self._worth[kind])
        voters = {kind: fit for kind, fit in self._worth.items() if kind not in linear[1:]}
        for kind, fit in agreement(self._free, voters).items():
            one = self.tried[kind]
            self.tried[kind] = replace(one, left_out={**one.left_out, EXAM: fit})

    def _by_grey_box(self) -> bool:
        """Add the fits to the grey box on the paper's tests, where it stands for the robot; return whether it does.

        Kinds that share a bias agree: equations that predict what was left out far better have the only vote.
        """
        fold, found = self.folds[0], dict[str, float]()
        for one in self.tried.values():
            if one.model is not None and not other_motion(self.train):
                reference, fits = fits_to_reference(one.model, one.model, fold)
                found |= {one.kind: float(np.nanmean([*fits.values()]))} if reference == "greybox" else {}
        for kind, fit in found.items():
            one = self.tried[kind]
            self.tried[kind] = replace(one, left_out={**one.left_out, part_of_reference("greybox"): fit})
        return bool(found)

    def _leave_out(self, kind: str, fold: Fold) -> None:
        one, begin = self.tried[kind], time.perf_counter()
        why = one.failure
        try:
            model = self._short(kind, fold)
            found = {part.name: part.fits(model) for part in fold.judged}
        except Exception as error:  # one kind never ends the search
            lost = dict.fromkeys(fold.train.robot.outputs.names, float("-inf"))
            found, why = {part.name: (lost, float("nan")) for part in fold.judged}, _reason(error)
        self.tried[kind] = _with(replace(one, seconds=one.seconds + time.perf_counter() - begin, failure=why), found)

    def train_best(self, progress: Progress) -> KindTrial:
        """Leave the next part out of the best kind, or train it on all rows, until the best is through; return it.

        As no part raises the lowest fit, the others could not have won (branch and bound).
        """
        trained = 0
        while True:
            best = self._simplest_of_the_best()
            number = self._left_out.get(best.kind, 1)
            if number < len(self.folds):
                fold = self.folds[number]
                progress(0.5 * number / len(self.folds), f"{best.kind} without {fold.judged[0].name}")
                self._leave_out(best.kind, fold)
                self._left_out[best.kind] = number + 1
                continue
            if best.whole:
                return best
            done = [one for one in self.ranking() if one.whole and one.fit > float("-inf")]
            if trained >= _MOST_TRAINED and done:
                return done[0]
            progress(0.5, f"{best.kind} on all rows to train on")
            self.whole(best.kind)
            trained += 1

    def finish(self, best: KindTrial, progress: Progress) -> KindTrial:
        """Return the result of `guard_best`, and train that of `best_others` on all rows beside it."""
        others = [one for one in best_others(self.ranking(), best).values() if not one.whole]
        calls: list[Callable[[], KindTrial]] = [lambda: self.guard_best(best, progress)]
        chosen, *trained = side_by_side(calls + [partial(self._trained, one.kind) for one in others])
        self.tried |= {one.kind: one for one in trained}
        # On all rows it may have failed, or be worse than the next, which then is the best of the others.
        while left := [one.kind for one in best_others(self.ranking(), chosen).values() if not one.whole]:
            self.whole(left[0])
        return chosen

    def guard_best(self, best: KindTrial, progress: Progress) -> KindTrial:
        """Return the guarded form of a learned kind unless it is worse on the rows held out.

        Over `greybox` its members are there already; `oe` saves less, and needs members of their own. It is ranked by
        what its kind was worth on what was left out, and by its own hold-out and cold start.
        """
        bases = [one.kind for one in self.ranking() if one.kind in BASES and one.fit > float("-inf")]
        if best.kind not in OF or best.model is None or not bases:
            return best
        progress(0.0, f"guarded form of {best.kind}")
        settings, begin = Guarded(of=best.kind, base=bases[0], seed=self.seed), time.perf_counter()
        try:
            if bases[0] == "oe":
                model = settings.fit(self.train, progress=progress)
            else:
                base = fitted_base("greybox", self.train, settings_of("greybox", self.seed, SHORT["greybox"]))
                parts = [best.model, self._short(best.kind, self.folds[0])]
                model = replace(settings, members=len(parts)).around(base, parts, self.train)
            judged, (examination, model) = self._validate("guarded", model), self._examined(best.kind, model)
        except Exception as error:  # one kind never ends the search
            self.tried["guarded"] = KindTrial("guarded", time.perf_counter() - begin, failure=_reason(error))
            return best
        seconds = time.perf_counter() - begin
        one = replace(
            best, kind="guarded", seconds=seconds, model=model, judged=judged, whole=True, examination=examination
        )
        self.tried["guarded"] = one
        return one if one.hold_out_fit > best.hold_out_fit - _GUARD_COST else best

    def whole(self, kind: str) -> None:
        """Train a kind on all rows to train on, and judge it again on the hold-out."""
        self.tried[kind] = self._trained(kind)

    def _trained(self, kind: str) -> KindTrial:
        one = self.tried[kind]
        begin = time.perf_counter()
        try:
            if one.model is None:
                raise DataError(one.failure)
            examination, model = self._examined(kind, self._fitted(kind))
            judged = self._validate(kind, model)
            error = all_rows(HOLD_OUT, self.hold_out).fits(model)[1]
        except Exception as error:  # one kind never ends the search
            return KindTrial(kind, one.seconds, failure=_reason(error))
        one = replace(one, seconds=one.seconds + time.perf_counter() - begin, errors={**one.errors, HOLD_OUT: error})
        return replace(one, model=model, judged=judged, whole=True, examination=examination)

    def _examined(self, kind: str, model: Model) -> tuple[Examination, Model]:
        """Return the examination of a model of all rows, which is of a kind or made of it, and the model after it."""
        again, left_out = partial(self._short, kind), [fold for fold in self.folds if fold.judged]
        return examine(again, model, self.train, self.hold_out, left_out, other_excitation=self.other_excitation)

    def _simplest_of_the_best(self) -> KindTrial:
        ranking = self.ranking()
        best = ranking[0]
        if best.fit == float("-inf"):
            raise DataError(f"no kind could be identified: {_failure_reasons(ranking)}")
        alike = [one for one in ranking if one.fit > best.fit - ALIKE]
        return min(alike, key=lambda one: (one.numbers, _SIMPLE_FIRST.index(one.kind)))

    def _fitted(self, kind: str) -> Model:
        """Return the model of all rows to train on, which is trained once."""
        if kind not in self._whole:
            self._whole[kind] = settings_of(kind, self.seed, {}).fit(self.train)
        return self._whole[kind]

    def _short(self, kind: str, fold: Fold) -> Model:
        """Return the short form of a kind without what a fold leaves out, which is trained once."""
        if (kind, fold) not in self.short:
            settings = shortened(settings_of(kind, self.seed, {}), kind)
            if kind == "greybox":  # its dead time and parts are properties of the robot: known once
                settings = as_found(settings, self._fitted(kind))
            if kind == "nlsm":
                noise = float(noise_si(fold.train).max())
                settings = replace(settings, output_weight=_SCREENED_WEIGHT, epsilon=_EPSILON_SIGMAS * noise)
            self.short[kind, fold] = settings.fit(fold.train)
        return self.short[kind, fold]

    def _validate(self, kind: str, model: Model) -> Validation:
        rules = Rules((1, INFINITE))
        return judge(model, judged_parts(model, self.hold_out, rules, self._known), rules, names=(kind, HOLD_OUT))


def _with(one: KindTrial, found: Mapping[str, tuple[Fits, float]]) -> KindTrial:
    """Return the trial with more scores, each with its standard error."""
    # A part in which no output moved says nothing of any kind.
    moved = {name: [*fits.values()] for name, (fits, _) in found.items() if not np.isnan([*fits.values()]).all()}
    left_out = {name: float(np.nanmean(fits)) for name, fits in moved.items()}
    errors = {name: error for name, (_, error) in found.items() if np.isfinite(error)}
    return replace(one, left_out={**one.left_out, **left_out}, errors={**one.errors, **errors})


def settings_of(kind: str, seed: int, other: Mapping[str, Any]) -> Any:
    """Return the settings with which `choose` trains a kind."""
    settings = resolve(KINDS[kind].settings)
    values = {**_SETTINGS.get(kind, {}), **other}
    if "seed" in settings.__dataclass_fields__:
        values["seed"] = seed
    return settings(**values)
