"""One examination for every kind: the worst fit on what a training did not see, and what this says of other motions.

A model that is right on later rows of its own motion may be far off on another one. So the kind is trained again
without the largest and the fastest motions and without one run after the other, and judged on these; where its model
then parts from the one of all rows on motions that nobody recorded, it is not determined by the data. Of one motion the
paper's tests are simulated by another kind, where one predicts what was left out far better.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from softneck.core import KINDS, Matrix, Progress, SoftneckError, Vector, compute_once, resolve, silent, to_si
from softneck.plant import has_own_tendons
from softneck.robot import Robot
from softneck.signals import Recording

from ..models._arrays import BOUNDED
from ..models._directions import make_paper_tests
from ..models._left_out import Fold, all_rows, exams, free_runs, motions_held_out, other_motion
from ..models._model import Model
from ..models._scores import nrmse_fit
from ..models._validity import calibrate_validity

HOLD_OUT, SECOND = "hold-out", "second training"
OF_ONE_MOTION = ("largest motions", "fastest motions", "later block", SECOND)
Fits = Mapping[str, float]
# What a fit raises where the data determine no model; whatever else it raises is a fault of ours, which is said.
NOT_FITTED = (SoftneckError, np.linalg.LinAlgError)
# Cheaper settings of the same method: fewer starts and steps.
SHORT: dict[str, dict[str, Any]] = {
    "greybox": {"evaluations": 15, "sensor_delay": 2, "body": "rigid"},
    "nn": {"starts": 1, "iterations": 8, "refine": 6},
}
# Kinds that are trained again: in at most twice the time of their own training. `guarded` holds several models.
AGAIN = ("rls", "oe", "greybox", "play", "nlsm", "nn")
# What may stand for the robot on motions that nobody recorded, in this order: equations with all parts, which need no
# trials, then what bends, then a line.
REFERENCES: dict[str, dict[str, Any]] = {"greybox": {**SHORT["greybox"], "body": "all"}, "play": {}, "oe": {}}
# Below this [%] no kind has understood the recording.
POOR_FIT_PCT = 70.0
# Where none of them predicts better: what is missing to 100 % on other motions over what is missing in the worst part,
# of one motion and of several. Medians over six necks (`benchmarks/predicts.py --each`).
MISSING = {"nlsm": (1.3, 1.2), "greybox": (1.0, 0.6), "play": (1.0, 0.75)}
# How far the truth may lie above and below [points]: with two motions or another kind's tests 54 of 55 (six necks,
# five kinds) were inside. `rough` was worst: 12 below what its tests gave.
HALF_INTERVAL = 12.0
# Below, with one motion and no tests: without them `rough` was worse on others by up to 37.
BELOW_ONE_MOTION = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """The fits of a model on what a training did not see.

    parts: name of what was left out -> output -> simulation fit [%], NaN where it was at rest, -inf where it diverged;
    other_motion: whether one of them is another motion than that which was trained on; bounds: of set membership, see
    `coverage`; reference: the kind that simulated the paper's tests, which are then a part; empty without.
    """

    parts: Mapping[str, Fits]
    other_motion: bool
    bounds: Mapping[str, Any] = field(default_factory=dict)
    reference: str = ""

    @property
    def deciding(self) -> dict[str, Fits]:
        """The parts that count: where whole motions are left out, what one says of itself says less of others."""
        return {name: fits for name, fits in self.parts.items() if not (self.other_motion and name in OF_ONE_MOTION)}

    @property
    def worst(self) -> tuple[str, str, float]:
        """The part and the output of the lowest fit, and this fit [%]."""
        each = [(part, name, fit) for part, fits in self.deciding.items() for name, fit in fits.items() if fit == fit]
        return min(each, key=lambda one: one[2], default=("", "", float("nan")))

    def expected(self, kind: str) -> float:
        """Return the fit to be expected on other motions [%]; NaN where nothing could be left out of a training."""
        if self.reference:
            fits = self.parts[part_of_reference(self.reference)].values()
            return float(np.fmin.reduce([*fits]))
        if kind in AGAIN and set(self.parts) == {HOLD_OUT}:
            return float("nan")
        return 100.0 - MISSING.get(kind, (1.0, 1.0))[self.other_motion] * (100.0 - self.worst[2])

    def findings(self, kind: str, robot: Robot) -> dict[str, Any]:
        """Return what a model file keeps: `fit` [%] with `part` and `output`, what is to be expected, and all parts.

        `expected` is the fit on other motions, `low` and `high` its interval.
        """
        part, output, fit = self.worst
        expected = self.expected(kind)
        below = HALF_INTERVAL if self.other_motion or self.reference else BELOW_ONE_MOTION
        found = {
            "fit": _number(fit), "part": part, "output": output, "one_motion": not self.other_motion,
            "expected": _number(expected), "low": _number(expected - below),
            "high": _number(min(expected + HALF_INTERVAL, 100.0)),
            "parts": {name: {axis: _number(one) for axis, one in fits.items()} for name, fits in self.deciding.items()},
        }  # fmt: skip
        found = found if self.other_motion else {**found, "record": what_to_record(robot)}
        return {**found, "bounds": dict(self.bounds)} if self.bounds else found


def _number(fit: float) -> float | None:
    return float(fit) if np.isfinite(fit) else None


def part_of_reference(kind: str) -> str:
    """Return the name of the part that has the paper's tests, simulated by a kind."""
    return f"steps, sine and rotation of {kind}"


