"""Play operators and low-pass filters, polynomials of them, and a linear noise model of measured errors.

The histories hold the measured output less the feed-forward part f, else the echo itself: y(k+1) = f(k+1) +
sum_i echo_i (y - f)(k+1-i). f has no feedback at all and is kept within `range`; the echo is a stable filter that
dies out when nothing is measured. So no free run can diverge.
"""

import numpy as np

from softneck.identification.models._bank_runtime import bank_advance, load_advance, monomial
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import (
    NarxArrays,
    NarxState,
    narx_forward,
    narx_observe,
    narx_rest,
)
from softneck.runtime._layout import array, cells, value


class PlayArrays(NarxArrays):
    """The bank of operators and filters, and the polynomial over it."""

    load = array("limits = 4 | 6", "where a drive stalls: pole, c, c1, c2; of valves two poles (see `_bank_runtime`)")
    redefinition = array("c, motors", "T of Eq. 9-11: motors to redefined inputs")
    widths = array("w", "widths of the play operators behind each redefined input [rad]")
    chain = array("2", "pole and number of the equal low-pass filters behind each operator")
    table = array("terms, 3", "signals of the bank that each term multiplies; -1 stands for 1")
    weights = array("outputs, terms", "of the terms, for each axis")
    range = array("outputs, 2", "least and largest f of each axis [rad]")
    echo = array("outputs, p", "of what was measured above f, newest first")
    memory = array("1", "samples after which a held start has settled")
    order = value("chain", 1)


class PlayState(NarxState):
    """Histories, load, operators and filters."""

    q = cells("motors", "motor positions behind a low-pass: the load of now [rad]")
    plays = cells("c * w", "play operators [rad]")
    bank = cells("c * (w + 1) * order", "filters [rad]")


def play_output(p: PlayArrays, bank: np.ndarray, axis: int) -> float:
    """Return the feed-forward part f of one axis."""
    y = 0.0
    for i in range(p.terms):
        y += p.weights[axis, i] * monomial(p.table, i, bank)
    return min(max(y, p.range[axis, 0]), p.range[axis, 1])  # a polynomial knows no bound outside of its data


def initialise(p: PlayArrays, parameters: np.ndarray, x: PlayState, outputs: np.ndarray) -> None:
    """Rest: motors at zero, the output at its start value; its difference to f is kept as a measured error."""
    narx_rest(p, parameters, x, outputs)
    for axis in range(p.outputs):
        echo_rest(p, x, axis, play_output(p, x.bank, axis))


def step(p: PlayArrays, parameters: np.ndarray, x: PlayState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample."""
    narx_observe(p, parameters, x, inputs)
    # q, plays and filters take m(k) in and stand at k+1: what is read from them is y(k+1).
    load_advance(p.load, x.m[0], x.q)
    bank_advance(p.redefinition, p.widths, p.chain, x.m[0], x.plays, x.bank)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = echo_added(p, p.echo, x, axis, play_output(p, x.bank, axis))
    narx_forward(p, parameters, x, ahead, outputs)
    # The lag of `narx_forward` knows no load: these positions replace its own.
    stalling_drives(p, p.load, x.q, x, outputs)
