"""One examination for every kind: the worst fit on what a training did not see, and what this says of other motions.

A model that is right on later rows of its own motion may be far off on another one. So the kind is trained again
without the largest and the fastest motions and without one run after the other, and judged on these; where its model
then parts from the one of all rows on motions that nobody recorded, it is not determined by the data.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from softneck.core import Progress, to_si
from softneck.plant import has_own_tendons
from softneck.robot import Robot
from softneck.signals import Recording

from ..models._arrays import BOUNDED
from ..models._left_out import Fold, all_rows, exams, folds, free_runs, motions_held_out, other_motion
from ..models._model import Model
from ..models._scores import nrmse_fit
from ..models._validity import calibrate_validity
from ..structured._greybox import as_found

HOLD_OUT, SECOND = "hold-out", "second training"
OF_ONE_MOTION = ("largest motions", "fastest motions", "later block", SECOND)
Fits = Mapping[str, float]
# Cheaper settings of the same method: fewer starts and steps.
SHORT: dict[str, dict[str, Any]] = {
    "greybox": {"evaluations": 15, "sensor_delay": 2, "body": "rigid"},
    "nn": {"starts": 1, "iterations": 8, "refine": 6},
}
# Kinds that are trained again: in at most twice the time of their own training. `guarded` holds several models.
AGAIN = ("rls", "oe", "greybox", "play", "nlsm", "nn")
# What is missing to 100 % on other motions over what is missing in the worst part, of one motion and of several:
# medians over six necks; those of five predict the sixth as well (`benchmarks/predicts.py --each`). In one motion
# nothing is held, which misleads `nlsm`, and slow parts of the physics, which `greybox` may lack, do not show; `play`
# and `greybox` do worse without a motion than with all.
MISSING = {"nlsm": (1.3, 1.2), "greybox": (1.3, 0.6), "play": (1.0, 0.75)}
# How far the truth may lie above and below [points]: with two motions 29 of 30 (six necks, five kinds) were inside.
HALF_INTERVAL = 12.0
# Below, with one motion, where 28 of 30 were inside: `rough` was worse on others by up to 37.
BELOW_ONE_MOTION = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class Examination:
    """The fits of a model on what a training did not see.

    parts: name of what was left out -> output -> simulation fit [%], NaN where it was at rest, -inf where it diverged;
    other_motion: whether one of them is another motion than that which was trained on; bounds: of set membership, see
    `coverage`.
    """

    parts: Mapping[str, Fits]
    other_motion: bool
    bounds: Mapping[str, Any] = field(default_factory=dict)

    @property
    def deciding(self) -> dict[str, Fits]:
        """The parts that count: where whole motions are left out, what one says of itself says less of others."""
        return {name: fits for name, fits in self.parts.items() if not (self.other_motion and name in OF_ONE_MOTION)}

    @property
    def worst(self) -> tuple[str, str, float]:
        """The part and the output of the lowest fit, and this fit [%]."""
        each = [(part, name, fit) for part, fits in self.deciding.items() for name, fit in fits.items() if fit == fit]
        return min(each, key=lambda one: one[2], default=("", "", float("nan")))

    def findings(self, kind: str, robot: Robot) -> dict[str, Any]:
        """Return what a model file keeps: `fit` [%] with `part` and `output`, what is to be expected, and all parts.

        `expected` is the fit on other motions, `low` and `high` its interval.
        """
        part, output, fit = self.worst
        expected = 100.0 - MISSING.get(kind, (1.0, 1.0))[self.other_motion] * (100.0 - fit)
        below = HALF_INTERVAL if self.other_motion else BELOW_ONE_MOTION
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


def what_to_record(robot: Robot) -> str:
    """Return the recording that would tell how a model of one motion does on others."""
    if has_own_tendons(robot):
        return "`softneck record mixed -o mixed.csv` is another motion: identify from both"
    motors, outputs = ", ".join(robot.motors.names), ", ".join(robot.outputs.names)
    return f"record steps of {motors} to other heights, held until {outputs} settle, and identify from both"


def examine(
    settings: Any, model: Model, train: Recording, hold_out: Recording, progress: Progress
) -> tuple[Examination, Model]:
    """Examine a model that `settings` fitted to `train`; return this and the model with a validity that holds there.

    progress: called with the part done and a word.
    """
    held_out = [all_rows(HOLD_OUT, hold_out), *motions_held_out(hold_out, train)]
    parts: dict[str, Fits] = {part.name: part.fits(model)[0] for part in held_out}
    bounds: dict[str, Any] = {}
    left_out = folds(train, hold_out, other_excitation=False) if model.kind in AGAIN else []
    settings = as_found(settings, model) if model.kind == "greybox" else settings
    for number, fold in enumerate(left_out):
        progress(number / len(left_out), f"without {fold.judged[0].name}")
        try:
            again = shortened(settings, model.kind).fit(fold.train)
        except Exception:  # what is left of a short recording may determine no model: the whole one stands
            continue
        parts |= {part.name: part.fits(again)[0] for part in fold.judged}
        if not number:
            parts[SECOND] = second_training(model, again, fold)
            recording, rows = unseen_rows(fold)
            model = calibrate_validity(model, again, recording, rows)
            bounds = coverage(again, recording, rows)
    return Examination(parts, other_motion(train), bounds), model


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
    pairs = list(zip(free_runs(model, motions), free_runs(again, motions), strict=True))
    if not all(np.isfinite(free).all() for pair in pairs for free in pair):
        return dict.fromkeys(model.robot.outputs.names, float("-inf"))
    fits = [[nrmse_fit(y, z) for y, z in zip(free.T, other.T, strict=True)] for free, other in pairs]
    least = 100.0 - (100.0 - np.min(fits, axis=0)) / np.sqrt(2.0)
    return dict(zip(model.robot.outputs.names, least.tolist(), strict=True))


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
