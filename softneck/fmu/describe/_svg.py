"""Small line charts as SVG text: sharp, a few kB, and the same bytes everywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape

import numpy as np

from softneck.core import Vector

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
