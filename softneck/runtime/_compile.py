"""Runtime bundles as callable functions: compiled by numba if it is installed, else plain Python."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType, SimpleNamespace
from typing import IO, Any

import platformdirs

from softneck.core import write_text

from ._bundle import bundle, content_name
from ._numba_cache import compile_without_failing_cache, numba_cache_name
from ._numba_inner import pipelines
from ._own import PREFIX
from ._tangent import with_tangent

# No fast-math: compiled and plain Python must agree to rounding. No GIL: batches run on all cores.
COMPILE_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy"}
# For functions that only compiled ones call: their wrappers for Python take as long to compile as they do.
_INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
# One thread at a time loads: `cache` alone would let two start, and CPython 3.11's `ast` fails in two threads at once.
_LOADING = threading.RLock()
# [s] After this a process waits for no other: one that was stopped would stop all.
_LONGEST_COMPILATION_S = 60


@dataclass(frozen=True, slots=True)
class Runtime:
    """The functions of one kind; see `_loops_runtime` for the loops.

    Attributes:
        state_size: (arrays) -> length of the state vector.
        initialise: (arrays, parameters, state, outputs) fills the state and the outputs at t_0.
        step: (arrays, parameters, state, inputs, outputs) advances by one sample, in place.
        run_steps: the same over rows of inputs.
        run_horizon: predictions a number of steps ahead from every row.
        linked_size: `state_size` for compiled functions; it is plain Python, which takes less time than to compile it.
        compiled: whether numba compiled them.
    """

    state_size: Callable[..., int]
    initialise: Callable[..., None]
    step: Callable[..., None]
    run_steps: Callable[..., None]
    run_horizon: Callable[..., None]
    linked_size: Callable[..., int]
    compiled: bool


def load_runtime(module: str, *, compiled: bool = True) -> Runtime:
    """Return the functions of runtime module `module`; `compiled=False` gives plain Python.

    The bundle is written to the user's cache folder so that numba keeps the compiled code between runs.
    """
    with _LOADING:
        return _runtime(module, compiled and PREFIX not in module)  # Python objects step in plain Python


def load_functions(module: str, *, compiled: bool = True) -> Any:
    """Return a namespace with the functions of runtime module `module`, which has no `step` of its own."""
    with _LOADING:
        return _functions(module, compiled and PREFIX not in module)


def load_tangent(module: str, *, compiled: bool = True) -> Callable[..., None]:
    """Return `step_tangent` of runtime module `module`; see `_tangent`.

    Raises TangentError: its step has no derivative.
    """
    with _LOADING:
        return _tangent(module, compiled)


@cache
def _runtime(module: str, compiled: bool) -> Runtime:
    # Members that are compiled already are linked: six models in one text would take minutes to compile.
    linked = compiled and have_numba() and "(" in module
    namespace = _import_text(bundle(module, linked=linked), compiled=compiled)
    names = ("initialise", "step", "run_steps", "run_horizon", "state_size")
    size = _in_python(namespace.state_size)
    done = compiled and _compile(namespace, names)
    return Runtime(size, *(getattr(namespace, name) for name in names), compiled=done)


def _in_python(function: FunctionType) -> FunctionType:
    """Return a copy of a function that still calls plain Python when those of its module are compiled."""
    names = dict(function.__globals__)
    plain = {name: value for name, value in names.items() if isinstance(value, FunctionType)}
    names |= {name: FunctionType(value.__code__, names, name, value.__defaults__) for name, value in plain.items()}
    return names[function.__name__]


@cache
def _functions(module: str, compiled: bool) -> Any:
    namespace = _import_text(bundle(module, loops=False), compiled=compiled)
    functions = {name: value for name, value in vars(namespace).items() if isinstance(value, FunctionType)}
    if not (compiled and _compile(namespace, ())):
        return namespace
    # Which of them Python calls is not known: each once for Python, calling the inner ones, compiled when it is called.
    return SimpleNamespace(
        **vars(namespace) | {name: _compiled(value, {}, inner=False) for name, value in functions.items()}
    )


@cache
def _tangent(module: str, compiled: bool) -> Callable[..., None]:
    namespace = _import_text(with_tangent(bundle(module, loops=False)), compiled=compiled)
    if compiled:
        _compile(namespace, ("step_tangent",))
    return namespace.step_tangent


def load_linked(module: str, called: str, runtimes: Sequence[str]) -> Callable[..., Any]:
    """Return function `called` of runtime module `module`, whose `part_step(part, ...)` calls that of `runtimes[part]`.

    The steps are those that `load_runtime` compiled: they are linked, not compiled again, and give equal results to the
    bit. Their data is `parts` = (arrays, parameters, states), each with one entry for each part.
    """
    with _LOADING:
        return _link_parts(module, called, tuple(runtimes))


@cache
def _link_parts(module: str, called: str, runtimes: tuple[str, ...]) -> Callable[..., Any]:
    lines = ["from softneck.runtime import load_runtime"]
    for i, runtime in enumerate(runtimes):
        # The hash of the runtime is part of this text, as a statement: another runtime makes another module and cache.
        lines += [f'linked_{i} = load_runtime("{runtime}").step', f'content_{i} = "{compiled_name(bundle(runtime))}"']
    lines += ["del load_runtime", "", "", "def part_step(part, time, parts, inputs, outputs):"]
    for i in range(len(runtimes)):
        # Constant indices: the compiler then knows the type of each part's arrays.
        step = f"linked_{i}(parts[0][{i}], parts[1][{i}], parts[2][{i}], inputs, outputs)"
        lines += [f"    if part == {i}:", f"        {step}"]
    lines.append("    return False")  # no part has this index
    # Counting references to the arrays of all parts at each call took longer than a light step; rows allocate nothing.
    return _linked(module, called, "part_step", lines, {"_nrt": False})


@cache
def load_around_step(module: str, called: str, runtime: str) -> Callable[..., Any]:
    """Return function `called` of runtime module `module`, with the `step` of `runtime` linked as in `load_linked`."""
    with _LOADING:
        lines = ["from softneck.runtime import load_runtime", f'step = load_runtime("{runtime}").step']
        lines += [f'content = "{compiled_name(bundle(runtime))}"', "del load_runtime"]
        return _linked(module, called, "step", lines)


def _linked(
    module: str, called: str, name: str, lines: Sequence[str], more: Mapping[str, Any] | None = None
) -> Callable[..., Any]:
    """Return function `called` of `module`, in which `lines` define `name`; `more`: as for `_compile`."""
    text = bundle(module, loops=False, skip=(name,)) + "\n".join(lines) + "\n"
    namespace = _import_text(text, compiled=True)
    _compile(namespace, (called,), more)
    return getattr(namespace, called)


def compiled_name(text: str) -> str:
    """Return the module name under which the bundle `text` and its compiled code are cached, also for FMUs.

    A bundle has no comments and no docstrings: changing only these does not compile it again.
    """
    # numba's cache ignores the compile options, so they are part of the name.
    return content_name(f"{text}\n# {COMPILE_OPTIONS}")


def have_numba() -> bool:
    """Return whether numba is installed, without importing it."""
    return importlib.util.find_spec("numba") is not None


def _compile(namespace: ModuleType, called: Sequence[str], more: Mapping[str, Any] | None = None) -> bool:
    """Compile the functions of a bundle, of which Python calls `called`; return whether numba is installed.

    `more`: numba's options beside the usual ones.
    """
    if not have_numba():
        return False
    _shorten_shape_errors()
    if "COMPILED" in vars(namespace):
        vars(namespace)["COMPILED"] = 1  # see `_compiled_runtime`; numba takes it as a constant
    for name, value in list(vars(namespace).items()):
        if isinstance(value, FunctionType):
            setattr(namespace, name, _compiled(value, more or {}, inner=name not in called))
    return True


def _compiled(function: FunctionType, more: Mapping[str, Any], *, inner: bool) -> Any:
    """Return numba's function, which it compiles when it is called; an inner one is for other compiled functions."""
    from numba import njit

    made = pipelines()
    # Stated, or a step that is compiled for rows without references would have none either, and cannot allocate.
    options: Any = {**COMPILE_OPTIONS, "_nrt": True, **more} | ({} if made is None else {"pipeline_class": made[inner]})
    if inner:
        options = options | _INNER | ({} if made is None else {"cache": False})
    dispatcher = compile_without_failing_cache(njit(**options)(function))
    return dispatcher if inner else _compile_in_one_process(dispatcher)


