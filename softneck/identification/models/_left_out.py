"""Cross-validation of kinds: trainings with a part left out, each scored on that part.

The largest and the fastest motions, the end, and whole runs or recordings are left out. Blanked outputs are missed
samples; the set-points stay, so that no memory is cut. On motions that nobody recorded, within the set-points trained
on, kinds are compared with their weighted median: no proof, as kinds that share a bias agree (Ovadia et al. 2019).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals import Recording, concatenate

from ._directions import make_test_motions, time_constant_of
from ._fitting import MIN_ROWS
from ._model import WARM_UP, Model
from ._scores import nrmse_fit

_EXAM_LENGTH_S = 30.0
# A model that is right to a percent weighs no more than that.
_LEAST_ERROR = 1.0
# With two there is no middle.
_LEAST_VOTES = 3


def exams(train: Recording) -> list[Recording]:
    """Return the motions of the exam, whose outputs are NaN but for the start."""
    return make_test_motions(train, _EXAM_LENGTH_S)


def free_runs(model: Model, motions: Sequence[Recording]) -> list[Matrix]:
    """Return the outputs (time, outputs) of a model on each motion, from the first row alone."""
    outputs = len(model.robot.outputs.names)
    return [model.simulate(motion, warm_up=1)[:, :outputs] for motion in motions]


def agreement(runs: Mapping[str, Sequence[Matrix]], worth: Mapping[str, float]) -> dict[str, float]:
    """Return name -> lowest fit of its `free_runs` to the weighted median over all motions [%], mean of the outputs.

    Those in `worth` (fit on rows left out [%]) vote, by the inverse square of what is missing; {} for fewer than three.
    """
    there = [name for name in worth if np.isfinite(worth[name]) and all(np.isfinite(y).all() for y in runs[name])]
    if len(there) < _LEAST_VOTES:
        return {}
    weights = np.array([1.0 / max(100.0 - worth[name], _LEAST_ERROR) ** 2 for name in there])
    middles = [weighted_median(np.array(free), weights) for free in zip(*(runs[name] for name in there), strict=True)]
    return {name: min(map(_fit, middles, free)) for name, free in runs.items()}


def _fit(middle: Matrix, free: Matrix) -> float:
    if not np.isfinite(free).all():
        return float("-inf")
    fits = [nrmse_fit(y, yhat) for y, yhat in zip(middle.T, free.T, strict=True)]
    # An output that rests has no fit, and hides no other's.
    return float(np.mean([fit for fit in fits if not np.isnan(fit)] or fits))


def weighted_median(values: np.ndarray, weights: Vector) -> Matrix:
    """Return the weighted median over the first axis of `values` (n, ...); `weights` (n,)."""
    order = np.argsort(values, axis=0)
    reached = np.cumsum(weights[order], axis=0)
    first = np.argmax(reached >= 0.5 * reached[-1], axis=0)
    return np.take_along_axis(np.take_along_axis(values, order, axis=0), first[None], axis=0)[0]


# Kinds are compared on so many rows (40 s of Eq. 22) or time constants, whichever are more; the chosen one is trained
# on all.
SCREENED_ROWS, _SCREENED = 2000, 50.0
# Part of the rows that each region takes, and how far it reaches into what lies before and after [time constants].
_REGION, _WIDEN = 0.12, 1.0
# Sizes of one level differ by less: a mean of them is rounded in another way on each kind of processor.
_ROUNDING = 1e-9
# Over how long a motion is fast or slow [time constants].
_MOVED_OVER = 2.5
# Runs are left out in so many groups at most; a group of fewer rows or time constants says nothing of a simulation.
_MOST_GROUPS, _LEAST_ROWS, _LEAST = 3, 10 * WARM_UP, 10.0
# Kinds of set-points: held between jumps, or moving all the time.
JUMPS, SMOOTH = "jumps", "smooth motions"
# Of a motor's range: set-points that change by less from one row to the next are held.
_AT_REST = 1e-6
# Of an output's spread in training: what moves less has a fit that says nothing.
_MOVED = 0.6
# Errors within 2 s of each other belong together: that is ten time constants of the neck.
_BLOCK_SAMPLES = 100
# The standard error itself is then known to 5 %.
_BOOTSTRAP_RESAMPLES = 200


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """Rows of a recording that a training did not see, `rows` (time,), and a name of what was left out, for people."""

    name: str
    recording: Recording
    rows: np.ndarray

    def fits(self, model: Model) -> tuple[dict[str, float], float]:
        """Return output -> simulation fit [%], NaN where it was at rest, and the standard error of their mean.

        All are -inf where the simulation diverged.
        """
        y = np.where(self.rows[:, None], self.recording.outputs, np.nan)
        free = model.simulate(self.recording)[:, : y.shape[1]]
        names = model.robot.outputs.names
        if not np.isfinite(free).all():
            return dict.fromkeys(names, float("-inf")), float("nan")
        fits = np.array([nrmse_fit(y[:, i], free[:, i]) for i in range(y.shape[1])])
        moved = np.isfinite(fits)
        error = standard_error(y[:, moved], free[:, moved]) if moved.any() else float("nan")
        return dict(zip(names, fits.tolist(), strict=True)), error


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """One training, and the rows that score it."""

    train: Recording
    judged: tuple[Judged, ...]


def folds(train: Recording, hold_out: Recording, *, other_excitation: bool) -> list[Fold]:
    """Return the trainings with something left out, the one that all kinds begin with first.

    `hold_out` is shown only to those that leave `train` out; `other_excitation`: it is another experiment.
    """
    seconds = time_constant_of(train)
    slow = 0.0 if seconds is None else seconds / train.sample_time
    head, tail = _first_rows(train, slow)
    blanked, judged = _blank_extreme_motions(head, slow) if slow else (head, [])
    if tail is not None:
        judged.append(all_rows("later block", tail))
    if other_excitation:
        judged.append(all_rows("other excitation", hold_out))
    found = [Fold(blanked, tuple(judged))] if judged else []
    for number, (group, others) in enumerate(_groups(train, slow), start=1):
        found.append(Fold(_first_rows(others, slow)[0], (all_rows(f"excitation {number}", group),)))
    if len(train.runs()) == 1 and (phases := _by_phase(train)):
        for name, others in ((JUMPS, SMOOTH), (SMOOTH, JUMPS)):
            found.append(Fold(_first_rows(phases[others], slow)[0], (all_rows(name, phases[name]),)))
    if other_excitation and len(hold_out) >= _LEAST_ROWS:
        found.append(Fold(_first_rows(hold_out, slow)[0], (all_rows("trained on the other", head),)))
    return found


def _first_rows(recording: Recording, slow: float) -> tuple[Recording, Recording | None]:
    """Return the first `SCREENED_ROWS` rows over all runs, or more, and the rest; None if the rest is too short.

    `slow` is the robot's time constant [samples].
    """
    share = max(SCREENED_ROWS, _SCREENED * slow) / len(recording)
    if share >= 1.0:
        return recording, None
    head, tail = recording.split(share)
    return head, tail if any(len(run) >= max(_LEAST_ROWS, _LEAST * slow) for run in tail.runs()) else None


def _groups(train: Recording, slow: float) -> list[tuple[Recording, Recording]]:
    """Return groups of runs that follow each other, each with all the others; none of a single run.

    `slow` is the robot's time constant [samples].
    """
    runs = train.runs()
    if len(runs) < 2:
        return []
    edges = np.linspace(0, len(runs), min(len(runs), _MOST_GROUPS) + 1).round().astype(int).tolist()
    found = []
    for start, stop in itertools.pairwise(edges):
        group, others = list(runs[start:stop]), [*runs[:start], *runs[stop:]]
        if min(sum(map(len, part)) for part in (group, others)) >= max(_LEAST_ROWS, _LEAST * slow):
            found.append((concatenate(group), concatenate(others)))
    return found


def _phases(run: Recording) -> list[tuple[str, int, int]]:
    """Return the parts (name, start, stop) of a run in which set-points are held between jumps, or move all the time.

    A run of `mixed` has both: its signals follow each other.
    """
    U = run.set_points
    moved = (np.abs(np.diff(U, axis=0, prepend=U[:1])) > _AT_REST * np.ptp(U, axis=0)).any(axis=1).astype(float)
    around, reach = np.pad(moved, _LEAST_ROWS // 4, mode="edge"), 2 * (_LEAST_ROWS // 4) + 1
    held = np.convolve(around, np.full(reach, 1.0 / reach), mode="valid") < 0.5
    edges = [0, *(np.flatnonzero(np.diff(held)) + 1).tolist(), len(U)]
    return [(JUMPS if held[start] else SMOOTH, start, stop) for start, stop in itertools.pairwise(edges)]


def _by_phase(run: Recording) -> dict[str, Recording]:
    """Return the jumps of a run and its other motions; {} if all is alike."""
    phases = [(name, run.rows(start, stop)) for name, start, stop in _phases(run) if stop - start >= _LEAST_ROWS]
    found = {name: [rows for kind, rows in phases if kind == name] for name in (JUMPS, SMOOTH)}
    return {name: concatenate(rows) for name, rows in found.items()} if all(found.values()) else {}


def motions_held_out(hold_out: Recording, train: Recording) -> list[Judged]:
    """Return the rows held out of each of several motions, but those in which an output hardly moves."""
    if not other_motion(train):
        return []
    spread, scored, found, first = np.nanstd(train.outputs, axis=0), _scored_rows(hold_out), [], 0
    for number, run in enumerate(hold_out.runs(), start=1):
        for kind in (JUMPS, SMOOTH):
            rows = np.zeros(len(hold_out), dtype=bool)
            for name, start, stop in _phases(run):
                rows[first + start : first + stop] = name == kind
            y = hold_out.outputs[rows := rows & scored]
            if len(y) >= _LEAST_ROWS and (np.nanstd(y, axis=0) > _MOVED * spread).all():
                found.append(Judged(f"{kind} held out of run {number}", hold_out, rows))
        first += len(run)
    return found


def all_rows(name: str, recording: Recording) -> Judged:
    """Return all rows of a recording but those that align each run."""
    return Judged(name, recording, _scored_rows(recording))


def samples_to_judge(recording: Recording) -> list[int]:
    """Return how many samples of each output `all_rows` scores."""
    return np.isfinite(recording.outputs[_scored_rows(recording)]).sum(axis=0).tolist()


def _scored_rows(recording: Recording) -> np.ndarray:
    """Return (time,) whether a row is after the warm-up of its run."""
    return np.concatenate([np.arange(len(run)) >= WARM_UP for run in recording.runs()])


def _blank_extreme_motions(recording: Recording, slow: float) -> tuple[Recording, list[Judged]]:
    """Return the recording without its largest and fastest motions, and those; as it was where too little is left.

    `slow` is the robot's time constant [samples].
    """
    reach, span = round(_WIDEN * slow), max(round(_MOVED_OVER * slow), 1)
    far, fast = (_largest_rows(recording, size, reach) for size in (_sizes(recording), _speeds(recording, span)))
    rest = ~(far | fast)
    Y = np.where(rest[:, None], recording.outputs, np.nan)
    if np.isfinite(Y).sum(axis=0).min() < max(2 * MIN_ROWS, _LEAST * slow):
        return recording, []
    scored = _scored_rows(recording)
    judged = [Judged("largest motions", recording, far & scored), Judged("fastest motions", recording, fast & scored)]
    names = recording.robot.outputs.names
    return recording.with_channels(**dict(zip(names, Y.T, strict=True))), judged


def _largest_rows(recording: Recording, size: Vector, reach: int) -> np.ndarray:
    """Return (time,) the rows with the largest `size`, and those near them in their run."""
    edge = np.quantile(size, 1.0 - _REGION)
    level = np.isclose(size, edge, rtol=_ROUNDING, atol=0.0)
    inside = (size > edge) & ~level
    # Steps of few levels: the largest one, where the others are more than one, or nothing would move without it.
    if not inside.any() and 2 * level.sum() < size.size and np.ptp(size[~level]) > _ROUNDING * edge:
        inside = level
    near = np.ones(2 * reach + 1)
    parts = np.split(inside, np.cumsum([len(run) for run in recording.runs()])[:-1])
    return np.concatenate([np.convolve(part, near)[reach : reach + part.size] > 0 for part in parts])


def _sizes(recording: Recording) -> Vector:
    """Return how far the set-points are from their mean (time,), in standard deviations."""
    return np.linalg.norm(_standardise_set_points(recording), axis=1)


def _speeds(recording: Recording, span: int) -> Vector:
    """Return how much the set-points change over `span` samples around each row (time,)."""
    found, start = np.zeros(len(recording)), 0
    U = _standardise_set_points(recording)
    for run in recording.runs():
        u = U[start : start + len(run)]
        if len(u) > span:
            middle = start + span // 2
            found[middle : middle + len(u) - span] = np.linalg.norm(u[span:] - u[:-span], axis=1)
        start += len(u)
    return found


def _standardise_set_points(recording: Recording) -> np.ndarray:
    U = recording.set_points - recording.set_points.mean(axis=0)
    spread = U.std(axis=0)
    return U / np.where(spread > 0.0, spread, 1.0)


def standard_error(y: Matrix, outputs: Matrix) -> float:
    """Return the standard error of the mean of all fits [%], by resampling blocks of the hold-out."""
    wrong, spread = _block_sums((y - outputs) ** 2), _block_sums((y - np.nanmean(y, axis=0)) ** 2)
    # Any generator will do, but the same choice must give the same answer.
    drawn = np.random.default_rng(0).integers(len(wrong), size=(_BOOTSTRAP_RESAMPLES, len(wrong)))
    ratio = wrong[drawn].sum(axis=1) / np.maximum(spread[drawn].sum(axis=1), 1e-300)
    return float(100.0 * np.sqrt(ratio).mean(axis=1).std())


def _block_sums(squares: Matrix) -> Matrix:
    """Return the sums (blocks, outputs) over consecutive rows (time, outputs), samples that are NaN left out."""
    borders = np.arange(0, len(squares), _BLOCK_SAMPLES)
    return np.add.reduceat(np.nan_to_num(squares), borders, axis=0)


# Two runs of which a motor's spread or its speed differ by more than this factor are different motions.
_SAME_MOTION = 1.25


def other_motion(recording: Recording) -> bool:
    """Return whether the runs are of different motions, or the only run is of several."""
    moves = [run.set_points for run in recording.runs() if len(run) > 1]
    if len(moves) < 2:
        return bool(moves) and bool(_by_phase(recording))
    sizes = np.array([[U.std(axis=0), np.diff(U, axis=0).std(axis=0)] for U in moves])
    low, high = sizes.min(axis=0), sizes.max(axis=0)
    return bool((high > _SAME_MOTION * low + 1e-9 * high.max()).any())
