"""The numbers of a page's charts in one small block, which `_page.js` unpacks.

Heights are kept to 1/65534 of their range: 80 times finer than a panel's pixels. Arrays that several charts draw are
held once. What spans more than three powers of ten, as on a log axis, keeps its 32 bits. Of a page with more samples
than it can carry, the least and the most of each piece of the longest curves are kept.
"""

from __future__ import annotations

import base64
import gzip
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from softneck.core import Vector

from ._chart import Chart, Curve

_LEVELS = 65534  # one more stands for NaN
_TICKS = 2**31 - 1
_DECADES = 1e3
# Samples of a page: packed, two bytes each, and a third more as text.
_MOST_SAMPLES = 300_000
_CONTINUOUS = ("line", "dashed", "dotted", "step", "band", "points")


class Packer:
    """Collects the JSON of charts, takes their arrays out and holds each once."""

    def __init__(self) -> None:
        self._charts: dict[str, Any] = {}
        self._arrays: list[dict[str, Any]] = []
        self._known: dict[tuple[str, bytes], int] = {}
        self._bytes = bytearray()

    def add(self, name: str, item: Any) -> None:
        """Take in one chart as `bokeh.embed.json_item` gives it."""
        self._charts[name] = self._lean(item)

    def text(self) -> str:
        """Return all as base64 text."""
        head = json.dumps({"charts": self._charts, "arrays": self._arrays}, separators=(",", ":")).encode()
        return compressed(struct.pack("<I", len(head)) + head + bytes(self._bytes))

    def _lean(self, node: Any) -> Any:
        if isinstance(node, Mapping):
            if node.get("type") == "ndarray" and isinstance(node["array"], Mapping):
                data = gzip.decompress(base64.b64decode(node["array"]["data"]))
                return {**node, "array": {"type": "bytes", "data": self._hold(data, node["dtype"])}}
            return {key: self._lean(value) for key, value in node.items()}
        return [self._lean(one) for one in node] if isinstance(node, list | tuple) else node

    def _hold(self, data: bytes, kind: str) -> int:
        key = (kind, data)
        if key not in self._known:
            self._known[key] = len(self._arrays)
            head, packed = _packed(np.frombuffer(data, dtype=kind))
            self._arrays.append({**head, "start": len(self._bytes)})
            self._bytes += packed
        return self._known[key]


def compressed(data: bytes) -> str:
    """Return bytes as base64 text of their gzip; the same for the same bytes."""
    return base64.b64encode(gzip.compress(data, 9, mtime=0)).decode()


def _packed(values: Vector) -> tuple[dict[str, Any], bytes]:
    """Return what says how an array is packed, and its bytes."""
    double, finite = values.dtype.itemsize == 8, values[np.isfinite(values)].astype(np.float64)
    raw = {"kind": "f8" if double else "f4", "count": values.size}
    if finite.size < 2 or (double and not _even(values)) or (not double and _logarithmic(finite)):
        return raw, values.tobytes()
    low, most = float(finite.min()), _TICKS if double else _LEVELS
    step = float(finite.max() - low) / most or 1.0
    levels = np.full(values.size, _LEVELS + 1, dtype=np.int64)
    levels[np.isfinite(values)] = np.rint((finite - low) / step)
    width = np.uint32 if double else np.uint16
    by = np.diff(levels, prepend=0).astype(width)
    planes = by.view(np.uint8).reshape(-1, by.itemsize).T
    return {"kind": "x" if double else "y", "count": values.size, "low": low, "step": step}, planes.tobytes()


def _even(x: Vector) -> bool:
    by = np.diff(x)
    return bool(np.isfinite(x).all() and by.min() > 0 and not _logarithmic(by))


def _logarithmic(values: Vector) -> bool:
    return bool(values.min() > 0 and values.max() > _DECADES * values.min())


def thinned(charts: Sequence[Chart], most: int = _MOST_SAMPLES) -> list[Chart]:
    """Return charts of at most `most` samples: as they are, or their longest curves in pieces; captions say so."""
    sizes = [curve.y.size for chart in charts for panel in chart.panels for curve in panel.curves]
    limit = max(sizes, default=0)
    while sum(min(size, limit) for size in sizes) > most:
        limit = int(0.9 * limit)
    return [_thinned(chart, limit) for chart in charts]


def _thinned(chart: Chart, limit: int) -> Chart:
    longest = max(curve.y.size for panel in chart.panels for curve in panel.curves)
    if longest <= limit:
        return chart
    panels = [replace(panel, curves=[_piecewise(curve, limit) for curve in panel.curves]) for panel in chart.panels]
    said = f"Of {longest} samples the least and the most of each {2 * longest / limit:.0f} are drawn."
    return replace(chart, panels=panels, caption=f"{chart.caption} {said}".strip())


def _piecewise(curve: Curve, limit: int) -> Curve:
    """Return the least and the most of each piece, in the order in which they came, at its first and middle x."""
    if curve.y.size <= limit or curve.style not in _CONTINUOUS:
        return curve
    edges = np.unique(np.linspace(0, curve.y.size, limit // 2 + 1).astype(int))
    start, stop = edges[:-1], edges[1:]
    x = np.column_stack([curve.x[start], curve.x[(start + stop) // 2]]).ravel()
    least, most = (np.where(np.isnan(curve.y), fill, curve.y) for fill in (np.inf, -np.inf))
    low, high = np.minimum.reduceat(least, start), np.maximum.reduceat(most, start)
    gap = ~np.isfinite(low)
    low[gap] = high[gap] = np.nan
    if curve.upper is not None:
        top = np.maximum.reduceat(np.where(np.isnan(curve.upper), -np.inf, curve.upper), start)
        top[~np.isfinite(top)] = np.nan
        return replace(curve, x=x, y=np.repeat(low, 2), upper=np.repeat(top, 2))
    falls = curve.y[stop - 1] < curve.y[start]
    pair = np.where(falls[:, None], np.column_stack([high, low]), np.column_stack([low, high]))
    return replace(curve, x=x, y=pair.ravel())
