"""Figures of an FMU's pages: line charts as SVG text, and how a block answers a step.

Sharp, a few kB, and the same bytes everywhere; every FMU carries the answer, whatever else is known of its block.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import Block, Port, load_runtime

from ._units import display_unit

_WIDTH, _HEIGHT = 640.0, 256.0
_LEFT, _RIGHT, _TOP, _BOTTOM = 56.0, 12.0, 44.0, 34.0
_LETTER = 7.0  # width of one, on the safe side
# Distinguishable in grey and with any colour vision (Okabe and Ito 2008).
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00")
# A curve has no more points than the picture has pixels.
_POINTS = 600


def line_chart(time: Vector, curves: Mapping[str, Vector], *, title: str, unit: str) -> str:
    """Return an SVG of `curves` (name -> (n,) values) over `time` (n,) [s]; samples that are not finite are gaps."""
    step = max(1, math.ceil(time.size / _POINTS))
    t = time[::step]
    low, high = _limits(list(curves.values()))
    across = (_WIDTH - _LEFT - _RIGHT) / max(float(t[-1] - t[0]), 1e-12)
    up = (_HEIGHT - _TOP - _BOTTOM) / (high - low)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}" role="img" '
        f'font-family="sans-serif" font-size="12"><title>{escape(title)}</title>',
        f'<text x="{_LEFT:g}" y="16">{escape(title)} [{escape(unit)}]</text>',
    ]
    for value in _ticks(low, high):
        y = _HEIGHT - _BOTTOM - (value - low) * up
        parts.append(f'<path d="M{_LEFT:g} {y:.1f}H{_WIDTH - _RIGHT:g}" stroke="#ddd"/>')
        parts.append(f'<text x="{_LEFT - 6:g}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in _ticks(float(t[0]), float(t[-1])):
        x = _LEFT + (value - float(t[0])) * across
        parts.append(f'<text x="{x:.1f}" y="{_HEIGHT - 16:g}" text-anchor="middle">{value:g}</text>')
    parts.append(f'<text x="{_WIDTH - _RIGHT:g}" y="{_HEIGHT - 3:g}" text-anchor="end">time [s]</text>')
    place = _LEFT  # of the next name, in a line of their own below the title
    for number, (name, values) in enumerate(curves.items()):
        colour = _COLOURS[number % len(_COLOURS)]
        x = _LEFT + (t - t[0]) * across
        y = _HEIGHT - _BOTTOM - (np.asarray(values)[::step] - low) * up
        parts.append(f'<path d="{_path(x, y)}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        parts.append(f'<text x="{place:g}" y="34" fill="{colour}">{escape(name)}</text>')
        place += _LETTER * (len(name) + 2)
    return "".join([*parts, "</svg>"])


def _limits(curves: list[Vector]) -> tuple[float, float]:
    values = np.concatenate([np.asarray(curve)[np.isfinite(curve)] for curve in curves])
    if not values.size:
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or max(abs(high), 1.0)
    return low - margin, high + margin


def _ticks(low: float, high: float) -> list[float]:
    """Return about five round numbers from `low` to `high`."""
    span = max(high - low, 1e-12)
    power = 10.0 ** math.floor(math.log10(span / 5.0))
    step = power * min((1.0, 2.0, 5.0, 10.0), key=lambda factor: abs(span / (factor * power) - 5.0))
    return [round(step * k, 12) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _path(x: Vector, y: Vector) -> str:
    parts, drawing = [], False
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        finite = math.isfinite(b)
        if finite:
            parts.append(f"{'L' if drawing else 'M'}{a:.1f} {b:.1f}")
        drawing = finite
    return "".join(parts)


_DURATION, _AT = 4.0, 0.5  # of the picture, and of the step in it [s]
# Plain Python takes some 35 ms for a sample of nonlinear predictive control, and an FMU is built in two seconds.
_SHORT = {"nmpc": (0.5, 0.1)}
_MANY = 1_000_000  # numbers
_STEP = {"plant": 2.0, "observer": 2.0, "controller": 0.1}  # of the first set-point, or the first reference [rad]


def response_figure(block: Block) -> str:
    """Return a figure (HTML) of the step response of a block, alone and from its start values; "" if it has none."""
    names = [port.name for port in block.inputs]
    stepped = _stepped(block)
    columns = _shown(block)
    if (stepped is None and block.role != "reference") or not columns:
        return ""
    size = 0.0 if stepped is None else _size(stepped, block.role)
    duration, at = _SHORT.get(block.kind, (_DURATION, _AT))
    samples = min(round(duration / block.sample_time), 2000)
    u = np.tile([port.start for port in block.inputs], (samples, 1)).reshape(samples, len(names))
    u[:, [i for i, port in enumerate(block.inputs) if port.missing]] = np.nan
    if stepped is not None:
        u[round(at / block.sample_time) :, names.index(stepped.name)] += size
    y = _answers(block, u)
    if not np.isfinite(y[:, columns]).all():
        return ""
    controls = block.role == "controller"  # set-points as they are sent
    shown = {i: (block.outputs[i].unit, 1.0) if controls else display_unit(block.outputs[i]) for i in columns}
    unit = ", ".join(sorted({name for name, _ in shown.values()}))
    time = block.sample_time * np.arange(samples)
    curves = {block.outputs[i].name: factor * y[:, i] for i, (_, factor) in shown.items()}
    what = "Course" if stepped is None else f"Answer to a step of {size:g} {stepped.unit} in {stepped.name}"
    alone = "" if block.role == "plant" or stepped is None else ", alone, with all other inputs at their start values"
    return f"<figure>{line_chart(time, curves, title=what, unit=unit)}<figcaption>{what}{alone}.</figcaption></figure>"


def _stepped(block: Block) -> Port | None:
    """Return the input that steps: the first reference of a controller, the first set-point of others; None: none."""
    ending = "_reference" if block.role == "controller" else "motor_setpoint_1"
    steps = (port for port in block.inputs if port.name.endswith(ending) and block.role != "reference")
    return next(steps, None)


def _size(stepped: Port, role: str) -> float:
    """Return the size of a step; where that of a neck means nothing, half of what the input goes to."""
    high = stepped.maximum
    return _STEP[role] if stepped.unit == "rad" or high is None else 0.5 * high


def _shown(block: Block) -> list[int]:
    """Return which outputs answer: set-points of a controller, references, else what is measured and its rate."""
    measured = {port.name.removesuffix("_measured") for port in (*block.inputs, *block.outputs)
                if port.name.endswith("_measured")}  # fmt: skip
    found = {
        "controller": lambda name: name.startswith("motor_setpoint_"),
        "reference": lambda name: name.endswith("_reference"),
        "observer": lambda name: name.removesuffix("_rate") in measured,
        "plant": lambda name: name in measured,
    }[block.role]
    numbers = [i for i, port in enumerate(block.outputs) if not port.boolean]
    return [i for i in numbers if found(block.outputs[i].name)]


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