def what_to_record(robot: Robot) -> str:
    """Return the recording that would tell how a model of one motion does on others."""
    if has_own_tendons(robot):
        return "`softneck record mixed -o mixed.csv` is another motion: identify from both"
    motors = ", ".join(robot.motors.names)
    return f"record steps of {motors} of other sizes, each held until the robot is at rest, and identify from both"


def examine(
    again: Callable[[Fold], Model], model: Model, train: Recording, hold_out: Recording, left_out: Sequence[Fold],
    progress: Progress = silent, *, other_excitation: bool = False,
) -> tuple[Examination, Model]:  # fmt: skip
    """Examine a model that was fitted to `train`; return this and the model with a validity that holds there.

    again: returns a short form of its kind, or of what it is made of, without what one of `left_out` leaves out;
    progress: called with the part done and a word; other_excitation: whether `hold_out` is another experiment.
    """
    held_out = [all_rows(HOLD_OUT, hold_out), *motions_held_out(hold_out, train)]
    parts: dict[str, Fits] = {part.name: part.fits(model)[0] for part in held_out}
    bounds: dict[str, Any] = {}
    several, reference = other_excitation or other_motion(train), ""
    for number, fold in enumerate(left_out):
        progress(number / len(left_out), f"without {fold.judged[0].name}")
        try:
            short = again(fold)
        except NOT_FITTED:  # what is left of a short recording may determine no model: the whole one stands
            continue
        parts |= {part.name: part.fits(short)[0] for part in fold.judged}
        if number:
            continue
        if short.kind == model.kind:  # what a guarded model is made of may part where that falls back to its base
            parts[SECOND] = second_training(model, short, fold)
            recording, rows = unseen_rows(fold)
            model = calibrate_validity(model, short, recording, rows)
            bounds = coverage(short, recording, rows)
        reference, fits = ("", {}) if several else fits_to_reference(model, short, fold)
        parts |= {part_of_reference(reference): fits} if reference else {}
    return Examination(parts, several, bounds, reference), model


def shortened(settings: Any, kind: str) -> Any:
    """Return the settings with those of `SHORT` that are not given."""
    usual = {item.name: item.default for item in fields(settings)}
    short = {name: value for name, value in SHORT.get(kind, {}).items() if getattr(settings, name) == usual[name]}
    return replace(settings, **short)


def second_training(model: Model, again: Model, fold: Fold) -> Fits:
    """Return output -> lowest fit [%] on unrecorded motions that a model and one of fewer rows leave possible.

    Of two that err alike, and each in its own way, either misses 1 / sqrt(2) of what they differ by.
    """
    motions = exams(fold.train)
    least = 100.0 - (100.0 - _lowest_fits(free_runs(model, motions), free_runs(again, motions))) / np.sqrt(2.0)
    return dict(zip(model.robot.outputs.names, least.tolist(), strict=True))


