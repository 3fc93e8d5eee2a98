"""Results kept by the content of what they were computed from, wherever those objects come from."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import PurePath
from typing import Any, TypeVar

import numpy as np

_T = TypeVar("_T")


def compute_once(compute: Callable[[], _T], *things: Any) -> _T:
    """Return the result of `compute`, or that of an earlier call in this process with the same `compute` and content.

    `things` must be all that the result depends on; nobody may change the result. See `content_digest`.
    """
    digest = content_digest(compute.__qualname__, *things)
    if digest is None:
        return compute()
    with _LOOKING:  # `lru_cache` may else make two lists
        lock, kept = _results(digest)
    with lock:  # another thread may be computing it
        if not kept:
            kept.append(compute())
    return kept[0]


# A search and the certificates of its best need a dozen results, a comparison of kinds ten drives.
@lru_cache(maxsize=32)
def _results(digest: str) -> tuple[threading.RLock, list[Any]]:
    del digest
    return threading.RLock(), []


_LOOKING = threading.Lock()


def content_digest(*things: Any) -> str | None:
    """Return the SHA-256 of numbers, texts, arrays, and of tables, lists and dataclasses of them.

    A whole number counts as the float of the same value, a tuple as a list, a field with the metadata `content` False
    not at all. None if a part has no content that can be compared, such as a function.
    """
    found = hashlib.sha256()
    try:
        for part in _parts(things):
            found.update(b"%d:%b" % (len(part), part))
    except TypeError:
        return None
    return found.hexdigest()


def _parts(thing: Any) -> Iterator[bytes]:
    match thing:
        case np.ndarray() if not thing.dtype.hasobject:
            yield repr((thing.dtype.str, thing.shape)).encode()
            yield thing.tobytes()
        case np.generic():
            yield from _parts(thing.item())
        case int() if not isinstance(thing, bool) and float(thing) == thing:
            yield repr(float(thing)).encode()
        case None | bool() | int() | float() | str() | bytes() | PurePath():
            yield repr(thing).encode()
        case Mapping():
            yield b"table %d" % len(thing)
            for key, value in thing.items():
                yield from _parts(key)
                yield from _parts(value)
        case list() | tuple():
            yield b"list %d" % len(thing)
            for item in thing:
                yield from _parts(item)
        case _ if is_dataclass(thing) and not isinstance(thing, type):
            yield type(thing).__qualname__.encode()
            for item in fields(thing):
                if item.metadata.get("content", True):
                    yield from _parts(getattr(thing, item.name))
        case _:
            raise TypeError(type(thing).__name__)