def _compile_in_one_process(dispatcher: Any) -> Any:
    """Have one process at a time compile a function, so that others that need it load it then; return it.

    Linux and macOS only; elsewhere, in a folder without locks, or where another process holds the lock for too long,
    each process compiles for itself.
    """
    from numba.core.compiler_lock import global_compiler_lock

    function = dispatcher.py_func
    compile_here, path = dispatcher.compile, cache_folder() / f"{function.__module__}.{function.__name__}.lock"

    def compile_alone(signature: Any) -> Any:
        # In this order, as a function that is called is compiled within numba's lock.
        with global_compiler_lock, contextlib.ExitStack() as stack:
            with contextlib.suppress(OSError):
                _wait_for(stack.enter_context(path.open("a")))
            return compile_here(signature)

    dispatcher.compile = compile_alone
    return dispatcher


def _wait_for(file: IO[str]) -> None:
    """Lock a file until it is closed, or go on without."""
    if sys.platform == "win32":
        return
    import fcntl

    end = time.monotonic() + _LONGEST_COMPILATION_S
    while time.monotonic() < end:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(0.05)


@cache
def _shorten_shape_errors() -> None:
    """Leave the sizes out of numba's message on an assignment to a slice of another size.

    To format the sizes, numba compiles its string functions into every function with such an assignment, though our
    arrays are checked before they run: a quarter of the time to compile a kind, and of the loaded code.
    """
    from numba.extending import overload
    from numba.np import arrayobj

    if not hasattr(arrayobj, "raise_with_shape_context"):
        return  # another numba, which does it in its own way

    def sizes_differ(source: Any, target: Any) -> None: ...

    @overload(sizes_differ)
    def sizes_differ_compiled(source: Any, target: Any) -> Callable[..., None]:  # noqa: ARG001
        def raises(source: Any, target: Any) -> None:  # noqa: ARG001
            raise ValueError("cannot assign slice from input of different size")

        return raises

    arrayobj.raise_with_shape_context = sizes_differ


def _import_text(text: str, *, compiled: bool) -> ModuleType:
    name = compiled_name(text)
    path = cache_folder() / f"{name}.py"
    # numba compiles again when a file is written again.
    if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != text:
        write_text(path, text, force=True)
    alias = f"{name}_compiled" if compiled else name
    spec = importlib.util.spec_from_file_location(alias, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"cannot import the runtime bundle {path}")
    namespace = importlib.util.module_from_spec(spec)
    sys.modules[alias] = namespace  # numba rebuilds cached functions by their module's name
    spec.loader.exec_module(namespace)
    return namespace


def cache_folder() -> Path:
    """Return the folder of runtimes and their compiled code."""
    folder = Path(platformdirs.user_cache_dir("softneck", appauthor=False)) / "runtime" / numba_cache_name("softneck")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        return _temporary_folder()


@cache
def _temporary_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="softneck-runtime-"))
