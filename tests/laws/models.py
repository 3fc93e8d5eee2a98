"""The plant of a world as an identified linear model of its view: what `oe` finds where nothing disturbs it."""

from __future__ import annotations

import math

import numpy as np

from softneck.core import to_si
from softneck.identification import Model
from softneck.identification.models._linear_systems import lss_arrays

from .worlds import World


def model_of(seen: World) -> Model:
    """Return each output as a lag behind its direction, without the plant's soft limit."""
    plant, view, robot = seen.plant, seen.view, seen.robot
    W = np.array(plant.weights)
    outputs, motors = (list(order or range(n)) for order, n in zip((view.outputs, view.motors), W.shape, strict=True))
    W = W * np.array(view.turned_motors or (1,) * W.shape[1]) * np.array(view.turned or (1,) * len(W))[:, None]
    W = W[outputs][:, motors]
    own = [to_si(plant.robot[key]["unit"])[0] for key in ("motors", "outputs")]
    gain = plant.gain * own[1] * seen.numbers[1] / (own[0] * seen.numbers[0])
    pole, m = math.exp(-1.0 / plant.time_constant), len(W)
    system = (pole * np.eye(m), (1.0 - pole) * gain * W, np.eye(m), 0.1 * np.eye(m))
    entry = {"a": [-pole], "b": [(1.0 - pole) * gain], "delay": plant.delay}
    return Model(
        kind="oe",
        sample_time=seen.recording.sample_time,
        arrays={**lss_arrays(system, delay=plant.delay, drive=np.zeros((W.shape[1], 2))), "offset": np.zeros(m)},
        findings={
            "transfer_functions": dict.fromkeys(robot.outputs.names, entry),
            "directions": W.tolist(),
            "time_constants_s": [plant.time_constant * seen.recording.sample_time] * m,
        },
        robot=robot,
    )
