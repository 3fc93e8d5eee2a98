"""Settings of all tests, and what several of them share."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Generator, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

# Before numpy is imported: `pytest` alone, its workers and what tests start get the one BLAS thread of `make test`.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

from softneck.identification import (
    GreyBox,
    Model,
    Network,
    OutputError,
    Play,
    Rls,
    SetMembership,
)
from softneck.runtime import _compile
from softneck.signals import Recording

from .browser import chromium_path, started
from .data import ROOT, guarded_of, neck_recording, short_neck

if TYPE_CHECKING:
    from playwright.sync_api import Browser

# The same examples on every machine and run; a busy machine is no failure.
settings.register_profile(
    "softneck", derandomize=True, database=None, deadline=None, max_examples=40, print_blob=False,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)  # fmt: skip
settings.load_profile("softneck")


# What collecting leaves (11,000 tests, 700,000 objects) stays to the end, and garbage collections go through all of it:
# 7 s of the 26 of collecting, and half a second each time that a run on drives collects everything before it begins.
@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Collect the tests without the garbage collector, and keep it from them afterwards."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.enable()
        gc.collect()
        gc.freeze()


def pytest_sessionfinish() -> None:
    """Give all back: what Python does not collect at its end, libraries take for leaks of theirs."""
    gc.unfreeze()


@pytest.fixture(autouse=True, scope="session")
def signals_are_heard() -> None:
    """Under nohup tests ignore SIGHUP, in a shell's background SIGINT; so would the processes that they start."""
    for name in ("SIGHUP", "SIGINT"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


@pytest.fixture(scope="session")
def neck() -> Recording:
    """2,400 rows of the synthetic ARX neck with noise and motor positions."""
    return neck_recording()


class Models(Mapping[str, Model]):
    """Small models, each fitted when it is first asked for: a worker needs only some."""

    def __init__(self, fits: dict[str, Callable[[], Model]]) -> None:
        self._fits = {name: cache(fit) for name, fit in fits.items()}

    def __getitem__(self, name: str) -> Model:
        return self._fits[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._fits)

    def __len__(self) -> int:
        return len(self._fits)


@pytest.fixture(scope="session")
def models() -> Models:
    """One small model of each kind, all on the same 500 rows; "residual" is a form of `nlsm`."""
    recording = short_neck()
    settings = {
        "rls": Rls(max_delay=0.12),
        "mimo": Rls(structure="mimo", delay=0.06),
        "oe": OutputError(delay=0.06, source="positions"),
        "oe2": OutputError(nf=2, nb=2, delay=0.06),
        "nlsm": SetMembership(epsilon=0.01, output_weight=10.0),
        "residual": SetMembership(form="residual"),
        "play": Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4),
        "nn": Network(hidden=(4, 3), iterations=8),
        "greybox": GreyBox(evaluations=4, sensor_delay=2, body="all"),
    }
    fits: dict[str, Callable[[], Model]] = {name: lambda one=one: one.fit(recording) for name, one in settings.items()}
    fits["guarded"] = lambda: guarded_of([made[name] for name in ("rls", "play", "nn")], recording)
    made = Models(fits)
    return made


@pytest.fixture
def plain_steps_of_blocks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a fast test run plain Python: compiling takes seconds a kind, and only slow tests need its speed."""
    if request.node.get_closest_marker("slow"):
        return
    for name in ("_runtime", "_tangent"):
        made = getattr(_compile, name)
        monkeypatch.setattr(_compile, name, lambda module, _compiled, made=made: made(module, False))
    # Only a compiled step can be linked; the likelihood has one of its own for that.
    around = "softneck.estimation._noise.load_around_step"
    monkeypatch.setattr(around, lambda module, called, _runtime: getattr(_compile.load_functions(module), called))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The recordings made on hardware, which lie beside the project and are no part of it."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the real recordings (../shared/data) are absent on this machine")
    return folder


@pytest.fixture(scope="session")
def chromium() -> str:
    """The path of the system's Chromium."""
    return chromium_path()


@pytest.fixture(scope="session")
def browser(chromium: str) -> Iterator[Browser]:
    """A headless Chromium that shows pages."""
    with started(chromium) as running:
        yield running
