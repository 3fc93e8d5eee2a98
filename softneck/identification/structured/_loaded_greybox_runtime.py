"""Grey box of several payloads: the payload changes two parameters of the equations in proportion.

Its moment takes from the stiffness, in both directions alike and against the vertical, so that the link's own rest and
asymmetry pull as they did; its weight takes from the stretch of the tendons at rest. Both are lines through the
payloads of the recordings; between those they hold, beyond them nothing is known.
"""

import numpy as np

from softneck.identification.structured._neck_equations_runtime import (
    NECK_ASYMMETRY,
    NECK_PRETENSION,
    NECK_REST,
    NECK_STIFFNESS,
    GreyBoxArrays,
    GreyBoxState,
    greybox_rest,
    greybox_step,
)
from softneck.runtime._layout import array

# Places in `load`.
LOAD_LEAST = 0
LOAD_MOST = 1
LOAD_STIFFNESS = 2
LOAD_PRETENSION = 3


class LoadedGreyBoxArrays(GreyBoxArrays):
    """The arrays of one payload, with the parameters at zero payload, and the payload's."""

    payload = array("4", "least and most payload of the recordings [kg], stiffness [1/(s kg)], pretension [rad/kg]")


def loaded_neck(neck: np.ndarray, load: np.ndarray, payload: float) -> np.ndarray:
    """Return the numbers of the equations under a payload [kg]."""
    found = neck.copy()
    stiffness = neck[NECK_STIFFNESS]
    softer = stiffness + load[LOAD_STIFFNESS] * payload
    # Nearly none of it is a thousandth: what the link's own rest and asymmetry pull is divided by it.
    if abs(softer) < 1e-3 * stiffness:
        softer = 1e-3 * stiffness
    found[NECK_STIFFNESS] = softer
    found[NECK_ASYMMETRY] *= stiffness / softer
    found[NECK_REST] *= stiffness / softer
    found[NECK_REST + 1] *= stiffness / softer
    found[NECK_PRETENSION] += load[LOAD_PRETENSION] * payload
    return found


def initialise(p: LoadedGreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, outputs: np.ndarray) -> None:
    """Rest under the payload: motors at zero, the neck settled."""
    greybox_rest(p, loaded_neck(p.neck, p.payload, float(parameters[p.outputs + 3])), parameters, x, outputs)


def step(
    p: LoadedGreyBoxArrays, parameters: np.ndarray, x: GreyBoxState, inputs: np.ndarray, outputs: np.ndarray
) -> None:
    """Advance by one sample; the last parameter is the payload, which may change at any time."""
    payload = float(parameters[p.outputs + 3])
    greybox_step(p, loaded_neck(p.neck, p.payload, payload), parameters, x, inputs, outputs)
    if payload < p.payload[LOAD_LEAST] or payload > p.payload[LOAD_MOST]:
        outputs[outputs.shape[0] - 1] = 0.0
