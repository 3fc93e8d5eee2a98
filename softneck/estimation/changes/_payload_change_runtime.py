"""A model of several payloads in free run beside the loop under each of them: which one it is, or that it is none.

What each copy misses is summed with exponential weights, over how much the model misses in such a motion of the neck
that it knows, and less an offset that a sensor may have. The payload is where a parabola through the least of these
costs and its neighbours is lowest. It is told anew only while the copies part far enough in what was measured of late:
while the neck stands or hardly moves nothing is learnt of it. The cumulative sums are over what the model misses at
that payload: a change that no payload explains.
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
    change_period,
    change_see,
)
from softneck.runtime._layout import array, cells, rest, value
from softneck.runtime._members_runtime import member_size

# Places in `bank`.
BANK_LEAST = 0  # [kg]
BANK_MOST = 1  # [kg]
BANK_COPIES = 2  # of the model, at as many payloads from least to most
BANK_KEEP = 3  # part of the sums that a sample keeps
BANK_INFORMED = 4  # squared distance of the outermost copies, over the spread, from which on they tell
BANK_OFFSET = 5  # an offset of each output counts as so many samples that were measured to be zero


class PayloadChangeArrays(ChangeArrays):
    """As without payloads, then how the copies are weighed."""

    bank = array("6", "see BANK_*")
    copies = value("bank", BANK_COPIES)


class PayloadChangeState(ChangeCells):
    """As without payloads, then of each copy what it misses; their own states follow."""

    payload = cells("", "[kg] that the neck is thought to bear")
    told = cells("copies, outputs", "angles of each copy")
    missed_by = cells("copies, outputs", "sum of what each misses, over the spread")
    squares = cells("copies, outputs", "sum of its squares")
    apart = cells("outputs", "sum of the outermost copies' distance, over the spread")
    apart_squares = cells("outputs", "sum of its squares")
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
        if x.fastest > p.chart[CHANGE_STILL] and x.samples >= p.chart[CHANGE_QUIET]:
            payload_change_weigh(p, x, measured)
    ends = x.elapsed + 1.0 >= p.chart[CHANGE_PERIOD]
    change_period(p, x)
    if ends:
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
    """Take in what each copy misses, and how far the outermost are apart."""
    keep, m, told = p.bank[BANK_KEEP], p.outputs, x.told
    missed, squares = x.missed_by, x.squares
    x.seen = keep * x.seen + 1.0
    for i in range(m):
        y = x.angles[i]
        spread = math.sqrt(p.spread[i, 0] + p.spread[i, 1] * x.fastest * x.fastest + p.spread[i, 2] * y * y)
        for copy in range(p.copies):
            at = copy * m + i
            e = (measured[i] - told[at]) / spread
            missed[at] = keep * missed[at] + e
            squares[at] = keep * squares[at] + e * e
        d = (told[(p.copies - 1) * m + i] - told[i]) / spread
        x.apart[i] = keep * x.apart[i] + d
        x.apart_squares[i] = keep * x.apart_squares[i] + d * d


def payload_change_find(p: PayloadChangeArrays, x: PayloadChangeState) -> None:
    """Tell the payload anew, if what was measured of late says something of it."""
    if x.seen < 0.5:
        return
    weight, m = x.seen + p.bank[BANK_OFFSET], p.outputs
    missed, squares, informed = x.missed_by, x.squares, 0.0
    for i in range(m):
        informed += x.apart_squares[i] - x.apart[i] * x.apart[i] / weight
    if informed < p.bank[BANK_INFORMED]:
        return
    cost, best = np.zeros(p.copies), 0
    for copy in range(p.copies):
        for i in range(m):
            at = copy * m + i
            cost[copy] += squares[at] - missed[at] * missed[at] / weight
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
