"""Tunable parameters of FMUs: gains of PI and PID; gain, time constant and dead time of linear plants."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from softneck.core import Matrix
from softneck.design.linear._linear_parts_runtime import LinearArrays
from softneck.identification.linear._arx_runtime import ArxArrays
from softneck.identification.linear._state_space_parts_runtime import StateSpaceArrays
from softneck.identification.models._histories_runtime import NarxArrays
from softneck.runtime import Block, Port

_LINEAR_RUNTIME = "softneck.design.linear._linear_controller_runtime"
_GAINS_RUNTIME = "softneck.fmu.describe._tunable_gains_runtime"
# Kind -> endings of its gains' names, in the order of the runtime.
_GAINS = {"pi": ("K", "Ti"), "pid": ("K", "Ti", "Td", "Tf")}
_MEANING = {"K": "gain K", "Ti": "integral time Ti", "Td": "derivative time Td", "Tf": "filter time Tf"}
_LAW = {"pi": "v = K (e + 1/Ti int e)", "pid": "v = K (e + 1/Ti int e - Td s y/(1 + Tf s))"}


# Runtime -> arrays that it lacks of those of `_PLANT_RUNTIME`: `rls` takes set-points only.
_PLANTS = {
    "softneck.identification.linear._rls_runtime": (np.zeros(1),),
    "softneck.identification.linear._oe_runtime": (),
}
_STATE_SPACE_RUNTIME = "softneck.identification.linear._state_space_runtime"
_TUNABLE_STATE_SPACE_RUNTIME = "softneck.fmu.describe._tunable_state_space_runtime"
_PLANT_RUNTIME = "softneck.fmu.describe._tunable_plant_runtime"
# A dead time may be twice as long, and this many samples longer at least.
_MORE_DEAD_TIME = 10


def with_tunable_parameters(block: Block) -> Block:
    """Add tunable parameters to a PI, a PID or a linear plant; other blocks are returned unchanged."""
    if block.role != "plant":
        return with_tunable_gains(block)
    in_state_space = block.runtime.partition("@")[0] == _STATE_SPACE_RUNTIME
    return with_tunable_state_space(block) if in_state_space else with_tunable_plant(block)


def with_tunable_plant(block: Block) -> Block:
    """Add gain, time constant and dead time of each output of a first-order transfer function to its parameters.

    The gain keeps its sign, within 0.01 to 100 times that of the model.
    """
    module, at, size = block.runtime.partition("@")
    if module not in _PLANTS:
        return block
    p = ArxArrays(block.arrays)
    if p.a.ndim != 2 or p.a.shape[1] != 1:  # arrays of wrong ranks are refused by name later
        return block
    a = p.a[:, 0]
    gains = p.b.sum(axis=1) / (1.0 + a)
    if not ((a < 0.0) & (a > -1.0) & (gains != 0.0)).all():
        return block
    identified = _rounded([gains, -block.sample_time / np.log(-a)])
    longest = np.maximum(2.0 * p.delay, p.delay + _MORE_DEAD_TIME)
    arrays = _with_history(block.arrays, longest.max() + p.b.shape[1])
    ports = []
    for output, (gain, lag), delay, most in zip(block.outputs, identified, p.delay, longest, strict=False):
        ports += _plant_ports(block, output, (float(gain), float(lag), float(delay)), float(most))
    return replace(
        block,
        runtime=f"{_PLANT_RUNTIME}{at}{size}",
        arrays=(*arrays, *_PLANTS[module], identified, np.array([block.sample_time])),
        parameters=(*block.parameters, *ports),
    )


def with_tunable_state_space(block: Block) -> Block:
    """Add the gain of each output of a stable state space, and its dead time, to its parameters.

    A gain is that from the set-point with the largest one; the others change in proportion.
    """
    p = StateSpaceArrays(block.arrays)
    matrices = all(array.ndim == p.A.ndim == len(p.A.shape[:2]) for array in (p.B, p.K))  # others are refused later
    if not matrices or np.abs(np.linalg.eigvals(p.A)).max() >= 1.0:
        return block
    outputs = p.K.shape[1]
    static = np.linalg.solve(np.eye(len(p.A)) - p.A, p.B)[:outputs]
    motors = np.abs(static).argmax(axis=1)
    identified = _rounded([static[np.arange(outputs), motors]])[:, 0]
    if not identified.all():
        return block
    delay = float(p.delay[0])
    longest = max(2.0 * delay, delay + _MORE_DEAD_TIME)
    ports = []
    for output, gain, motor in zip(block.outputs, identified.tolist(), motors, strict=False):
        low, high = _span(gain)
        source = block.inputs[motor]
        what = f"static gain of {output.name} from {source.name}, with those from others in proportion"
        ports.append(
            Port(name=f"{output.name}_gain", unit=_per(source.unit, output.unit), start=gain, minimum=low, maximum=high,
                 tunable=True, description=what)
        )  # fmt: skip
    what = f"dead time of all outputs in samples of {block.sample_time:g} s, beside that of the motors"
    ports.append(
        Port(name="dead_time", start=delay, minimum=0.0, maximum=longest, integer=True, tunable=True, description=what)
    )
    return replace(
        block,
        runtime=_TUNABLE_STATE_SPACE_RUNTIME + block.runtime.removeprefix(_STATE_SPACE_RUNTIME),
        arrays=(*_with_history(block.arrays, longest + 1.0), identified),
        parameters=(*block.parameters, *ports),
    )


def _with_history(arrays: Sequence[Matrix], samples: float) -> list[Matrix]:
    """Return the arrays of a plant with histories of at least so many samples, for the longest dead time."""
    found, place = list(arrays), NarxArrays.place("history")
    found[place] = found[place].copy()
    found[place][0] = max(found[place][0], samples)
    return found


def _plant_ports(block: Block, output: Port, values: Sequence[float], most: float) -> list[Port]:
    (gain, lag, delay), Ts = values, block.sample_time
    low, high = _span(gain)
    unit = _per(block.inputs[0].unit, output.unit)
    return [
        Port(name=f"{output.name}_gain", unit=unit, start=gain, minimum=low, maximum=high, tunable=True,
             description=f"static gain of {output.name}"),
        Port(name=f"{output.name}_time_constant", unit="s", start=lag, minimum=float(f"{0.01 * min(lag, Ts):.3g}"),
             maximum=float(f"{100.0 * lag:.3g}"), tunable=True, description=f"time constant of {output.name}"),
        Port(name=f"{output.name}_dead_time", start=delay, minimum=0.0, maximum=most, integer=True, tunable=True,
             description=f"dead time of {output.name} in samples of {Ts:g} s, beside that of its motors"),
    ]  # fmt: skip


def _span(gain: float) -> tuple[float, float]:
    """Return the range of a gain."""
    low, high = sorted(float(f"{factor * gain:.3g}") for factor in (0.01, 100.0))
    return low, high


def _per(over: str, under: str) -> str:
    """Return the unit of a gain from `over` to `under`."""
    return "1" if over == under else f"{under}/{over}"


def _rounded(columns: Sequence[np.ndarray]) -> Matrix:
    """Return columns side by side, to fifteen digits: rounding of the design is not shown."""
    return np.array([[float(f"{value:.15g}") for value in row] for row in np.transpose(columns)])


def with_tunable_gains(block: Block) -> Block:
    """Add the gains of each axis of a PI or PID to its parameters; other blocks are returned unchanged.

    K keeps its sign, within 0.01 to 100 times that of the design; times go down to 0, Ti to the sample time.
    """
    module, at, size = block.runtime.partition("@")
    if module != _LINEAR_RUNTIME or block.kind not in _GAINS:
        return block
    gains = _gains(block.kind, block.arrays)
    if gains is None:
        return block
    # The references come first, then co-contraction.
    references, common = block.inputs[: len(gains)], block.inputs[len(gains)]
    ports = [
        port
        for reference, row in zip(references, gains.tolist(), strict=True)
        for port in _ports(block, reference, common.unit, row)
    ]
    return replace(
        block,
        runtime=f"{_GAINS_RUNTIME}{at}{size}",
        arrays=(*block.arrays, gains),
        parameters=(*block.parameters, *ports),
    )


def _ports(block: Block, reference: Port, motors: str, gains: Sequence[float]) -> list[Port]:
    axis, Ts = reference.name.removesuffix("_reference"), block.sample_time
    unit = _per(reference.unit, motors)
    ports = []
    for name, start in zip(_GAINS[block.kind], gains, strict=True):
        if name == "K":
            low, high = _span(start)
        else:
            low, high = min(start, Ts) if name == "Ti" else 0.0, float(f"{1e4 * max(start, Ts):.3g}")
        what = f"{_MEANING[name]} of {axis} in {_LAW[block.kind]}"
        ports.append(
            Port(
                name=f"{axis}_{name}",
                unit=unit if name == "K" else "s",
                start=start,
                minimum=low,
                maximum=high,
                description=what,
                tunable=True,
            )
        )
    return ports


def _gains(kind: str, arrays: tuple[Matrix, ...]) -> Matrix | None:
    """Return the gains (outputs, 2 or 4) of the arrays of a PI or PID; None where they have another form."""
    p = LinearArrays(arrays)
    m, Ts = len(p.Dr), float(p.constants[0])
    axes, states = np.arange(m), len(_GAINS[kind]) // 2
    if p.Br.ndim != 2 or len(p.A) != states * m:
        return None
    rate, direct = p.Br[states * axes, axes], p.Dr[axes, axes]
    K = direct if kind == "pi" else direct - rate
    if not (K.all() and rate.all()):
        return None
    columns = [K, Ts / rate if kind == "pi" else K * Ts / rate]
    if kind == "pid":
        a, input_gain = p.A[2 * axes + 1, 2 * axes + 1], p.By[2 * axes + 1, axes]
        if not (a < 1.0).all():
            return None
        Tf = a * Ts / (1.0 - a)
        columns += [input_gain / (1.0 - a) * (Tf + Ts) / K, Tf]
    gains = _rounded(columns)
    return gains if (gains[:, 1:] >= 0.0).all() and (gains[:, 1] > 0.0).all() else None
