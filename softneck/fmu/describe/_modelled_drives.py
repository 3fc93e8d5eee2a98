"""A controller's block as its FMU holds it: beside a model of the drives, which foreign simulators do not connect."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softneck.loop._loop import USE_MOTOR_POSITIONS
from softneck.plant import NeckParameters
from softneck.runtime import Block, Port

_RUNTIME = "softneck.fmu.describe._modelled_drives_runtime"
# Where the runtime finds them.
_POSITIONS = [f"motor_position_{j}" for j in (1, 2, 3)]
_PARAMETER = Port(
    name=USE_MOTOR_POSITIONS,
    description="true: the motors are where motor_position_1..3 say; false: a model of the drives inside says it",
    boolean=True,
    minimum=0.0,
    maximum=1.0,
)


def with_modelled_drives(block: Block) -> Block:
    """Return a controller with the drives inside and the parameter that says which positions hold; others as they are.

    No file of a controller knows its drives: they are those of the paper's neck.
    """
    inputs = [port.name for port in block.inputs]
    if block.role != "controller" or inputs[5:8] != _POSITIONS or len(block.outputs) != len(_POSITIONS):
        return block
    if _PARAMETER.name in {port.name for port in block.parameters}:  # out of an FMU, which has them
        return block
    neck, Ts = NeckParameters.paper(), block.sample_time
    # A set-point that is `drive_latency` late acts from the first sample on that is no earlier, and shows one later.
    delay = 1 + math.ceil(neck.drive_latency / Ts - 1e-9)
    drive = np.array([math.exp(-neck.position_gain * Ts), delay])
    return replace(
        block,
        runtime=f"{_RUNTIME}({block.runtime}:{len(block.arrays)})",
        arrays=(drive, *block.arrays),
        parameters=(*block.parameters, _PARAMETER),
    )
