"""The optional parts of the grey box: which a robot can have, which its data confirm, and what they say in words."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.signals import Recording

from ..models._fitting import ScaledData
from ..models._left_out import Fold, Judged, folds, other_motion
from ..models._scores import nrmse_fit
from ._output_error import FitProblem, Found, SearchProgress
from ._parameters import NO_EFFECT, PARTS

# Steps of a search on a part of the rows, from what was found on all; then of those with all parts (with twelve `paper`
# is refused them), and of the search on all rows from there: six more moved no test's fit by more than 0.2 points.
_FIRST_STEPS, _STEPS, _LAST_STEPS = 4, 16, 6
# The speed of drives shows in their logged motors: it is kept alone where the squared error of all rows falls to this
# part. After `_FIRST_STEPS` steps it fell to 0.80 or less, or not at all, on 14 recordings of six necks.
SPEED, _SPEED_SHOWS = "speed", 0.9
# What parts must gain, and what must be lost without one that is told of [points]: seeds of the noise move fits by as
# much. Those that what was left out chose itself must also gain this share of what is missing to 100 %.
_LEAST_GAIN, _LEAST_SHARE = 0.5, 0.1
# The parts that show are kept alone where they leave so much less over: on a neck with creep alone they leave half, on
# twelve recordings of six others 0.77 and more, and there the fits of the paper's tests are up to 2.5 points worse.
_FEWER = 2.0 / 3.0


def parts_of(body: str) -> tuple[str, ...] | None:
    """Return the parts that the setting `body` names: "rigid" none, "all", some joined by plus signs; None: "auto"."""
    if body in ("auto", "rigid"):
        return None if body == "auto" else ()
    parts = tuple(PARTS) if body == "all" else tuple(body.split("+"))
    if len(set(parts)) < len(parts) or not set(parts) <= set(PARTS):
        raise SettingsError(
            f"`body` must be auto, rigid, all, or some of {', '.join(PARTS)} joined by `+`; got {body!r}."
        )
    return parts


def extend(found: Found, parts: Sequence[str], evaluations: int, tell: SearchProgress) -> Found:
    """Return the fit with the numbers of `parts`, searched from what was found without."""
    able = [part for part in parts if part in _able(found.problem)]
    if not able:
        return found
    larger = found.problem.as_sure_as(found.x, found.delay).with_parts(*able)
    new = larger.numbers[len(found.x) :]
    tell.what = "parts"
    x = np.concatenate([found.x, [number.encode(larger.guess(number)) for number in new]])
    return larger.search(x, found.delay, evaluations, tell)


def _able(problem: FitProblem) -> list[str]:
    """Return the parts that a robot can have: no tendons of other robots; in a plane no anisotropy or homing."""
    spatial = problem.has_two_outputs
    can = {"tendons": problem.has_neck_tendons, "anisotropy": spatial, "homing": spatial}
    return [part for part in PARTS if can.get(part, True)]


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A fold, and what was found on it with some parts; judged: what it left out, and the problem to simulate that."""

    found: Found
    judged: list[tuple[Judged, FitProblem]]

    def without(self, part: str) -> _Trial:
        """Return the trial with that part's numbers taken out, and the others as they are."""
        at, problem = self.found, self.found.problem
        kept = np.array([number not in PARTS[part] for number in problem.numbers])
        numbers = tuple(number for number in problem.numbers if number not in PARTS[part])
        return replace(self, found=replace(at, problem=replace(problem, numbers=numbers), x=at.x[kept]))

    def with_only(self, parts: Collection[str], evaluations: int, tell: SearchProgress) -> _Trial:
        """Return the trial with these parts alone, fitted again from its numbers."""
        trial = self
        for part in self.found.problem.parts:
            trial = trial if part in parts else trial.without(part)
        at = trial.found
        return replace(trial, found=at.problem.search(at.x, at.delay, evaluations, tell))

    def fit(self) -> float:
        """Return the worst fit of an output on what was left out [%]."""
        worst = np.inf
        for judged, problem in self.judged:
            problem = replace(problem, numbers=self.found.problem.numbers)
            Y = np.concatenate([Y for _, Y in problem.simulate(self.found.x, self.found.delay)])
            y = np.where(judged.rows[:, None], judged.recording.outputs, np.nan)
            fits = [nrmse_fit(*pair) for pair in zip(y.T, Y.T, strict=True)]
            worst = min([worst, *(fit if np.isfinite(Y).all() else -np.inf for fit in fits if fit == fit)])
        return worst


