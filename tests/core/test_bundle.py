"""The bundle: one text that runs with numpy alone, and that names decide by content."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from softneck.core import KINDS, SettingsError, resolve
from softneck.runtime import _bundle as bundle_module
from softneck.runtime import _compile, bundle, load_runtime
from softneck.runtime._bundle import content_name
from softneck.runtime._compile import _functions, _link_parts, _runtime, compiled_name, load_functions, load_linked

from ..data import slow_but

RUNTIMES = sorted({kind.runtime for kind in KINDS.values() if kind.runtime} | {"softneck.plant._neck_runtime"})


@pytest.fixture
def runtime_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the path, whose modules no cache remembers."""
    monkeypatch.syspath_prepend(tmp_path)
    _forget()
    return tmp_path


def _forget() -> None:
    for cache in (bundle, bundle_module._source, bundle_module._tree, bundle_module._pieces, _runtime, _link_parts):
        cache.cache_clear()


STEP = """
def state_size(arrays):
    return 1


def initialise(arrays, parameters, state, outputs):
    outputs[:] = 0.0


def step(arrays, parameters, state, inputs, outputs):
    outputs[0] = state[0]
    state[0] = inputs[0]
"""


@pytest.mark.parametrize(
    "imported", ["import os", "from scipy import signal", "from . import x", "import softneck.core"]
)
def test_a_foreign_import_is_refused(runtime_folder: Path, imported: str) -> None:
    (runtime_folder / "foreign_a_runtime.py").write_text(f"{imported}\n{STEP}")
    with pytest.raises(SettingsError, match=r"foreign_a_runtime imports .*only numpy and math are allowed"):
        bundle("foreign_a_runtime")


def test_runtimes_of_ones_own_share_text(runtime_folder: Path) -> None:
    (runtime_folder / "shared_a_runtime.py").write_text("def twice(value):\n    return 2.0 * value\n")
    text = f"from shared_a_runtime import twice\n{STEP}    outputs[0] += twice(inputs[0])\n"
    (runtime_folder / "sharing_a_runtime.py").write_text(text)
    assert "def twice" in bundle("sharing_a_runtime")


def test_two_definitions_of_one_name_are_refused(runtime_folder: Path) -> None:
    text = "from softneck.runtime._random_runtime import random_normal\n\n\ndef random_seed(s):\n    return 0\n" + STEP
    (runtime_folder / "twice_a_runtime.py").write_text(text)
    with pytest.raises(SettingsError, match=r"_random_runtime and twice_a_runtime both define `random_seed`"):
        bundle("twice_a_runtime")


def test_a_module_that_is_not_there_is_refused() -> None:
    with pytest.raises(SettingsError, match="there is no runtime module `softneck_absent_runtime`"):
        bundle("softneck_absent_runtime")


