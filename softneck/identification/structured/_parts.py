"""The optional parts of the grey box: which a robot can have, which its data confirm, and what they say in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import SettingsError, Vector
from softneck.signals import Recording

from ..models._fitting import ScaledData
from ..models._left_out import Fold, Judged, folds, other_motion
from ..models._scores import nrmse_fit
from ._output_error import FitProblem, Found, SearchProgress
from ._parameters import PARTS

# Steps of a search on a part of the rows, from what was found on all.
_STEPS = 4
# Steps of the search on all rows from there: later ones moved no test's fit by more than 0.1 points (six necks).
_LAST_STEPS = 12
# The speed of drives shows in their logged motors: it is kept where the squared error of all rows falls to this part,
# and not tried where not. After `_STEPS` steps it fell to 0.80 or less, or not at all, on 14 recordings of six necks.
SPEED, _SPEED_SHOWS = "speed", 0.9
# What a part must gain [points]: seeds of the noise move fits by as much. With one motion what was left out resembles
# the rest: a part must also gain this share of what is missing to 100 %.
_LEAST_GAIN, _LEAST_SHARE = 0.5, 0.2
# Parts that were searched at once are dropped again where taking them out costs no more [points].
_HARDLY = 0.1


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
) -> tuple[Found, dict[str, object]]:
    """Return the fit with the parts that motions left out confirm, and for each the worst fit to these [%].

    Forward selection: of all parts, and of all that are left at once, those whose fits to what trainings did not see
    have the best worst, as long as it gains. Left out are whole runs where they are of different motions, else the
    largest and the fastest motions, and the phases of a run.
    """
    steps, left = min(evaluations, _STEPS), _able(found.problem)
    limited = extend(found, (SPEED,), steps, tell) if found.problem.logged else found
    shows = limited.cost < _SPEED_SHOWS * found.cost
    if found.problem.logged and not shows:
        left.remove(SPEED)
    left_out, several = folds(scaled.data, scaled.data, other_excitation=False), other_motion(scaled.data)
    left_out = left_out[1:] if several and len(scaled.data.runs()) > 1 else left_out
    trials = sorted((_trial(found, scaled, fold, steps, tell) for fold in left_out), key=_Trial.fit)
    least = min((one.fit() for one in trials), default=np.inf)
    kept, chosen = {"rigid": least}, []
    while left and trials:
        tried = {}
        for parts in [(part,) for part in left] + [tuple(left)] * (len(left) > 1):
            tell.what = f"parts: {', '.join(parts)}"
            tried[parts] = _extended(trials, parts, least, steps, tell)
        fits = {parts: fit for parts, (fit, _) in tried.items()}
        more = 0.0 if several else _LEAST_SHARE * (100.0 - least)
        good = [one for one in fits if fits[one] > least + max(_LEAST_GAIN, more)]
        if not good:
            break
        best = max(good, key=lambda parts: fits[parts])
        left = [part for part in left if part not in best and fits[(part,)] > least]
        least, trials = tried[best]
        if len(best) > 1:
            least, trials, best = _needed(trials, best)
        kept["+".join(best)] = least
        chosen += best
    if not chosen:
        whole = limited.problem
        return whole.search(limited.x, limited.delay, evaluations, tell) if shows else found, {}
    last = trials[0].found
    if shows and SPEED not in chosen:
        last, chosen = extend(last, (SPEED,), 1, tell), [*chosen, SPEED]
    tell.what = "parts"
    larger = found.problem.as_sure_as(found.x, found.delay).with_parts(*chosen)
    # A simulation that diverged has no number.
    said: dict[str, object] = {"parts": {part: max(fit, 0.0) for part, fit in kept.items()}}
    return larger.search(last.x, found.delay, min(evaluations, _LAST_STEPS), tell), said


def _extended(
    trials: list[_Trial], parts: Sequence[str], least: float, steps: int, tell: SearchProgress
) -> tuple[float, list[_Trial]]:
    """Return the worst fit [%] of trials with more parts, and these; the rest is left where one gains nothing."""
    found, worst = [], np.inf
    for one in trials:
        found.append(replace(one, found=extend(one.found, parts, steps, tell)))
        worst = min(worst, found[-1].fit())
        if worst <= least:
            break
    return worst, found


def _needed(trials: list[_Trial], parts: Sequence[str]) -> tuple[float, list[_Trial], tuple[str, ...]]:
    """Return worst fit, trials and parts without those that the fits hardly need."""
    at_first = min(one.fit() for one in trials)
    while len(parts) > 1:
        tried = {part: [one.without(part) for one in trials] for part in parts}
        fits = {part: min(one.fit() for one in shorter) for part, shorter in tried.items()}
        idle = max(parts, key=lambda part: fits[part])
        if fits[idle] < at_first - _HARDLY:
            break
        trials, parts = tried[idle], [part for part in parts if part != idle]
    return min(one.fit() for one in trials), trials, tuple(parts)


def _trial(found: Found, scaled: ScaledData, fold: Fold, evaluations: int, tell: SearchProgress) -> _Trial:
    def problem_of(recording: Recording) -> FitProblem:
        whole = found.problem
        own = FitProblem.of(replace(scaled, data=recording), whole.drive_delays)
        return replace(own, numbers=whole.numbers, payload_range=whole.payload_range, reach=whole.reach)

    problem = problem_of(fold.train)
    return _Trial(
        problem.search(found.x, found.delay, evaluations, tell),
        [(judged, problem_of(judged.recording)) for judged in fold.judged],
    )


def describe_parts(problem: FitProblem, x: Vector, second: float) -> str:
    """Return in words what the optional numbers say; `second`: of the equations' time in SI [s]."""
    found = {number.name: number.decode(value) for number, value in zip(problem.numbers, x, strict=True)}
    parts = []
    reach = np.degrees(problem.reach)
    if "coupling" in found:
        stiffer = np.hypot(found["asymmetry"], found["coupling"])
        along = 0.5 * np.degrees(np.arctan2(found["coupling"], found["asymmetry"])) % 180.0
        lobes = np.hypot(found["lobe_pitch"], found["lobe_roll"])
        toward = np.degrees(np.arctan2(-found["lobe_roll"], found["lobe_pitch"])) / 3.0 % 120.0
        parts.append(
            f"stiffness is {100.0 * stiffer:.0f} % larger than its mean along {along:.0f} deg, and at {reach:.0f} deg "
            f"{100.0 * lobes:.0f} % larger towards {toward:.0f} deg and each 120 deg from there"
        )
    if "stop" in found and found["stop"] > 0.0:
        parts.append(f"beyond a compression of {1.0 / found['stop']:.2g} rad of motor the link is ten times stiffer")
    if "softening" in found:
        fall = 1.0 - 1.0 / (1.0 + found["softening"])
        parts.append(
            f"stiffness falls by {100.0 * fall:.0f} % from rest to {reach:.0f} deg, "
            f"and by {100.0 * found['lasting_softening'] * (1.0 - np.exp(-2.0)):.0f} % after a bend of {reach:.0f} deg"
        )
    if "creep" in found:
        for creep in ("creep", "slow_creep"):
            share = found[creep] / (1.0 + found["creep"] + found["slow_creep"])
            seconds = second / found[f"{creep}_rate"]
            parts.append(f"{100.0 * share:.0f} % of the stiffness creeps away with a time constant of {seconds:.2g} s")
    if "angle_2" in found:
        for j, nominal in ((2, 120.0), (3, 240.0)):
            angle = nominal + np.degrees(found[f"angle_{j}"])
            parts.append(f"tendon {j} stands at {angle:.0f} deg with {found[f'arm_{j}']:.2f} of the arm of tendon 1")
    if "home_pitch" in found:
        pitch, roll = np.degrees([found["home_pitch"], found["home_roll"]])
        parts.append(f"tendons are stretched alike at {pitch:.1f} deg of pitch and {roll:.1f} deg of roll")
    if "arc" in found:
        parts.append(
            f"a bend of {reach:.0f} deg takes {found['arc'] * problem.reach**2:.2g} rad of motor off each tendon"
        )
    if "top_speed" in found:
        parts.append(f"drives turn at up to {found['top_speed'] / second:.2g} rad/s")
        parts.append(f"their friction takes {100.0 * found['drag']:.0f} % of the largest pull")
    return "; ".join(parts)