def choose_parts(
    found: Found, scaled: ScaledData, evaluations: int, tell: SearchProgress
) -> tuple[Found, tuple[str, ...], dict[str, object]]:
    """Return the fit, with optional parts if motions left out confirm them, the numbers to tell of, and findings.

    All are kept if these gain, else those without one of which what was left out is fitted worse, if they do; those
    that show alone where that is fitted far better so, as the others share what these explain. Left out are motions
    where there are several, in runs or in the phases of one, else the largest and the fastest. A part that does not
    show is held by its prior. Else the speed of drives is kept if logged motors show it.
    """
    left_out, several = folds(scaled.data, scaled.data, other_excitation=False), other_motion(scaled.data)
    left_out = left_out[1:] if several else left_out
    parts, first, steps = _able(found.problem), min(evaluations, _FIRST_STEPS), min(evaluations, _STEPS)
    coarse = replace(found, problem=found.problem.coarse())
    rigid = [_trial(coarse, scaled, fold, first, tell) for fold in left_out]
    whole = [replace(one, found=extend(one.found, parts, steps, tell)) for one in rigid]
    fits = {name: min((one.fit() for one in each), default=np.inf) for name, each in (("rigid", rigid), ("all", whole))}
    confirmed = fits["all"] > fits["rigid"] + _LEAST_GAIN
    if whole and not confirmed:
        parts, whole = _needed(whole, parts, fits["all"])
        fits["+".join(parts) or "rigid"] = fit = min(one.fit() for one in whole)
        confirmed = fit > fits["rigid"] + max(_LEAST_GAIN, _LEAST_SHARE * (100.0 - fits["rigid"]))
    if not confirmed:
        limited = extend(found, (SPEED,), first, tell) if found.problem.logged else found
        shows = limited.cost < _SPEED_SHOWS * found.cost
        chosen = limited.problem.search(limited.x, found.delay, evaluations, tell) if shows else found
        return chosen, tuple(NO_EFFECT), {}
    last = min(whole, key=_Trial.fit).found
    few = _shown(_found_again(last, whole), parts)
    if 0 < len(few) < len(parts):
        alone = [one.with_only(few, min(evaluations, _LAST_STEPS), tell) for one in whole]
        fits["+".join(few)] = fit = min(one.fit() for one in alone)
        if 100.0 - fit < _FEWER * (100.0 - min(one.fit() for one in whole)):
            parts, whole, last = few, alone, min(alone, key=_Trial.fit).found
    larger = found.problem.as_sure_as(found.x, found.delay).with_parts(*parts)
    chosen = larger.search(last.x, found.delay, min(evaluations, _LAST_STEPS), tell)
    # A simulation that diverged has no number.
    return chosen, _found_again(chosen, whole), {"parts": {name: max(fit, 0.0) for name, fit in fits.items()}}


def _shown(told: Collection[str], parts: Sequence[str]) -> list[str]:
    """Return the parts of which a number is told."""
    return [part for part in parts if any(number.name in told for number in PARTS[part])]


def _needed(trials: list[_Trial], parts: list[str], least: float) -> tuple[list[str], list[_Trial]]:
    """Return the parts without one of which what was left out is fitted worse than `least`, and trials with these."""
    idle = [part for part in parts if min(one.without(part).fit() for one in trials) >= least]
    for part in idle:
        trials = [one.without(part) for one in trials]
    return [part for part in parts if part not in idle], trials


def _found_again(chosen: Found, trials: list[_Trial]) -> tuple[str, ...]:
    """Return the optional numbers whose effect is at least half as large in every training that left motions out.

    They are of parts without which what was left out is fitted worse.
    """

    def effects(found: Found, part: str) -> Vector:
        pairs = zip(found.problem.numbers, found.x, strict=True)
        return np.array([x - number.encode(NO_EFFECT[number.name]) for number, x in pairs if number in PARTS[part]])

    least, names = min(one.fit() for one in trials), []
    for part in chosen.problem.parts:
        whole, parts = effects(chosen, part), [effects(one.found, part) for one in trials]
        again = np.all([np.sign(whole) * part >= 0.5 * np.abs(whole) for part in parts], axis=0)
        if min(one.without(part).fit() for one in trials) < least - _LEAST_GAIN:
            names += [number.name for number, same in zip(PARTS[part], again, strict=True) if same]
    return tuple(names)


def _trial(found: Found, scaled: ScaledData, fold: Fold, evaluations: int, tell: SearchProgress) -> _Trial:
    def problem_of(recording: Recording) -> FitProblem:
        whole = found.problem
        own = FitProblem.of(replace(scaled, data=recording), whole.drive_delays)
        return replace(
            own,
            numbers=whole.numbers,
            payload_range=whole.payload_range,
            reach=whole.reach,
            substeps=whole.substeps,
        )

    problem = problem_of(fold.train)
    return _Trial(
        problem.search(found.x, found.delay, evaluations, tell),
        [(judged, problem_of(judged.recording)) for judged in fold.judged],
    )


