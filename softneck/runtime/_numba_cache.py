"""Where numba keeps compiled runtimes, and what happens to an entry that does not load. It is in every FMU too.

Standard library alone: an FMU has nothing of softneck on its host.
"""

import contextlib
import sys
from importlib import metadata
from typing import Any


def numba_cache_name(package: str) -> str:
    """Return the name of the folder for what `package` ("softneck" or "fmu") compiles in this environment.

    numba names entries by Python's version and by types, and the runtime's text is in the name of its file. What an
    entry was compiled by is in neither: it may need softneck's own modules to load, or another numba or NumPy.
    """
    versions = [f"py{sys.version_info[0]}.{sys.version_info[1]}"]
    for name in ("numba", "numpy"):
        try:
            versions.append(f"{name}{metadata.version(name)}")
        except metadata.PackageNotFoundError:
            versions.append(f"{name}0")
    return "-".join((package, *versions))


def compile_without_failing_cache(dispatcher: Any) -> Any:
    """Let numba's `dispatcher` compile anew what its cache cannot load, and go on where it cannot save; return it."""
    cache: Any = getattr(dispatcher, "_cache", None)
    if not hasattr(cache, "flush"):
        return dispatcher  # another numba, or one that keeps nothing
    load, save = cache.load_overload, cache.save_overload

    def load_or_none(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # damaged, half written, or of a package that is not here: unpickling raises anything
            with contextlib.suppress(Exception):
                cache.flush()  # to save the new entry, numba reads the index
            return None

    def save_if_possible(*args: Any) -> None:
        with contextlib.suppress(Exception):  # a full disk, a folder that may be read alone
            save(*args)

    cache.load_overload, cache.save_overload = load_or_none, save_if_possible
    return dispatcher
