"""What a model file's arrays must be before compiled code indexes them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from softneck.core import FileFormatError, Matrix, Vector

from ._composed import COMPOSED, members, own_arrays
from ._greybox_numbers import NUMBERS
from ._slant import is_frame, slant_nodes

# In the runtimes' order (see each kind's `_runtime` module).
_ORDER = {
    "rls": ("history", "drive", "redefinition", "a", "b", "delay"),
    "oe": ("history", "drive", "redefinition", "a", "b", "delay", "source"),
    "srivc": ("history", "drive", "redefinition", "a", "b", "delay", "source"),
    "subspace": ("history", "drive", "A", "B", "K", "delay"),
    "nlsm": (
        "history", "drive", "table", "scale", "points", "values", "bounds", "nodes", "frame",
        "redefinition", "a", "b", "delay",
    ),
    "residual": ("history", "memory", "table", "scale", "points", "values", "bounds", "nodes", "frame"),
    "ensemble": ("history", "memory"),
    "greybox": ("history", "drive", "neck", "sensor", "echo", "memory"),
    "play": (
        "history", "drive", "load", "redefinition", "widths", "chain", "table", "weights", "range", "echo", "memory",
    ),
    "nss": (
        "history", "drive", "load", "redefinition", "widths", "delay", "A", "B", "E", "F", "G", "h", "D", "C", "c",
        "range", "echo", "memory",
    ),
    "nn": (
        "history", "drive", "table", "W1", "b1", "W2", "b2", "w3", "b3", "input_scale", "output_scale", "load",
        "correction",
    ),
}  # fmt: skip
# A minute at 1 ms: far beyond any lag of a neck, far below what memory holds.
_LONGEST_HISTORY = 60_000


def check_arrays(kind: str, arrays: Mapping[str, Matrix]) -> None:
    """Raise FileFormatError unless the arrays are finite, in order, and of shapes that fit each other."""
    if kind in COMPOSED:
        _check_composed(kind, arrays)
        return
    # `rls` over the motors and more than one pole are state spaces as well.
    form = "subspace" if kind in ("rls", "oe", "srivc") and "A" in arrays else kind
    if tuple(arrays) != _ORDER[form]:
        raise FileFormatError(
            f"a model of kind {kind} has the arrays {', '.join(_ORDER[form])}; got {', '.join(arrays)}."
        )
    _check_finite(arrays)
    history = _history(arrays)
    _expect(arrays, "drive", (3, 2))
    _within(arrays["drive"][:, 1], 0, history, "a drive's delay")
    _CHECKS[form](arrays, history)


def _check_finite(arrays: Mapping[str, Matrix]) -> None:
    for name, array in arrays.items():
        if array.dtype != np.float64 or not np.isfinite(array).all():
            raise FileFormatError(f"its array `{name}` is not of finite floats.")


def _history(arrays: Mapping[str, Matrix]) -> float:
    """Check history and memory, and return the history."""
    _expect(arrays, "history", (1,))
    history = float(arrays["history"][0])
    if history != int(history) or not 1 <= history <= _LONGEST_HISTORY:
        raise FileFormatError(f"its history of {history:g} samples is no number from 1 to {_LONGEST_HISTORY}.")
    if "memory" in arrays:
        _expect(arrays, "memory", (1,))
        _within(arrays["memory"], 1, _LONGEST_HISTORY, "its memory in samples")
    return history


def _check_composed(kind: str, arrays: Mapping[str, Matrix]) -> None:
    own, parts = own_arrays(arrays), members(arrays)
    if tuple(arrays)[: len(own)] != _ORDER[kind]:
        raise FileFormatError(f"a model of kind {kind} starts with the arrays {', '.join(_ORDER[kind])}.")
    if len(parts) < 1 or (kind == "residual" and len(parts) != 1):
        raise FileFormatError(f"a model of kind {kind} cannot have {len(parts)} members.")
    _check_finite(own)
    history = _history(own)
    if kind == "residual":
        n = _check_table(own["table"], history)
        _within(own["table"][:, 0], 2, 3, "a regressor's source")
        _check_set(own, n)
    for member, part in parts:
        check_arrays(member, part)


def no_base() -> dict[str, Matrix]:
    """Return the arrays of a set that stands alone."""
    empty = np.zeros((2, 0))
    return {"redefinition": np.zeros((3, 3)), "a": empty, "b": empty, "delay": np.zeros(2)}


def _check_rls(arrays: Mapping[str, Matrix], history: float) -> None:
    _check_linear(arrays, history)
    _within(np.array([arrays["a"].shape[-1]]), 1, history, "the order")


def _check_oe(arrays: Mapping[str, Matrix], history: float) -> None:
    _check_rls(arrays, history)
    _expect(arrays, "source", (1,))
    _within(arrays["source"], 0, 1, "the source")


def _check_state_space(arrays: Mapping[str, Matrix], history: float) -> None:
    n = arrays["A"].shape[-1]
    for name, shape in {"A": (n, n), "B": (n, 3), "K": (n, 2), "delay": (2,)}.items():
        _expect(arrays, name, shape)
    _within(np.array([n]), 2, 2 * history, "the order")
    _within(arrays["delay"][:1], 0, history - 1, "a dead time")
    _within(arrays["delay"][1:], 0, 1, "the source")


def _check_linear(arrays: Mapping[str, Matrix], history: float) -> None:
    na, nb = arrays["a"].shape[-1], arrays["b"].shape[-1]
    for name, shape in {"redefinition": (3, 3), "a": (2, na), "b": (2, nb), "delay": (2,)}.items():
        _expect(arrays, name, shape)
    _within(arrays["delay"], 0, history - nb, "a dead time")
    _within(np.array([na]), 0, history, "the order")


def _check_nlsm(arrays: Mapping[str, Matrix], history: float) -> None:
    _check_set(arrays, _check_table(arrays["table"], history))
    _check_linear(arrays, history)


def _check_set(arrays: Mapping[str, Matrix], n: int) -> None:
    rows = arrays["values"].shape[-1]
    for name, shape in {"scale": (n,), "points": (2, n, rows), "values": (2, rows), "bounds": (2, 2)}.items():
        _expect(arrays, name, shape)
    _within(np.array([rows]), 1, np.inf, "the number of points")
    frame, slopes = arrays["frame"], _slopes(arrays)
    if frame.ndim != 3 or frame.shape[::2] != (2, n) or not all(is_frame(rows) for rows in frame):
        raise FileFormatError("its array `frame` is of no directions square to each other; identify the model again.")
    parts = zip(frame, slopes, arrays["points"], arrays["values"], strict=True)
    nodes = np.array([slant_nodes(*axis) for axis in parts])
    # A tree of another shape would be read beyond its end, and one of other numbers would leave points out.
    if not np.array_equal(arrays["nodes"], nodes):
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")


def _slopes(arrays: Mapping[str, Matrix]) -> Vector:
    """Return the climb (2,) of the values' plane of each axis, less than the cones'."""
    nodes = arrays["nodes"]
    slopes = nodes[:, 0, 0] if nodes.ndim == 3 and nodes.shape[0] == 2 and nodes.size else np.full(2, -1.0)
    if not ((slopes >= 0.0) & ((slopes < arrays["bounds"][:, 0]) | (slopes == 0.0))).all():
        raise FileFormatError("its array `nodes` is not the tree over its points; identify the model again.")
    return slopes


def _check_nn(arrays: Mapping[str, Matrix], history: float) -> None:
    n = _check_table(arrays["table"], history)
    h1, h2 = arrays["b1"].shape[-1], arrays["b2"].shape[-1]
    shapes = {
        "W1": (2, h1, n), "b1": (2, h1), "W2": (2, h2, h1), "b2": (2, h2), "w3": (2, h2), "b3": (2,),
        "input_scale": (2, 2, n), "output_scale": (2, 2), "load": (4,),
        "correction": (2, 2),
    }  # fmt: skip
    for name, shape in shapes.items():
        _expect(arrays, name, shape)
    if (arrays["correction"] < 0).any() or (arrays["correction"] >= 1).any():
        raise FileFormatError("its correction's memory and gain are not from 0 to 1, so that it would not die out.")


def _check_play(arrays: Mapping[str, Matrix], history: float) -> None:
    widths, n, p = arrays["widths"].shape[0], len(arrays["table"]), arrays["echo"].shape[-1]
    shapes = {
        "load": (4,), "redefinition": (3, 3), "widths": (widths,), "chain": (2,), "table": (n, 3), "weights": (2, n),
        "range": (2, 2), "echo": (2, p),
    }  # fmt: skip
    for name, shape in shapes.items():
        _expect(arrays, name, shape)
    _within(arrays["chain"][1:], 1, 1000, "the order of the filters")
    signals = 3 * (1 + widths) * arrays["chain"][1]
    _within(arrays["table"], -1, signals - 1, "a term's signal")
    _within(np.array([p]), 1, history, "the length of the echo")


def _check_nss(arrays: Mapping[str, Matrix], history: float) -> None:
    widths, n, q, p = (arrays[name].shape[-1] for name in ("widths", "A", "h", "echo"))
    inputs = 3 * (1 + widths)
    shapes = {
        "load": (4,), "redefinition": (3, 3), "widths": (widths,), "delay": (1,), "A": (n, n), "B": (n, inputs),
        "E": (n, q), "F": (q, n), "G": (q, inputs), "h": (q,), "D": (q, q), "C": (2, n), "c": (2,), "range": (2, 2),
        "echo": (2, p),
    }  # fmt: skip
    for name, shape in shapes.items():
        _expect(arrays, name, shape)
    _within(arrays["delay"], 0, history - 1, "a dead time")
    _within(np.array([p]), 1, history, "the length of the echo")
    if np.abs(np.linalg.eigvals(arrays["A"])).max(initial=0.0) >= 1.0:
        raise FileFormatError("its linear part is not stable, so that a free run could diverge.")


def _check_greybox(arrays: Mapping[str, Matrix], history: float) -> None:
    p = arrays["echo"].shape[-1]
    for name, shape in {"neck": (len(NUMBERS),), "sensor": (2,), "echo": (2, p)}.items():
        _expect(arrays, name, shape)
    _within(np.array([p]), 1, history, "the length of the echo")
    _within(arrays["drive"][:, 1], 1, history, "a drive's delay")
    _within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    for number, value in zip(NUMBERS, arrays["neck"], strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")


def _check_table(table: Matrix, history: float) -> int:
    """Check rows (source, channel, lag) and return their number."""
    if table.ndim != 2 or table.shape[1] != 3 or not len(table):
        raise FileFormatError(f"its regressor table has shape {table.shape}; (n, 3) is needed.")
    _within(table[:, 0], 0, 3, "a regressor's source")
    _within(table[:, 1], 0, 2, "a regressor's channel")
    _within(table[table[:, 0] == 3, 1], 0, 1, "a regressor's output")
    _within(table[:, 2], 1, history, "a regressor's lag")
    return len(table)


def _expect(arrays: Mapping[str, Matrix], name: str, shape: tuple[int, ...]) -> None:
    if arrays[name].shape != shape:
        raise FileFormatError(f"its array `{name}` has shape {arrays[name].shape}; {shape} is needed.")


def _within(values: Matrix, low: float, high: float, what: str) -> None:
    if (values != np.round(values)).any() or not ((values >= low) & (values <= high)).all():
        raise FileFormatError(f"{what} is no whole number from {low:g} to {high:g}.")


_CHECKS = {
    "rls": _check_rls,
    "play": _check_play,
    "greybox": _check_greybox,
    "nss": _check_nss,
    "oe": _check_oe,
    "srivc": _check_oe,
    "subspace": _check_state_space,
    "nlsm": _check_nlsm,
    "nn": _check_nn,
}
