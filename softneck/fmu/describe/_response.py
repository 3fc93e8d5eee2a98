"""How a block answers a step: the picture that every FMU carries, whatever else is known of it."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix
from softneck.runtime import Block, load_runtime

from ._svg import line_chart

_DURATION, _AT = 4.0, 0.5  # of the picture, and of the step in it [s]
# Plain Python takes some 35 ms for a sample of nonlinear predictive control, and an FMU is built in two seconds.
_SHORT = {"nmpc": (0.5, 0.1)}
_MANY = 1_000_000  # numbers
# role -> the input that steps (the first of these that there is), by how much, and what shows the answer.
_STEPS = {
    "plant": (("motor_setpoint_1",), 2.0, ("pitch", "roll")),
    "observer": (("motor_setpoint_1",), 2.0, ("pitch", "roll", "pitch_rate", "roll_rate")),
    "controller": (("pitch_reference", "roll_reference"), 0.1, ("motor_setpoint",)),
    "reference": ((), 0.0, ("pitch_reference", "roll_reference", "cocontraction_reference")),
}


def response_figure(block: Block) -> str:
    """Return a figure (HTML) of the step response of a block, alone and from its start values; "" if it has none."""
    inputs, size, shown = _STEPS[block.role]
    names = [port.name for port in block.inputs]
    stepped = next((name for name in inputs if name in names), "")
    columns = [i for i, port in enumerate(block.outputs) if not port.boolean and _is_shown(port.name, shown)]
    if (inputs and not stepped) or not columns:
        return ""
    duration, at = _SHORT.get(block.kind, (_DURATION, _AT))
    samples = min(round(duration / block.sample_time), 2000)
    u = np.tile([port.start for port in block.inputs], (samples, 1)).reshape(samples, len(names))
    u[:, [i for i, port in enumerate(block.inputs) if port.missing]] = np.nan
    if stepped:
        u[round(at / block.sample_time) :, names.index(stepped)] += size
    y = _answers(block, u)
    if not np.isfinite(y[:, columns]).all():
        return ""
    units = {block.outputs[i].unit for i in columns}
    degrees = units <= {"rad", "rad/s"} and block.role != "controller"
    factor, unit = (180.0 / np.pi, "deg, deg/s" if "rad/s" in units else "deg") if degrees else (1.0, "rad")
    time = block.sample_time * np.arange(samples)
    curves = {block.outputs[i].name: factor * y[:, i] for i in columns}
    what = f"Answer to a step of {size:g} rad in {stepped}" if stepped else "Course"
    alone = "" if block.role == "plant" or not stepped else ", alone, with all other inputs at their start values"
    return f"<figure>{line_chart(time, curves, title=what, unit=unit)}<figcaption>{what}{alone}.</figcaption></figure>"


def _is_shown(name: str, shown: tuple[str, ...]) -> bool:
    return name in shown or name.rstrip("_0123456789") in shown


def _answers(block: Block, u: Matrix) -> Matrix:
    # Plain: the picture's bytes must not depend on who compiled what. A million points would take 20 s so, and their
    # search gives the same bits either way. Row 0 of a plant is its start.
    runtime = load_runtime(block.runtime, compiled=sum(array.size for array in block.arrays) > _MANY)
    parameters = np.array([port.start for port in block.parameters])
    state, y = np.zeros(runtime.state_size(block.arrays)), np.zeros((len(u) + 1, len(block.outputs)))
    with np.errstate(all="ignore"):
        runtime.initialise(block.arrays, parameters, state, y[0])
        runtime.run_steps(block.arrays, parameters, state, u, y[1:])
    return y[:-1] if block.role == "plant" else y[1:]
