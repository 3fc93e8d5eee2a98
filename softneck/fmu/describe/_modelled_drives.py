"""A controller's block as its FMU holds it: beside a model of the drives, which foreign simulators do not connect."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from softneck.loop._loop import USE_MOTOR_POSITIONS
from softneck.plant import NeckParameters
from softneck.runtime import Block, Port

_RUNTIME = "softneck.fmu.describe._modelled_drives_runtime"
# Where a neck's controller has its motor positions, and how many; the runtime takes them where nothing else is said.
_NECK = (5, 3)


def with_modelled_drives(block: Block) -> Block:
    """Return a controller with the drives inside and the parameter that says which positions hold; others as they are.

    No file of a controller knows its drives: they are those of the paper's neck.
    """
    motors = len([port for port in block.outputs if port.name.startswith("motor_setpoint_")])
    inputs, positions = [port.name for port in block.inputs], [f"motor_position_{j + 1}" for j in range(motors)]
    first = inputs.index(positions[0]) if positions and positions[0] in inputs else len(inputs)
    if block.role != "controller" or inputs[first : first + motors] != positions or motors != len(block.outputs):
        return block
    # Drives of another quantity are not the paper's; and a block out of an FMU has them.
    if block.inputs[first].unit != "rad" or USE_MOTOR_POSITIONS in {port.name for port in block.parameters}:
        return block
    neck, Ts = NeckParameters.paper(), block.sample_time
    # A set-point that is `drive_latency` late acts from the first sample on that is no earlier, and shows one later.
    delay = 1 + math.ceil(neck.drive_latency / Ts - 1e-9)
    drive = [math.exp(-neck.position_gain * Ts), delay, first, motors]
    return replace(
        block,
        runtime=f"{_RUNTIME}({block.runtime}:{len(block.arrays)})",
        arrays=(np.array(drive[:2] if (first, motors) == _NECK else drive), *block.arrays),
        parameters=(*block.parameters, _parameter(motors)),
    )


def _parameter(motors: int) -> Port:
    return Port(
        name=USE_MOTOR_POSITIONS,
        description=f"true: the motors are where motor_position_1..{motors} say; false: a model of the drives inside "
        "says it",
        boolean=True,
        minimum=0.0,
        maximum=1.0,
    )
