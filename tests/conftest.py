"""Settings of all tests, and what several of them share."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
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


@pytest.fixture(scope="session")
def models() -> dict[str, Model]:
    """One small model of each kind, all on the same 500 rows; "residual" is a form of `nlsm`."""
    recording = short_neck()
    made = {
        "rls": Rls(max_delay=0.12).fit(recording),
        "mimo": Rls(structure="mimo", delay=0.06).fit(recording),
        "oe": OutputError(delay=0.06, source="positions").fit(recording),
        "oe2": OutputError(nf=2, nb=2, delay=0.06).fit(recording),
        "nlsm": SetMembership(epsilon=0.01, output_weight=10.0).fit(recording),
        "residual": SetMembership(form="residual").fit(recording),
        "play": Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording),
        "nn": Network(hidden=(4, 3), iterations=8).fit(recording),
        "greybox": GreyBox(evaluations=4, sensor_delay=2, body="all").fit(recording),
    }
    return {**made, "guarded": guarded_of([made["rls"], made["play"], made["nn"]], recording)}


@pytest.fixture
def plain_steps_of_blocks(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a fast test run plain Python: compiling takes seconds a kind, and only slow tests need its speed."""
    if request.node.get_closest_marker("slow"):
        return
    for name in ("_runtime", "_tangent"):
        made = getattr(_compile, name)
        monkeypatch.setattr(_compile, name, lambda module, _compiled, made=made: made(module, False))


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
