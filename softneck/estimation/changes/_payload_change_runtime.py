"""A model of several payloads in free run beside the loop under each of them: which one it is, or that it is none.

Each copy has a cumulative sum of its likelihood ratio against the payload that is told (`chart_shift`, over averages
of a period and over how much the model misses in such a motion of the neck that it knows). Where one is beyond its
threshold, which undisturbed motion gave, the payload is told anew: where a parabola through the least cost of all
copies and its neighbours is lowest. A cost is what a copy misses, squared and summed with exponential weights, less an
offset that a sensor may have. While the neck stands nothing is learnt of it. The other cumulative sums are over what
the model misses at that payload: a change that no payload explains.
"""

import math

import numpy as np

from softneck.estimation._kalman_parts_runtime import KALMAN_LAG
from softneck.estimation._nonlinear_parts_runtime import nonlinear_faster, nonlinear_move, nonlinear_settle
from softneck.estimation.changes._change_parts_runtime import (
    CHANGE_PERIOD,
    CHANGE_QUIET,
    CHANGE_STILL,
    ChangeArrays,
    ChangeCells,
    change_missed,
    change_period,
    change_see,
)
from softneck.runtime._layout import array, cells, rest, value
from softneck.runtime._members_runtime import member_size
from softneck.signals.detection._charts_runtime import chart_shift

# Places in `bank`.
BANK_LEAST = 0  # [kg]
BANK_MOST = 1  # [kg]
BANK_COPIES = 2  # of the model, at as many payloads from least to most
BANK_KEEP = 3  # part of the sums that a sample keeps
BANK_SIGHT = 4  # standard deviations for which a copy's distance counts at most in a period


class PayloadChangeArrays(ChangeArrays):
    """As without payloads, then how the copies are weighed."""

    bank = array("5", "see BANK_*")
    copies = value("bank", BANK_COPIES)
    telling = array("copies", "thresholds of the copies' sums")


class PayloadChangeState(ChangeCells):
    """As without payloads, then of each copy what it misses; their own states follow."""

    payload = cells("", "[kg] that the neck is thought to bear")
    told = cells("copies, outputs", "angles of each copy")
    missed_by = cells("copies, outputs", "sum of what each misses, over the spread")
    squares = cells("copies, outputs", "sum of its squares")
    apart = cells("copies, outputs", "how far each is from the payload told, over the spread, summed in this period")
    shifts = cells("copies", "cumulative sums of each against the payload told")
    seen = cells("", "weight of these sums")
    models = rest("states of the copies")


def state_size(p: PayloadChangeArrays) -> int:
    """Return the length of the state vector."""
    return PayloadChangeState.size(p) + int(p.bank[BANK_COPIES]) * member_size(p, 0)


def initialise(p: PayloadChangeArrays, parameters: np.ndarray, x: PayloadChangeState, outputs: np.ndarray) -> None:
    """Start where nothing is known but the payload that is told."""
    x[:] = 0.0
    x.payload = parameters[0]
    outputs[:] = 0.0
    outputs[3] = parameters[0]