@pytest.mark.parametrize("runtime", slow_but(RUNTIMES, RUNTIMES[::4]))
def test_a_bundle_runs_with_numpy_alone(runtime: str, tmp_path: Path) -> None:
    (tmp_path / "carried.py").write_text(bundle(runtime), encoding="utf-8")
    code = (
        "import sys, carried\n"
        "names = ('state_size', 'initialise', 'step', 'run_steps', 'run_horizon')\n"
        "assert all(callable(getattr(carried, name)) for name in names)\n"
        "foreign = [m for m in sys.modules if m.split('.')[0] in ('softneck', 'numba', 'scipy', 'pandas')]\n"
        "assert not foreign, foreign"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_bundle_says_the_same_each_time_and_names_follow_content() -> None:
    texts = [bundle(runtime) for runtime in RUNTIMES]
    bundle.cache_clear()
    assert [bundle(runtime) for runtime in RUNTIMES] == texts
    names = [content_name(text) for text in texts]
    assert len(set(names)) == len(set(texts))
    assert all(name.isidentifier() for name in names)
    assert content_name(texts[0] + "\n") != names[0]


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_the_table_of_kinds_leads_somewhere(kind: str) -> None:
    entry = KINDS[kind]
    assert entry.name == kind
    assert hasattr(resolve(entry.result), "from_archive")
    assert hasattr(resolve(entry.settings), {"model": "fit"}.get(entry.role, "design")) or entry.role != "model"
    # What is not stepped in a loop has no runtime.
    assert not entry.runtime or load_runtime(entry.runtime, compiled=False).compiled is False


def test_a_compiled_bundle_is_kept_in_a_folder_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    (runtime_folder / "kept_a_runtime.py").write_text(STEP)
    runtime = load_runtime("kept_a_runtime", compiled=False)
    assert [path.suffix for path in (tmp_path / "cache" / "runtime").glob("*/*.py")] == [".py"]
    y = np.zeros((3, 1))
    runtime.run_steps((), np.zeros(0), np.zeros(1), np.array([[1.0], [2.0], [3.0]]), y)
    assert y.ravel().tolist() == [0.0, 1.0, 2.0]


SHIFTING = """
def shift(state, newest):
    state[1:] = state[: state.shape[0] - 1].copy()
    state[0] = newest


def state_size(arrays):
    return 3


def initialise(arrays, parameters, state, outputs):
    outputs[:] = 0.0


def step(arrays, parameters, state, inputs, outputs):
    outputs[0] = state[2]
    shift(state, inputs[0])
"""


def test_only_what_runs_is_compiled_and_it_runs_from_the_cache_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    """No strings of numba's, by which it would say sizes that were checked before, and no way to inner functions."""
    event = pytest.importorskip("numba.core.event")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    (runtime_folder / "shifting_a_runtime.py").write_text(SHIFTING)
    u, found = np.arange(1.0, 6.0)[:, None], []
    for _ in range(2):
        _forget()
        with event.install_recorder("numba:compile") as recorder:
            runtime = load_runtime("shifting_a_runtime")
            y = np.zeros((5, 1))
            runtime.run_steps((), np.zeros(0), np.zeros(3), u, y)
        assert y.ravel().tolist() == [0.0, 0.0, 0.0, 1.0, 2.0]
        found.append({one.data["dispatcher"].py_func.__module__ for _, one in recorder.buffer})
    assert found[0]
    assert not any(module.startswith("numba.cpython.unicode") for module in found[0])
    assert found[1] == set(), "nothing is compiled twice"


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_an_entry_of_the_cache_that_does_not_load_is_compiled_anew(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    event = pytest.importorskip("numba.core.event")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    (runtime_folder / "damaged_a_runtime.py").write_text(STEP.replace("0.0", "0.5"))
    compiled = []
    # Compiled, from a damaged cache, from the one that was written anew.
    for _ in range(3):
        _forget()
        with event.install_recorder("numba:compile") as recorder:
            outputs = np.zeros(1)
            load_runtime("damaged_a_runtime").step((), np.zeros(0), np.zeros(1), np.ones(1), outputs)
        compiled.append(bool(recorder.buffer))
        for path in (tmp_path / "cache").rglob(f"*.{suffix}") if len(compiled) == 1 else ():
            path.write_bytes(b"csoftneck_absent\nthing\n.")  # pickle's line for a name of a module
    assert compiled == [True, True, False]


WORDY = '"""A module."""\n' + STEP.replace(
    "    return 1\n", '    """Return the length."""\n\n    # One delay.\n    return 1  # sample\n'
)  # fmt: skip


def test_words_do_not_count_in_a_bundle_and_all_else_does(runtime_folder: Path) -> None:
    texts = {"plain": STEP, "wordy": WORDY, "other": STEP.replace("0.0", "1.0")}
    for name, text in texts.items():
        (runtime_folder / f"{name}_words_runtime.py").write_text(text)
    plain, wordy, other = (bundle(f"{name}_words_runtime") for name in texts)
    assert plain == wordy != other
    assert len({compiled_name(plain), compiled_name(wordy), compiled_name(other)}) == 2


def test_what_a_kind_does_not_call_is_not_in_its_bundle(runtime_folder: Path) -> None:
    # So that a line of it that changes compiles this kind no second time.
    text = "from softneck.runtime._random_runtime import random_uniform\n" + STEP
    (runtime_folder / "calls_part_runtime.py").write_text(text.replace("= inputs[0]", "= random_uniform(inputs)"))
    made = bundle("calls_part_runtime")
    assert "def random_uniform" in made
    assert "_M1 = " in made
    assert "random_normal" not in made
    assert "random_seed" not in made


def test_a_changed_comment_keeps_the_compiled_code_and_a_broken_file_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    for name, text in (("wordy_a_runtime", STEP), ("wordy_b_runtime", WORDY)):
        (runtime_folder / f"{name}.py").write_text(text)
    load_runtime("wordy_a_runtime", compiled=False)
    (kept,) = (tmp_path / "cache" / "runtime").glob("*/*.py")
    # numba asks for the file's time and size: a file that nobody touches is not compiled again.
    before = (kept.stat().st_mtime_ns, kept.read_text())
    load_runtime("wordy_b_runtime", compiled=False)
    assert list(kept.parent.glob("*.py")) == [kept]
    assert (kept.stat().st_mtime_ns, kept.read_text()) == before
    kept.write_text(before[1][:-9] + "(")
    _runtime.cache_clear()
    load_runtime("wordy_a_runtime", compiled=False)
    assert kept.read_text() == before[1]


def test_linked_steps_follow_what_they_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    names = []
    for text in (STEP, WORDY, STEP.replace("= inputs[0]", "= 2.0 * inputs[0]")):
        (runtime_folder / "linked_a_runtime.py").write_text(text)
        _forget()
        names.append(load_linked("softneck.loop._rows_runtime", "run_rows", ["linked_a_runtime"]).__module__)
    # Comments change nothing; another step is another module, although its name is the same.
    assert names[0] == names[1] != names[2]


DEEP = """
import numpy as np


def deep(x):
    if x[0] < 0.0:
        raise ValueError("negative", x[0])
    return np.sqrt(x).sum()


def factorial(n):
    return 1 if n <= 1 else n * factorial(n - 1)


def outer(x, n):
    return deep(x) + deep(2.0 * x) + factorial(n)
"""


def test_inner_functions_are_linked_into_the_called_one_alone_and_raise_through_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    pytest.importorskip("numba")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    (runtime_folder / "deep_a_runtime.py").write_text(DEEP)
    x, plain = np.arange(3.0), load_functions("deep_a_runtime", compiled=False)
    for hits in (0, 1):  # compiled, and from the cache
        _functions.cache_clear()
        found = load_functions("deep_a_runtime")
        assert found.outer(x, 5) == plain.outer(x, 5)
        with pytest.raises(ValueError, match="negative") as raised:
            found.outer(-1.0 - x, 5)
        # Numbers in an exception need the environment of the function that raises it.
        assert raised.value.args == ("negative", -1.0)
        assert sum(found.outer.stats.cache_hits.values()) == hits
    # Machine code is made, and kept, of what Python called.
    assert [path.name.split("-")[0].split(".")[-1] for path in (tmp_path / "cache").rglob("*.nbi")] == ["outer"]
    assert found.deep(x) == plain.deep(x)


@pytest.mark.skipif(sys.platform == "win32", reason="each process compiles for itself there")
def test_a_function_that_another_process_compiles_is_waited_for_but_not_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    pytest.importorskip("numba")
    import fcntl

    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: str(tmp_path / "cache"))
    (runtime_folder / "held_a_runtime.py").write_text("def outer(x):\n    return inner(x) + 1.0\n\n\n"
                                                     "def inner(x):\n    return 2.0 * x\n")  # fmt: skip
    assert load_functions("held_a_runtime").outer(3.0) == 7.0
    (lock,) = (tmp_path / "cache").rglob("*.lock")
    _functions.cache_clear()
    with ThreadPoolExecutor(1) as pool:
        with lock.open("a") as held:  # of an open file, so another of this process waits as another process would
            fcntl.flock(held, fcntl.LOCK_EX)
            found = load_functions("held_a_runtime")
            waits = pool.submit(found.outer, 4.0)
            with pytest.raises(TimeoutError):
                waits.result(0.2)
        assert waits.result() == 9.0
    # What the other has compiled meanwhile is loaded.
    assert sum(found.outer.stats.cache_hits.values()) == 1
    monkeypatch.setattr(_compile, "_LONGEST_COMPILATION_S", 0.1)
    _functions.cache_clear()
    with lock.open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        assert load_functions("held_a_runtime").outer(5.0) == 11.0


def test_a_cache_folder_that_cannot_be_written_is_no_hindrance(
    monkeypatch: pytest.MonkeyPatch, runtime_folder: Path
) -> None:
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_a, **_k: "/proc/nowhere")
    (runtime_folder / "other_a_runtime.py").write_text(STEP)
    assert load_runtime("other_a_runtime", compiled=False).state_size(()) == 1


def test_threads_that_load_one_runtime_at_once_get_one(runtime_folder: Path) -> None:
    for k in range(8):
        (runtime_folder / f"shared_{k}_runtime.py").write_text(STEP)
        together = Barrier(8)

        def load(_: int, module: str = f"shared_{k}_runtime", together: Barrier = together) -> int:
            together.wait()
            return id(load_runtime(module, compiled=False))

        with ThreadPoolExecutor(8) as pool:
            assert len(set(pool.map(load, range(8)))) == 1
