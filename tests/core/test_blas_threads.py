"""One BLAS thread inside every fit, `tune` and `verify`, and as many as before outside; calls side by side."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import cast

import pytest
import scipy.linalg  # noqa: F401  (its BLAS is one of those that are counted)
from threadpoolctl import threadpool_info, threadpool_limits

from softneck.core import _blas_threads
from softneck.core._blas_threads import cores_taken, one_blas_thread, side_by_side, take_core_until, take_cores
from softneck.core._kinds import KINDS, kinds_of, make_settings, resolve
from softneck.identification import FamilySettings
from softneck.identification.selection._auto import choose
from softneck.plant._calibration import calibrate
from softneck.signals import Recording, assess_quality
from softneck.tuning import tune
from softneck.verification import verify

from ..verification.necks import linear_neck, pi

_OUTSIDE = 2


class _AskedError(Exception):
    """Ends a fit once its threads are counted."""


class _AskedRecording:
    """Whatever is read first of it counts the threads."""

    def __getattr__(self, _: str) -> object:
        raise _AskedError(_threads())


def _threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def _count_and_stop(done: float, what: str) -> None:
    raise _AskedError(_threads())


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """Two threads before, also where the environment of the tests says one."""
    with threadpool_limits(_OUTSIDE):
        yield


@pytest.mark.parametrize("kind", kinds_of("model"))
def test_a_fit_has_one_blas_thread(kind: str, neck: Recording) -> None:
    settings = make_settings(resolve(KINDS[kind].settings), {})
    with pytest.raises(_AskedError) as told:
        settings.fit(neck, progress=_count_and_stop)
    assert told.value.args == ({1},)
    assert _threads() == {_OUTSIDE}


@pytest.mark.parametrize(
    "call",
    [
        lambda neck: FamilySettings().fit(neck, progress=_count_and_stop),
        lambda neck: choose(*neck.split(0.7), kinds=["rls"], progress=_count_and_stop),
        lambda neck: calibrate([neck], [0.0], progress=_count_and_stop),
        lambda _: assess_quality(cast("Recording", _AskedRecording())),
        lambda _: verify(pi(), linear_neck(), progress=_count_and_stop),
        lambda _: tune({"neck": linear_neck()}, kinds=["pi"], budget=1, workers=0, progress=_count_and_stop),
    ],
    ids=["family", "auto", "calibrate", "quality", "verify", "tune"],
)
def test_what_searches_or_verifies_has_one_too(call: Callable[[Recording], object], neck: Recording) -> None:
    with pytest.raises(_AskedError) as told:
        call(neck)
    assert told.value.args == ({1},)
    assert _threads() == {_OUTSIDE}


def test_a_fit_that_ends_leaves_others_limited() -> None:
    begun, ended = threading.Event(), threading.Event()

    @one_blas_thread
    def short() -> None:
        begun.wait(10.0)

    @one_blas_thread
    def long() -> set[int]:
        begun.set()
        assert ended.wait(10.0)
        return _threads()

    first = threading.Thread(target=lambda: (short(), ended.set()))
    first.start()
    assert long() == {1}
    first.join()
    assert _threads() == {_OUTSIDE}


def test_the_command_line_limits_numpy_before_it_is_imported() -> None:
    code = (
        "import sys, softneck.cli._main as m; print('numpy' in sys.modules); "
        "sys.argv = ['softneck', 'info', 'absent']\n"
        "try: m.main()\nexcept SystemExit: pass\n"
        "import numpy, threadpoolctl; print(*{l['num_threads'] for l in threadpoolctl.threadpool_info()})"
    )
    environment = {"PATH": "/usr/bin:/bin"}  # without a number of threads
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == ["False", "1"]


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    """Two cores beside that of the caller."""
    cores = threading.Semaphore(2)
    monkeypatch.setattr(_blas_threads, "_FREE_CORES", cores)
    return cores


def _count(free: threading.Semaphore) -> int:
    return next(taken for taken in itertools.count() if not free.acquire(blocking=False))


def test_calls_side_by_side_meet_and_return_in_their_order(free: threading.Semaphore) -> None:
    meeting = threading.Barrier(3, timeout=10.0)

    def meet(number: int) -> int:
        meeting.wait()  # each waits for two others, which one thread alone would never see
        return number

    assert side_by_side([partial(meet, number) for number in range(6)]) == list(range(6))
    assert _count(free) == 2


def test_calls_within_calls_take_no_more_threads_than_cores(free: threading.Semaphore) -> None:
    running, most, lock = 0, 0, threading.Lock()

    def work() -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.001)
        with lock:
            running -= 1

    side_by_side([lambda: side_by_side([work] * 5)] * 4)
    assert most <= 3
    assert _count(free) == 2


@pytest.mark.parametrize("wrong", range(4))
def test_an_error_side_by_side_ends_what_has_not_begun(free: threading.Semaphore, wrong: int) -> None:
    begun: list[int] = []

    def run(number: int) -> None:
        begun.append(number)
        if number == wrong:
            raise _AskedError(number)
        time.sleep(0.001)

    with pytest.raises(_AskedError, match=str(wrong)):
        side_by_side([partial(run, number) for number in range(100)])
    assert len(begun) < 100
    assert _count(free) == 2


@pytest.mark.parametrize("count", range(4))
def test_cores_that_processes_take_are_free_again_afterwards(free: threading.Semaphore, count: int) -> None:
    here = threading.current_thread()
    with pytest.raises(_AskedError), cores_taken(count):  # noqa: PT012
        with cores_taken(3):
            assert {id(one) for one in side_by_side([threading.current_thread] * 9)} == {id(here)}
        assert take_cores(3) == max(0, 2 - count)
        if count < 2:
            free.release(2 - count)
        raise _AskedError
    assert _count(free) == 2


def test_a_core_is_taken_until_a_process_ends_and_no_longer(free: threading.Semaphore) -> None:
    ends = [threading.Event() for _ in range(3)]
    for end in ends:
        take_core_until(end.wait)
    assert take_cores(1) == 0
    ends[0].set()
    # Another thread releases it: ten seconds are far beyond any pause of the machine.
    assert free.acquire(timeout=10.0)
    assert take_cores(1) == 0
    for end in ends[1:]:
        end.set()
    assert free.acquire(timeout=10.0)
    assert take_cores(1) == 0, "the third had none"
