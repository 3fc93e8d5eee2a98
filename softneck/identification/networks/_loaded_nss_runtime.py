"""Neural state space of several payloads: the map takes the payload as an input, alone and times each other input.

So what the motors do goes with the payload in proportion to it, and what hangs there pulls by itself; neurons bend
both. Between the payloads of the recordings that holds, beyond them nothing is known.
"""

import numpy as np

from softneck.identification.models._bank_runtime import load_advance
from softneck.identification.models._feedforward_runtime import echo_added, echo_rest, stalling_drives
from softneck.identification.models._histories_runtime import narx_forward, narx_observe, narx_rest
from softneck.identification.networks._nss_map_runtime import nss_inputs, nss_loaded
from softneck.identification.networks._nss_parts_runtime import NssArrays, NssState, nss_advance, nss_output
from softneck.runtime._layout import array


class LoadedNssArrays(NssArrays):
    """As those of one payload, with more inputs."""

    B = array("n, 2 * channels * (1 + w) + 1", "of the inputs v, of v times the payload [1/kg], and of the payload")
    G = array("q, 2 * channels * (1 + w) + 1", "")
    payload = array("2", "least and most payload of the recordings [kg]")


def initialise(p: LoadedNssArrays, parameters: np.ndarray, x: NssState, outputs: np.ndarray) -> None:
    """Rest under the payload: motors at zero, the neck settled; what the start is above that is remembered."""
    narx_rest(p, parameters, x, outputs)
    v = np.zeros(p.B.shape[1])
    nss_loaded(float(parameters[p.outputs + 3]), v)
    # Long enough: the map contracts, so that what it began with is forgotten.
    for _ in range(int(p.memory[0])):
        nss_advance(p, x.x, v)
    for axis in range(p.outputs):
        echo_rest(p, x, axis, nss_output(p, x.x, axis))


def step(p: LoadedNssArrays, parameters: np.ndarray, x: NssState, inputs: np.ndarray, outputs: np.ndarray) -> None:
    """Advance by one sample; the last parameter is the payload, which may change at any time."""
    payload = float(parameters[p.outputs + 3])
    narx_observe(p, parameters, x, inputs)
    load_advance(p.load, x.m[0], x.q)
    v = np.empty(p.B.shape[1])
    nss_inputs(p.redefinition, p.widths, x.m[int(p.delay[0])], x.plays, v)
    nss_loaded(payload, v)
    nss_advance(p, x.x, v)
    ahead = np.empty(p.outputs)
    for axis in range(p.outputs):
        ahead[axis] = echo_added(p, p.echo, x, axis, nss_output(p, x.x, axis))
    narx_forward(p, parameters, x, ahead, outputs)
    stalling_drives(p, p.load, x.q, x, outputs)
    if payload < p.payload[0] or payload > p.payload[1]:
        outputs[outputs.shape[0] - 1] = 0.0
