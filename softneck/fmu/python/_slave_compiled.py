"""The part of every FMU that compiles its `step` with numba if the host has it (docs, how-to, FMUs).

FMUs have a cache folder and module names of their own. Code that softneck compiled may need its modules, and functions
of one name that were compiled in two ways are not to meet in one process: one may call the other, with other arguments.
Standard library, numpy and numba only.
"""

import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softneck.runtime import compile_without_failing_cache, numba_cache_name

# Environment variable of the host: "0" never, "1" always, else by the cost in the FMU.
_FMU_SWITCH = "SOFTNECK_FMU_NUMBA"
# The line before and after the runtime in the module's text.
_FMU_BORDER = "# --- runtime ---\n"


def _fmu_compiled_step(
    facts: dict[str, Any], folder: str, arguments: tuple[Any, ...], *, always: bool = False
) -> Callable[..., None] | None:
    """Return the compiled `step` of the FMU unpacked in `folder`, or None to run plain Python.

    numba compiles at the first call, which is made here, with `arguments`. A light runtime does not justify numba's
    start of half a second. A middling one does if it is compiled already. A heavy one is compiled here, once for all
    FMUs of its kind on this machine.
    """
    switch = os.environ.get(_FMU_SWITCH, "")
    wanted = always or switch == "1"
    if switch == "0" or facts["cost"] == "own" or not (wanted or facts["cost"] != "light") or not _fmu_have("numba"):
        return None
    alias = facts["runtime"] + "_fmu"
    here = sys.modules.get(alias)
    try:
        if hasattr(getattr(here, "step", None), "py_func"):
            found: Any = here.step  # type: ignore[union-attr]
        else:
            cache = _fmu_cache_folder()
            ready = any((cache / "__pycache__").glob(f"{facts['runtime']}.step-*.nbi"))
            if not (ready or wanted or facts["cost"] == "heavy"):
                return None
            if not ready:
                _fmu_print(
                    f"{facts['name']}: compiling its runtime, once on this machine; {_FMU_SWITCH}=0 disables this."
                )
            found = _fmu_compile(alias, _fmu_cached_text(facts, folder, cache), facts["options"])
        found(*arguments)
    except Exception as error:  # any problem with numba or the disk: plain Python still runs
        _fmu_print(f"{facts['name']}: runs without numba, which failed: {error}")
        return None
    return found


def _fmu_print(text: str) -> None:
    if sys.stderr is not None:
        print(text, file=sys.stderr, flush=True)


def _fmu_have(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def _fmu_cache_folder() -> Path:
    """Return the folder of FMUs' compiled runtimes (in softneck's folder of the user's cache, as in platformdirs)."""
    if sys.platform == "win32":
        cache = Path(os.environ.get("LOCALAPPDATA") or Path.home(), "softneck", "Cache")
    elif sys.platform == "darwin":
        cache = Path.home() / "Library" / "Caches" / "softneck"
    else:
        cache = Path(os.environ.get("XDG_CACHE_HOME", "").strip() or Path.home() / ".cache", "softneck")
    return cache / "runtime" / numba_cache_name("fmu")


def _fmu_cached_text(facts: dict[str, Any], folder: str, cache: Path) -> Path:
    """Write the runtime's text into `cache` unless it is there, and return its path."""
    text = Path(folder, facts["module"] + ".py").read_text(encoding="utf-8").split(_FMU_BORDER)[1]
    path = cache / (facts["runtime"] + ".py")
    if path.is_file() and path.read_text(encoding="utf-8") == text:
        return path
    cache.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=cache, suffix=".tmp")
    os.close(handle)
    Path(temporary).write_text(text, encoding="utf-8")
    Path(temporary).replace(path)
    return path


def _fmu_compile(alias: str, path: Path, options: dict[str, Any]) -> Callable[..., None]:
    from numba import njit

    spec = importlib.util.spec_from_file_location(alias, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot import {path}")
    namespace = importlib.util.module_from_spec(spec)
    sys.modules[alias] = namespace  # numba rebuilds cached functions by their module's name
    spec.loader.exec_module(namespace)
    names = vars(namespace)
    if "COMPILED" in names:
        names["COMPILED"] = 1
    for name, value in list(names.items()):
        if callable(value) and getattr(value, "__module__", None) == alias:
            names[name] = compile_without_failing_cache(njit(**options)(value))
    return names["step"]
