"""--realtime: the loop before its own threads, those before ordinary processes, and all back in line afterwards."""

from __future__ import annotations

import os
import sys
import threading

import pytest

from softneck.core import SettingsError
from softneck.drives.running._timing import steady


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="SCHED_FIFO is Linux's")
def test_threads_beside_the_loop_come_after_it_and_before_others() -> None:
    ended = threading.Event()
    beside = threading.Thread(target=ended.wait)
    beside.start()
    try:
        number = beside.native_id
        assert number is not None

        def lines() -> list[tuple[bool, int]]:
            kinds = [os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK for thread in (0, number)]
            found = [os.sched_getparam(thread).sched_priority for thread in (0, number)]
            return [(kind == os.SCHED_FIFO, priority) for kind, priority in zip(kinds, found, strict=True)]

        try:
            with steady(realtime=True):
                (first, own), (second, other) = lines()
                assert first
                assert second
                assert own > other > 0
        except SettingsError as error:
            pytest.skip(str(error))
        assert lines() == [(False, 0), (False, 0)]
    finally:
        ended.set()
        beside.join()
