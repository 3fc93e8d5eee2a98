"""Gains of PI and PID controllers as tunable parameters of their FMUs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from softneck.core import Matrix
from softneck.design.linear._linear_parts_runtime import LinearArrays
from softneck.runtime import Block, Port

_LINEAR_RUNTIME = "softneck.design.linear._linear_controller_runtime"
_GAINS_RUNTIME = "softneck.fmu.describe._tunable_gains_runtime"
# Kind -> endings of its gains' names, in the order of the runtime.
_GAINS = {"pi": ("K", "Ti"), "pid": ("K", "Ti", "Td", "Tf")}
_MEANING = {"K": "gain K", "Ti": "integral time Ti", "Td": "derivative time Td", "Tf": "filter time Tf"}
_LAW = {"pi": "v = K (e + 1/Ti int e)", "pid": "v = K (e + 1/Ti int e - Td s y/(1 + Tf s))"}


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
    unit = "1" if motors == reference.unit else f"{motors}/{reference.unit}"
    ports = []
    for name, start in zip(_GAINS[block.kind], gains, strict=True):
        if name == "K":
            low, high = sorted(float(f"{factor * start:.3g}") for factor in (0.01, 100.0))
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
    if len(p.A) != states * m:
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
    # Fifteen digits: rounding of the design is not shown.
    gains = np.array([[float(f"{value:.15g}") for value in row] for row in np.transpose(columns)])
    return gains if (gains[:, 1:] >= 0.0).all() and (gains[:, 1] > 0.0).all() else None
