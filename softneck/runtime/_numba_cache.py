"""Folder of numba's cache of compiled runtimes, and recovery from entries that do not load; also part of every FMU.

Uses the standard library only: the host of an FMU need not have softneck.
"""

import contextlib
import sys
from importlib import metadata
from typing import Any

# Version of how runtimes are compiled: one more where code of before is not to be mixed with that of now. Before 2,
# functions called inner ones by a name that code of another entry may have; a process could crash.
_CACHE_VERSION = 2


def numba_cache_name(package: str) -> str:
    """Return the folder name for code that `package` ("softneck" or "fmu") compiles in this environment.

    numba's entries are keyed by Python's version and by types, and the name of the source file contains its hash.
    Neither contains the compiling environment: an entry may need softneck's own modules to load, another numba or
    NumPy, or code that another version of softneck compiled in another way.
    """
    versions = [f"v{_CACHE_VERSION}", f"py{sys.version_info[0]}.{sys.version_info[1]}"]
    for name in ("numba", "numpy"):
        try:
            versions.append(f"{name}{metadata.version(name)}")
        except metadata.PackageNotFoundError:
            versions.append(f"{name}0")
    return "-".join((package, *versions))


def compile_without_failing_cache(dispatcher: Any) -> Any:
    """Make numba's `dispatcher` compile again if its cache fails to load, and ignore failures to save; return it."""
    cache: Any = getattr(dispatcher, "_cache", None)
    if not hasattr(cache, "flush"):
        return dispatcher  # another numba, or one without a cache
    load, save = cache.load_overload, cache.save_overload

    def load_or_none(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # damaged, half written, or of a package that is not here: unpickling raises anything
            with contextlib.suppress(Exception):
                cache.flush()  # to save the new entry, numba reads the index
            return None

    def save_if_possible(*args: Any) -> None:
        with contextlib.suppress(Exception):  # a full disk, or a read-only folder
            save(*args)

    cache.load_overload, cache.save_overload = load_or_none, save_if_possible
    return dispatcher
