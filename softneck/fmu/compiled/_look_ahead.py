"""Outputs of an FMU at later samples, whose derivatives by its inputs it gives.

`pitch_next` is the output at the next sample. With a dead time no set-point moves it. A plant therefore also has
`pitch_ahead`: as many samples ahead as the slowest output takes for 63 % of a step, its dead time and time constant.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import takewhile

import numpy as np

from softneck.core import Matrix, SettingsError, Vector
from softneck.robot import is_set_point
from softneck.runtime import Block, Port, TangentError, bundle, load_runtime, load_tangent, with_tangent

from ..describe._description import LookAhead, motor_positions

_RISE = 1.0 - math.exp(-1.0)  # of a first-order lag after its time constant
# A step response is computed over twice as many samples until its second half moves by less than this share of it.
_FIRST_SAMPLES, _MAX_SAMPLES, _SETTLED = 200, 3200, 0.02
# Dependencies are those of derivatives from this many points of a random motion.
_POINTS, _MOTION_SAMPLES = 3, 20


def next_outputs(block: Block) -> tuple[Port, ...]:
    """Return the outputs at the next sample of an FMU with sensitivities.

    These are the robot's outputs for an identified plant, and the leading numeric outputs for other blocks.
    Raises SettingsError: a kind that has no derivative, or no such outputs.
    """
    try:
        with_tangent(bundle(block.runtime, loops=False))
    except TangentError as error:
        raise SettingsError(f"{block.kind} has no sensitivities: {error}") from None
    # Motor positions and innovations are internal to the block.
    aside = (*motor_positions(block), "innovation")
    own = takewhile(lambda p: not (p.boolean or p.integer or p.missing or p.name in aside), block.outputs)
    found = tuple(_later(port, "next", "at the next sample, if the inputs are held") for port in own)
    if not found:
        raise SettingsError(f"{block.kind} ({block.role}) has no sensitivities: none of its outputs is a number.")
    return found


def look_ahead(block: Block) -> tuple[tuple[Port, ...], LookAhead]:
    """Return all additional outputs of an FMU with sensitivities, and what its files say of them.

    Raises SettingsError: as `next_outputs`.
    """
    found = next_outputs(block)
    n = len(found)
    if block.role != "plant":  # its outputs follow the inputs of a sample at once
        return found, LookAhead(next=n, inputs=(tuple(range(len(block.inputs))),) * n)
    horizon = _horizon(block, n)
    what = f"{horizon} samples ({horizon * block.sample_time:.3g} s) ahead, if the set-points are held"
    far = tuple(_later(port, "ahead", what) for port in block.outputs[:n])
    return (*found, *far), LookAhead(n, n, horizon, _dependencies(block, n, horizon))


def _later(port: Port, ending: str, what: str) -> Port:
    return replace(port, name=f"{port.name}_{ending}", description=f"{port.description or port.name} {what}")


def _horizon(block: Block, outputs: int) -> int:
    """Return the samples after which every output has 63 % of its largest answer to a step of a set-point.

    Each set-point steps to its limit; a dead time that is a parameter has its maximum.
    """
    motors = [i for i, port in enumerate(block.inputs) if is_set_point(port.name)]
    if not motors:
        return 1
    samples = _FIRST_SAMPLES
    while True:
        answers = np.array([_step_response(block, motor, samples)[:, :outputs] for motor in motors])
        moved = np.abs(answers - answers[:, :1])  # (motors, time, outputs)
        if samples >= _MAX_SAMPLES or (np.ptp(moved[:, samples // 2 :], axis=1) <= _SETTLED * moved[:, -1]).all():
            break
        samples *= 2
    strongest = moved[moved[:, -1].argmax(axis=0), :, np.arange(outputs)]  # (outputs, time)
    return int((strongest >= _RISE * strongest[:, -1:]).argmax(axis=1).max(initial=1))


def _step_response(block: Block, motor: int, samples: int) -> Matrix:
    """Return the outputs (samples, n_out) after a step of one set-point at row 0; where they diverge they stay."""
    port, runtime = block.inputs[motor], load_runtime(block.runtime, compiled=False)
    limits = [x for x in (port.minimum, port.maximum) if x is not None and np.isfinite(x)]
    u = np.array([math.nan if port.missing else port.start for port in block.inputs])  # at rest
    u[motor] = max(limits, key=abs, default=1.0) or 1.0
    q, x, y = _parameters(block, longest=True), np.zeros(runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
    runtime.initialise(block.arrays, q, x, y)
    found = np.tile(y, (samples, 1))
    with np.errstate(all="ignore"):
        for k in range(1, samples):
            runtime.step(block.arrays, q, x, u, y)
            if not np.isfinite(y).all():
                found[k:] = found[k - 1]
                break
            found[k] = y
    return found


def _parameters(block: Block, *, longest: bool) -> Vector:
    """Return the start values, with the longest or shortest dead times where these are parameters."""
    values = [(port, port.maximum if longest else port.minimum) for port in block.parameters]
    return np.array([port.start if value is None or not (port.integer and port.tunable) else value
                     for port, value in values])  # fmt: skip


def _dependencies(block: Block, outputs: int, horizon: int) -> tuple[tuple[int, ...], ...]:
    """Return the indices of the inputs that move each output at the next sample, then each at the horizon.

    Measurements count, as `use_measurement` may be set, and so does a set-point that only the shortest dead time of a
    parameter lets act. All inputs of a block with members do: which of them are used depends on where it is.
    """
    if "(" in block.runtime:
        return (tuple(range(len(block.inputs))),) * (2 * outputs)
    runtime, tangent = load_runtime(block.runtime, compiled=False), load_tangent(block.runtime, compiled=False)
    q, n_in = _parameters(block, longest=False), len(block.inputs)
    q[[port.boolean for port in block.parameters]] = 1.0
    x, y = np.zeros(runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
    moves, rng = np.zeros((2 * outputs, n_in), dtype=bool), np.random.default_rng(0)
    low, high = _spans(block)
    missing = [port.missing for port in block.inputs]
    with np.errstate(all="ignore"):
        runtime.initialise(block.arrays, q, x, y)
        for _ in range(_POINTS):
            for _ in range(_MOTION_SAMPLES):
                runtime.step(block.arrays, q, x, rng.uniform(low, high), y)
            at, now, u = x.copy(), y.copy(), rng.uniform(low, high)
            X, U, Y = np.zeros((x.size, n_in)), np.eye(n_in), np.zeros((y.size, n_in))
            for k in range(horizon):
                tangent(block.arrays, q, at, u, now, X, U, Y, n_in)
                if k == 0:  # what was measured is known of the first sample only
                    moves[:outputs] |= Y[:outputs] != 0.0
                    u[missing] = math.nan
                    U[missing] = 0.0
            moves[outputs:] |= Y[:outputs] != 0.0
    booleans = [i for i, port in enumerate(block.inputs) if port.boolean]
    return tuple(tuple(sorted({*np.flatnonzero(row).tolist(), *booleans})) for row in moves)


def _spans(block: Block) -> tuple[Vector, Vector]:
    """Return limits of a motion: those of the set-points, small numbers for inputs without any."""
    spans = np.array([
        (port.minimum, port.maximum)
        if port.minimum is not None and port.maximum is not None and np.isfinite([port.minimum, port.maximum]).all()
        else (-0.1, 0.1)
        for port in block.inputs
    ]).reshape(-1, 2)  # fmt: skip
    return spans[:, 0], spans[:, 1]
