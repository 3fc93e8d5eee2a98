"""The file of an `OnlineCones`: what it remembers, its slope, its counters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import FileFormatError, read_archive, write_archive

_KIND = "online_cones"
_SETTINGS = ("epsilon", "gamma", "capacity", "scale", "rule")
_COUNTERS = ("total", "lowered", "single")


def write_online(path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], *, force: bool) -> None:
    """Write settings and counters (one mapping) and arrays."""
    write_archive(path, {"kind": _KIND, **header}, arrays, force=force)


def read_online(path: str | Path) -> tuple[dict[str, Any], dict[str, Any], dict[str, np.ndarray]]:
    """Return settings, counters and arrays that `write_online` wrote.

    Raises:
        FileFormatError: no such file, another kind, or what does not fit.
    """
    header, arrays = read_archive(path)
    if header.get("kind") != _KIND:
        raise FileFormatError(f"{path}: is a file of kind {header.get('kind')}; expected {_KIND}.")
    missing = [name for name in (*_SETTINGS, *_COUNTERS) if name not in header]
    wrong = [name for name in ("points", "values", "ages", "gamma") if not _floats(arrays.get(name))]
    if missing or wrong:
        raise FileFormatError(f"{path}: {', '.join(missing + wrong)} missing or damaged.")
    P, Y, ages, gamma = (arrays[name] for name in ("points", "values", "ages", "gamma"))
    total, lowered = header["total"], header["lowered"]
    whole = isinstance(total, int) and isinstance(lowered, int) and 0 <= lowered <= total
    if not whole or P.ndim != 2 or Y.ndim != 2 or not P.shape[1] == Y.shape[1] == ages.size or len(Y) != gamma.size:
        raise FileFormatError(f"{path}: its arrays or counters do not fit each other.")
    # Ages are the rows behind each other up to the newest: what may be forgotten is told by them.
    if not np.array_equal(ages, np.arange(total - ages.size, total)):
        raise FileFormatError(f"{path}: its ages are not the last {ages.size} of {total}.")
    settings = {name: plain_numbers(header[name]) for name in _SETTINGS}
    return settings, {name: header[name] for name in _COUNTERS}, arrays


def plain_numbers(given: Any) -> Any:
    """Return sequences and arrays as tuples of floats and anything else as it is: what JSON keeps."""
    if isinstance(given, list | tuple | np.ndarray):
        return tuple(float(number) for number in given)
    return float(given) if isinstance(given, float | np.floating) else given


def _floats(array: np.ndarray | None) -> bool:
    return array is not None and array.dtype == np.float64 and bool(np.isfinite(array).all())
