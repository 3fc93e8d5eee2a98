"""What change detectors share: cumulative sums over what a free run misses (see `softneck.signals.detection`).

Member 0 is the model. What it misses, over how much it misses in such a motion of the neck that it knows, is averaged
over a period, and scored against one hypothesis: that it spreads `ratio` times as much. Each output has a sum, and all
of them together. What a payload or wear adds is as slow as the neck: nothing is made white, which would take it away;
that what remains is correlated is in the thresholds (`softneck.signals.detection._threshold`). While the neck stands
still nothing is counted: what it misses in one hold is one number, however long. One sum beyond its threshold is a
change; a sum of the same scores with the other sign says when the neck is the known one again.
"""

import math

import numpy as np

from softneck.estimation._nonlinear_parts_runtime import NonlinearArrays
from softneck.runtime._layout import StateVector, array, cells

# Places in `chart`.
CHANGE_PERIOD = 0  # samples that are averaged
CHANGE_RATIO = 1  # of variances, in the hypothesis of a change
CHANGE_QUIET = 2  # samples at the start in which nothing is scored: the free run still draws near
CHANGE_KEEP = 3  # part of the fit's sums that a sample keeps
CHANGE_STEP = 4  # sample time [s]
CHANGE_CLIP = 5  # standard deviations for which an average counts at most: no period alone decides
CHANGE_STILL = 6  # fastest motion in a sample below which the neck stands still
# Of outputs that vary less than this many times the variance that the model misses at rest, a fit says nothing.
CHANGE_MOVES = 4.0


class ChangeArrays(NonlinearArrays):
    """Those of an observer over a model, then what undisturbed motion says of this model."""

    spread = array("outputs, 3", "variance of what it misses: at rest, by its fastest motion squared, by y squared")
    thresholds = array("charts", "of the sums: of each output, then of all")
    chart = array("7", "see CHANGE_*")


class ChangeCells(StateVector):
    """The free run, the average that is under way, sums, and what is told; states of models follow."""

    samples = cells("", "since the start")
    fastest = cells("", "motion of the model in a sample, of late")
    angles = cells("outputs", "of the model")
    held = cells("motors", "set-points that came last")
    scaled = cells("outputs", "what it misses over its spread, summed in this period")
    counted = cells("", "measurements in it")
    elapsed = cells("", "samples in it")
    moved = cells("", "whether the neck moved in it")
    sums = cells("charts", "cumulative sums")
    back = cells("", "sum for the neck that is known")
    changed = cells("", "1 from an alarm on")
    since = cells("", "time since then [s]")
    weight = cells("", "of the fit's sums")
    level = cells("outputs", "sum of y")
    power = cells("outputs", "sum of y squared")
    missed = cells("outputs", "sum of errors squared")
    fit = cells("", "of late [%]")


def change_period(p: ChangeArrays, x: ChangeCells) -> None:
    """Count this sample; at the end of a period score it, and begin the next one."""
    if x.fastest > p.chart[CHANGE_STILL]:
        x.moved = 1.0
    x.elapsed += 1.0
    if x.elapsed >= p.chart[CHANGE_PERIOD]:
        change_score(p, x)
        x.elapsed = 0.0
        x.counted = 0.0
        x.moved = 0.0
        x.scaled[:] = 0.0
    if x.changed > 0.5:
        x.since += p.chart[CHANGE_STEP]
    x.samples += 1.0


def change_see(p: ChangeArrays, x: ChangeCells, measured: np.ndarray) -> None:
    """Take in what the model misses now: into the average of this period, and into the fit of late."""
    keep = p.chart[CHANGE_KEEP]
    x.counted += 1.0
    x.weight = keep * x.weight + 1.0
    off = 0.0
    varied = 0.0
    rest_variance = 0.0
    for i in range(p.outputs):
        error = measured[i] - x.angles[i]
        x.scaled[i] += error / change_missed(p, x, i)
        x.level[i] = keep * x.level[i] + measured[i]
        x.power[i] = keep * x.power[i] + measured[i] * measured[i]
        x.missed[i] = keep * x.missed[i] + error * error
        mean = x.level[i] / x.weight
        varied += max(x.power[i] / x.weight - mean * mean, 0.0)
        off += x.missed[i] / x.weight
        rest_variance += p.spread[i, 0]
    # While the neck hardly moves the last fit stands.
    if varied > CHANGE_MOVES * rest_variance:
        x.fit = max(100.0 * (1.0 - math.sqrt(off / varied)), -100.0)


def change_missed(p: ChangeArrays, x: ChangeCells, i: int) -> float:
    """Return the standard deviation of what the known neck's model misses of an output in such a motion."""
    spread = p.spread[i, 0] + p.spread[i, 1] * x.fastest * x.fastest + p.spread[i, 2] * x.angles[i] * x.angles[i]
    return math.sqrt(spread)


def change_score(p: ChangeArrays, x: ChangeCells) -> None:
    """Score the period that ended, unless the neck stood still in it or nothing was measured."""
    if x.counted < 0.5 or x.moved < 0.5 or x.samples < p.chart[CHANGE_QUIET]:
        return
    together = 0.0
    for i in range(p.outputs):
        score = change_spread(x.scaled[i] / x.counted, p.chart[CHANGE_RATIO], p.chart[CHANGE_CLIP])
        together += score
        x.sums[i] = max(0.0, x.sums[i] + score)
    x.sums[p.outputs] = max(0.0, x.sums[p.outputs] + together)
    change_decide(p, x, together)


def change_decide(p: ChangeArrays, x: ChangeCells, together: float) -> None:
    """Raise `changed` where a sum is beyond its threshold; lower it where the known neck explains as much again."""
    last = p.outputs
    if x.changed > 0.5:
        x.back = max(0.0, x.back - together)
        if x.back > p.thresholds[last]:
            x.changed = 0.0
            x.since = 0.0
            x.sums[:] = 0.0
        return
    for chart in range(last + 1):
        if x.sums[chart] > p.thresholds[chart]:
            x.changed = 1.0
            x.back = 0.0


def change_spread(average: float, ratio: float, clip: float) -> float:
    """Return the score of a variance of 1 that is `ratio` times as large (Basseville and Nikiforov, example 2.2.2)."""
    square = min(average * average, clip * clip * ratio)
    return 0.5 * (1.0 - 1.0 / ratio) * square - 0.5 * math.log(ratio)