def fits_to_reference(model: Model, again: Model, fold: Fold) -> tuple[str, Fits]:
    """Return the kind that stands for the robot on the paper's tests, and the fits to be expected there [%].

    It is the first that has understood the recording and whose squared error on what the fold leaves out is at most
    half that of `again`, the short form of `model`; "" if there is none. The error of a model against it and its own
    against the robot are taken as independent: their squares add.
    """
    own = _least_fit(again, fold)
    for kind, settings in REFERENCES.items():
        if kind == model.kind and not settings:  # the same again
            continue
        try:
            reference = _fit_once(resolve(KINDS[kind].settings)(**settings), fold.train)
        except (SoftneckError, np.linalg.LinAlgError):  # a kind for other robots, or for more rows
            continue
        known = _least_fit(reference, fold)
        if known >= POOR_FIT_PCT and 2.0 * (100.0 - known) ** 2 <= (100.0 - own) ** 2:
            motions = make_paper_tests(fold.train)
            fits = _lowest_fits(free_runs(reference, motions), free_runs(model, motions))
            missing = np.hypot(100.0 - fits, 100.0 - known)
            return kind, dict(zip(model.robot.outputs.names, (100.0 - missing).tolist(), strict=True))
    return "", {}


def _fit_once(settings: Any, recording: Recording) -> Model:
    """Return the model of a recording; of the kinds that `auto` compares each is examined by the same one."""
    return compute_once(lambda: settings.fit(recording), settings, recording)


def _lowest_fits(runs: Sequence[Matrix], others: Sequence[Matrix]) -> Vector:
    """Return (outputs,) the lowest fit [%] of `others` to `runs`, (time, outputs) each.

    -inf where one diverged, NaN where an output is at rest in all of them.
    """
    with np.errstate(over="ignore"):  # what grows without bound is no number sooner or later
        finite = all(np.isfinite(np.square(free).sum()) for free in (*runs, *others))
    if not finite:
        return np.full(runs[0].shape[1], -np.inf)
    fits = [[nrmse_fit(*pair) for pair in zip(y.T, z.T, strict=True)] for y, z in zip(runs, others, strict=True)]
    return np.fmin.reduce(np.array(fits, dtype=float), axis=0)


def _least_fit(model: Model, fold: Fold) -> float:
    """Return the lowest fit of an output on what a fold leaves out [%]."""
    fits = [fit for part in fold.judged for fit in part.fits(model)[0].values() if fit == fit]
    return min(fits, default=float("-inf"))


def unseen_rows(fold: Fold) -> tuple[Recording, np.ndarray]:
    """Return the recording of a fold whose largest and fastest motions are left out, and these rows (time,)."""
    recording = fold.judged[0].recording
    return recording, np.any([part.rows for part in fold.judged if part.recording is recording], axis=0)


def coverage(again: Model, recording: Recording, rows: np.ndarray) -> dict[str, Any]:
    """Return what the bounds of set membership in simulation held of motions that a training did not see.

    `held_pct`: of the samples, for each output; `width`: mean, in the display unit of the outputs. Empty for kinds
    without bounds.
    """
    if again.kind not in BOUNDED:
        return {}
    robot = again.robot
    names, motors = robot.outputs.names, len(robot.motors.names)
    outputs = np.asarray(again.simulate(recording))[rows][:, len(names) + motors :]
    lower, upper, y = outputs[:, 0 : 2 * len(names) : 2], outputs[:, 1 : 2 * len(names) : 2], recording.outputs[rows]
    there = np.isfinite(y)
    held = ((y >= lower) & (y <= upper)).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    width = (upper - lower).mean(axis=0) / to_si(robot.outputs.display_unit)[0]
    return {
        "held_pct": dict(zip(names, (100.0 * held).tolist(), strict=True)),
        "width": dict(zip(names, width.tolist(), strict=True)),
    }
