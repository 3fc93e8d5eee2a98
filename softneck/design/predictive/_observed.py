"""What a predictive design takes from its loop's observer: look-ahead, and how taut a payload wants tendons."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from softneck.core import Matrix, SettingsError
from softneck.identification import Model
from softneck.robot._neck_default import NeckDefault
from softneck.signals import redefinition_matrix

# Small moves that tell whether tendons hang [rad of a redefined input], and how long the model settles before [s].
_MOVE, _SETTLED = 0.3, 3.0
# Tendons are taut where such a move does this part of the most that it does anywhere.
_TAUT = 0.9
# Co-contractions that are tried, from rest on [rad].
_STEP, _MOST = 0.25, 4.0

# Part of `least_delay` that is a sensor's at most.
_BEHIND = 0.5

S = TypeVar("S", bound=Any)


def over(settings: S, observer: Any) -> S:
    """Return settings for a loop with this observer; what was given stays.

    Args:
        settings: of `mpc` or `nmpc`.
        observer: whose `lead` becomes `look_ahead`, of `mpc` at most half of `least_delay`; if it tells a payload, its
            model says `payload_tautness`.

    Raises:
        SettingsError: what is no observer.
    """
    if not hasattr(observer, "lead"):
        raise SettingsError(f"an observer is needed, of `softneck observer`; got {type(observer).__name__}.")
    found: dict[str, float] = {}
    if isinstance(settings.look_ahead, NeckDefault):
        # What `least_delay` adds stands for a dead time that recordings hide, and no sensor is later for that.
        found["look_ahead"] = min(observer.lead, _BEHIND * getattr(settings, "least_delay", math.inf))
    told, wished = getattr(observer, "payloads", None), settings.minimum_tautness is not None
    asks = isinstance(getattr(settings, "payload_tautness", None), NeckDefault)
    if asks and wished and told is not None and told[1] > 0.0:
        inverse = np.linalg.inv(redefinition_matrix(np.array(settings.tendon_angles)))
        # On top of `minimum_tautness`: what is in reserve without payload is there with it.
        found["payload_tautness"] = taut_from(observer.model, told[1], inverse) / told[1]
    return replace(settings, **found)


def taut_from(model: Model, payload: float, inverse: Matrix) -> float:
    """Return the least co-contraction [rad] from rest on at which small moves do under a payload what they can."""
    tried = np.arange(0.0, _MOST + _STEP / 2, _STEP)
    gains = np.array([_gain(model, payload, common, inverse) for common in tried])
    return float(tried[np.argmax(gains >= _TAUT * gains.max())])


def _gain(model: Model, payload: float, common: float, inverse: Matrix) -> float:
    """Return the mean static gain of small moves to both sides, of all axes."""
    block, rows = model.block(), round(_SETTLED / model.sample_time)
    motors, found = inverse.shape[0], []
    for axis in range(len(model.robot.outputs.names)):
        inputs = np.full((3 * rows, len(block.inputs)), np.nan)
        for part, side in enumerate((0.0, 1.0, -1.0)):
            inputs[part * rows : (part + 1) * rows, :motors] = common + side * _MOVE * inverse[:, axis]
        _, outputs = block.run(block.initial_state(use_measurement=0.0, payload=payload), inputs)
        found.append(abs(outputs[2 * rows - 1, axis] - outputs[-1, axis]) / (2.0 * _MOVE))
    return float(np.mean(found))