def differing(table: Sequence[Mapping[str, Any]], told: Collection[str]) -> set[str]:
    """Return the optional numbers of those in `told` whose 95 % interval excludes no effect; table: see `intervals`."""
    rows = [row for row in table if row["name"] in told]
    return {row["name"] for row in rows if not row["low"] <= NO_EFFECT[row["name"]] <= row["high"]}


@dataclass(frozen=True, slots=True, eq=False)
class _Words:
    """The numbers: rows of `intervals` by name, and those to tell of."""

    rows: Mapping[str, Mapping[str, Any]]
    shows: set[str]

    def value(self, name: str) -> float:
        return self.rows[name]["value"]

    def range(self, name: str, of: Callable[[float], float], digits: str = ".0f") -> str:
        """Return a function of the number with its 95 % confidence."""
        value, *ends = (of(self.rows[name][key]) for key in ("value", "low", "high"))
        return f"{value:{digits}} ({min(ends):{digits}} to {max(ends):{digits}})"


def describe_parts(reach: float, table: Sequence[Mapping[str, Any]], shown: set[str], second: float) -> str:
    """Return in words what the optional numbers `shown` say.

    reach: [rad]; table: see `intervals`; second: of the equations' time in SI [s].
    """
    words = _Words({row["name"]: row for row in table}, shown)
    return "; ".join([*_of_stiffness(words, reach, second), *_of_tendons(words, reach), *_of_drives(words, second)])


def _of_stiffness(words: _Words, reach: float, second: float) -> Iterator[str]:
    shows, value, degrees = words.shows, words.value, f"{np.degrees(reach):.0f} deg"
    if "coupling" in shows:
        stiffer = 100.0 * np.hypot(value("asymmetry"), value("coupling"))
        along = 0.5 * np.degrees(np.arctan2(value("coupling"), value("asymmetry"))) % 180.0
        yield f"stiffness is {stiffer:.0f} % larger than its mean along {along:.0f} deg"
    if shows & {"lobe_pitch", "lobe_roll"}:
        lobes = 100.0 * np.hypot(value("lobe_pitch"), value("lobe_roll"))
        toward = np.degrees(np.arctan2(-value("lobe_roll"), value("lobe_pitch"))) / 3.0 % 120.0
        yield f"at {degrees} it is {lobes:.0f} % stiffer towards {toward:.0f} deg and each 120 deg from there"
    if "stop" in shows:
        where = words.range("stop", lambda stop: 1.0 / stop, ".2g")
        yield f"beyond a compression of {where} rad of motor the link is ten times stiffer"
    if "softening" in shows:
        fall = words.range("softening", lambda softening: 100.0 * softening / (1.0 + softening))
        yield f"stiffness falls by {fall} % from rest to {degrees}"
    if "lasting_softening" in shows:
        fall = words.range("lasting_softening", lambda softening: 100.0 * softening * (1.0 - np.exp(-2.0)))
        yield f"stiffness falls by {fall} % after a bend of {degrees}"
    for creep in sorted(shows & {"creep", "slow_creep"}):
        rest = 1.0 + value("creep") + value("slow_creep") - value(creep)
        share = words.range(creep, lambda part, rest=rest: 100.0 * part / (rest + part))
        seconds = second / value(f"{creep}_rate")
        yield f"{share} % of the stiffness creeps away with a time constant of {seconds:.2g} s"


def _of_tendons(words: _Words, reach: float) -> Iterator[str]:
    for j, nominal in ((2, 120.0), (3, 240.0)):
        if words.shows & {f"angle_{j}", f"arm_{j}"}:
            angle = words.range(f"angle_{j}", lambda angle, nominal=nominal: nominal + np.degrees(angle))
            arm = words.range(f"arm_{j}", float, ".2f")
            yield f"tendon {j} stands at {angle} deg with {arm} of the arm of tendon 1"
    if words.shows & {"home_pitch", "home_roll"}:
        pitch, roll = (words.range(name, np.degrees, ".1f") for name in ("home_pitch", "home_roll"))
        yield f"tendons are stretched alike at {pitch} deg of pitch and {roll} deg of roll"
    if "arc" in words.shows:
        way = words.range("arc", lambda arc: arc * reach**2, ".2g")
        yield f"a bend of {np.degrees(reach):.0f} deg takes {way} rad of motor off each tendon"


def _of_drives(words: _Words, second: float) -> Iterator[str]:
    if "top_speed" in words.shows:
        yield f"drives turn at up to {words.range('top_speed', lambda speed: speed / second, '.3g')} rad/s"
    if "drag" in words.shows:
        friction = words.range("drag", lambda drag: 100.0 * drag)
        yield f"friction of moving drives takes {friction} % of the largest pull"