def step(
    p: PayloadChangeArrays, parameters: np.ndarray, x: PayloadChangeState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Move all copies on, weigh what they miss, score what the model misses at the payload, and tell.

    inputs: motor_setpoint_1..3, pitch_measured, roll_measured, measurement_valid.
    outputs: changed, since_s, fit, payload.
    parameters: payload at the start.
    """
    n, m = p.motors, p.outputs
    asked, measured = inputs[:n].copy(), inputs[n : n + m].copy()
    if x.samples == 0.0:
        x.held[:] = asked
        x.payload = parameters[0]
        payload_change_move(p, x, asked, True)
    # Both at the payload of now: a payload told anew is no motion.
    payload_change_blend(p, x)
    before = x.angles.copy()
    acted = x.held.copy() if p.constants[KALMAN_LAG] > 0.5 else asked.copy()
    payload_change_move(p, x, acted, False)
    payload_change_blend(p, x)
    x.held[:] = asked
    x.fastest = nonlinear_faster(p, x.fastest, x.angles, before)
    usable = float(inputs[n + m]) > 0.5
    for i in range(m):
        usable = usable and math.isfinite(measured[i])
    if usable:
        change_see(p, x, measured)
        payload_change_part(p, x)
        if x.fastest > p.chart[CHANGE_STILL] and x.samples >= p.chart[CHANGE_QUIET]:
            payload_change_weigh(p, x, measured)
    told = payload_change_ends(p, x)
    change_period(p, x)
    if told:
        payload_change_find(p, x)
    outputs[0] = x.changed
    outputs[1] = x.since
    outputs[2] = x.fit
    outputs[3] = x.payload


def payload_change_of(p: PayloadChangeArrays, copy: int) -> float:
    """Return the payload [kg] of a copy."""
    return p.bank[BANK_LEAST] + copy * (p.bank[BANK_MOST] - p.bank[BANK_LEAST]) / (p.copies - 1)


def payload_change_move(p: PayloadChangeArrays, x: PayloadChangeState, motors: np.ndarray, settle: bool) -> None:
    """Move all copies on by a sample, or let them settle."""
    models, told, size, angles = x.models, x.told, member_size(p, 0), np.empty(p.outputs)
    for copy in range(p.copies):
        free = p.free.copy()
        free[free.shape[0] - 1] = payload_change_of(p, copy)
        own = models[copy * size : (copy + 1) * size]
        if settle:
            nonlinear_settle(p, free, own, motors, angles)
        else:
            nonlinear_move(p, free, own, motors, angles)
        for i in range(p.outputs):
            told[copy * p.outputs + i] = angles[i]


def payload_change_blend(p: PayloadChangeArrays, x: PayloadChangeState) -> None:
    """Put the angles at the payload between two copies where the detector looks for them."""
    told = x.told
    place = (x.payload - p.bank[BANK_LEAST]) / (p.bank[BANK_MOST] - p.bank[BANK_LEAST]) * (p.copies - 1)
    low = min(max(int(place), 0), p.copies - 2)
    part = place - low
    for i in range(p.outputs):
        x.angles[i] = (1.0 - part) * told[low * p.outputs + i] + part * told[(low + 1) * p.outputs + i]


def payload_change_weigh(p: PayloadChangeArrays, x: PayloadChangeState, measured: np.ndarray) -> None:
    """Take in what each copy misses."""
    keep, m, told = p.bank[BANK_KEEP], p.outputs, x.told
    missed, squares = x.missed_by, x.squares
    x.seen = keep * x.seen + 1.0
    for i in range(m):
        spread = change_missed(p, x, i)
        for copy in range(p.copies):
            at = copy * m + i
            e = (measured[i] - told[at]) / spread
            missed[at] = keep * missed[at] + e
            squares[at] = keep * squares[at] + e * e


def payload_change_part(p: PayloadChangeArrays, x: PayloadChangeState) -> None:
    """Take in how far each copy is from the payload that is told."""
    m, told, apart = p.outputs, x.told, x.apart
    for i in range(m):
        spread = change_missed(p, x, i)
        for copy in range(p.copies):
            apart[copy * m + i] += (told[copy * m + i] - x.angles[i]) / spread


def payload_change_ends(p: PayloadChangeArrays, x: PayloadChangeState) -> bool:
    """Return whether a period ends with this sample in which a copy's sum passes its threshold."""
    if x.elapsed + 1.0 < p.chart[CHANGE_PERIOD]:
        return False
    m, apart, shifts, beyond = p.outputs, x.apart, x.shifts, False
    moved = x.moved > 0.5 or x.fastest > p.chart[CHANGE_STILL]
    if x.counted > 0.5 and moved and x.samples >= p.chart[CHANGE_QUIET]:
        for copy in range(p.copies):
            score = 0.0
            for i in range(m):
                score += chart_shift(x.scaled[i] / x.counted, apart[copy * m + i] / x.counted, 1.0, p.bank[BANK_SIGHT])
            shifts[copy] = max(0.0, shifts[copy] + score)
            beyond = beyond or shifts[copy] > p.telling[copy]
    apart[:] = 0.0
    return beyond


def payload_change_find(p: PayloadChangeArrays, x: PayloadChangeState) -> None:
    """Tell the payload anew; nothing has been learnt of it, nor of what it leaves over."""
    m, missed, squares = p.outputs, x.missed_by, x.squares
    if x.seen < 0.5:
        return
    cost, best = np.zeros(p.copies), 0
    for copy in range(p.copies):
        for i in range(m):
            at = copy * m + i
            cost[copy] += squares[at] - missed[at] * missed[at] / x.seen
        if cost[copy] < cost[best]:
            best = copy
    # A parabola through three costs; of an outermost one through the last three.
    middle = min(max(best, 1), p.copies - 2)
    bent = cost[middle - 1] - 2.0 * cost[middle] + cost[middle + 1]
    away = 0.0
    if bent > 0.0:
        away = 0.5 * (cost[middle - 1] - cost[middle + 1]) / bent
    away = min(max(middle + away, best - 1.0), best + 1.0)
    x.payload = min(max(payload_change_of(p, 0) + away * (payload_change_of(p, 1) - payload_change_of(p, 0)),
                        p.bank[BANK_LEAST]), p.bank[BANK_MOST])  # fmt: skip
    x.shifts[:] = 0.0
    x.sums[:] = 0.0
