"""Grey box of several payloads: the payload changes two parameters of the equations in proportion.

Its moment takes from the stiffness, in both directions alike and against the vertical, so that the link's own rest and
asymmetry pull as they did; its weight takes from the stretch of the tendons at rest. Both follow the payload along a
line, or along w = (1 - exp(-c s)) / (1 - exp(-c)), s from 0 to 1 between the least and the most payload, where three
payloads tell how they saturate. Between the payloads they hold, beyond them nothing is known.
"""

import math

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
LOAD_CURVE = 4  # older files have none


class LoadedGreyBoxArrays(GreyBoxArrays):
    """The arrays of one payload, with the parameters at zero payload, and the payload's."""

    payload = array(
        "loads",
        "least and most payload of the recordings [kg], stiffness [1/(s kg)], pretension [rad/kg], c of the law",
    )


def effective_payload(load: np.ndarray, payload: float) -> float:
    """Return the payload on the line through the ends that changes as much as `payload` does on the curve [kg]."""
    curve = load[LOAD_CURVE] if load.shape[0] > LOAD_CURVE else 0.0
    span = load[LOAD_MOST] - load[LOAD_LEAST]
    if curve < 1e-6 or span <= 0.0:
        return payload
    part = min(max((payload - load[LOAD_LEAST]) / span, 0.0), 1.0)
    return load[LOAD_LEAST] + span * (1.0 - math.exp(-curve * part)) / (1.0 - math.exp(-curve))


def loaded_neck(neck: np.ndarray, load: np.ndarray, payload: float) -> np.ndarray:
    """Return the numbers of the equations under a payload [kg]."""
    found = neck.copy()
    stiffness = neck[NECK_STIFFNESS]
    along = effective_payload(load, payload)
    softer = stiffness + load[LOAD_STIFFNESS] * along
    # Nearly none of it is a thousandth: what the link's own rest and asymmetry pull is divided by it.
    if abs(softer) < 1e-3 * stiffness:
        softer = 1e-3 * stiffness
    found[NECK_STIFFNESS] = softer
    found[NECK_ASYMMETRY] *= stiffness / softer
    found[NECK_REST] *= stiffness / softer
    found[NECK_REST + 1] *= stiffness / softer
    found[NECK_PRETENSION] += load[LOAD_PRETENSION] * along
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
