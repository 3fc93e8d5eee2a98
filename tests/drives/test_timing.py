"""Parts around the control loop: what a service manager is told, how a run is asked to end, cycle times, snapshots."""

from __future__ import annotations

import errno
import gc
import itertools
import math
import os
import signal
import socket
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import SettingsError
from softneck.drives.logs._result import CycleTimes
from softneck.drives.running import _keyboard
from softneck.drives.running._keyboard import Keyboard
from softneck.drives.running._timing import Ask, Notifier, steady

from .bench import Bench

unix = pytest.mark.skipif(not hasattr(socket, "AF_UNIX"), reason="needs Unix sockets")


class Manager:
    """The service manager's end of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self.socket.setblocking(False)
        self.address = address

    def told(self) -> list[str]:
        """What came since the last call."""
        lines = []
        while True:
            try:
                lines.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return lines


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path):
    if request.param == "abstract" and sys.platform != "linux":
        pytest.skip("abstract names are Linux's")
    made = Manager(f"@softneck-{os.getpid()}" if request.param == "abstract" else str(tmp_path / "n"))
    yield made
    made.socket.close()


# -- what a service manager is told -----------------------------------------------------------------------------------


@unix
def test_a_manager_hears_ready_phases_and_the_end_in_their_order(manager: Manager) -> None:
    bench = Bench()
    with Notifier({"NOTIFY_SOCKET": manager.address}) as notifier:
        notifier.ready()
        bench.start()
        for k in range(5):
            notifier.cycle(0.01 * k, bench.master)
    assert manager.told() == ["READY=1", f"STATUS={bench.master.supervisor.phase}", "STOPPING=1"]
    notifier.tell("never")
    assert manager.told() == []


@unix
@given(times=st.lists(st.floats(0.0, 0.3), min_size=1, max_size=40))
def test_signs_of_life_come_from_cycles_only_and_four_in_a_time_out(times: list[float]) -> None:
    """However the cycles come: a quarter of the time-out lies between two of them, and at most one cycle more."""
    bench, timeout = Bench(), 0.4
    sent: list[str] = []
    notifier = Notifier({"WATCHDOG_USEC": str(int(timeout * 1e6))})
    notifier.tell = sent.append  # type: ignore[method-assign]
    now, fed = 0.0, []
    for step in times:
        now += step
        before = len(sent)
        notifier.cycle(now, bench.master)
        if "WATCHDOG=1" in sent[before:]:
            fed.append(now)
        # Never longer than a quarter without, unless no cycle came meanwhile.
        assert now - fed[-1] < timeout / 4
    assert all(later - earlier >= timeout / 4 for earlier, later in itertools.pairwise(fed))


@pytest.mark.parametrize(
    "environment",
    [
        {},
        {"WATCHDOG_USEC": "400000", "WATCHDOG_PID": str(os.getpid() + 1)},
        {"WATCHDOG_USEC": "0"},
        {"WATCHDOG_USEC": "soon"},
        {"WATCHDOG_USEC": "-5"},
    ],
    ids=["no time-out", "another process'", "off", "no number", "negative"],
)
def test_no_watchdog_is_fed_that_is_not_ours(environment: dict[str, str]) -> None:
    bench, sent = Bench(), []
    notifier = Notifier(environment)
    notifier.tell = sent.append  # type: ignore[method-assign]
    for k in range(100):
        notifier.cycle(0.1 * k, bench.master)
    assert [text for text in sent if text.startswith("WATCHDOG")] == []


@unix
@pytest.mark.parametrize("address", ["", "relative/path", "/no/such/socket", "@nobody-listens-there", "vsock:2:1"])
def test_a_manager_that_does_not_listen_stops_nothing(address: str) -> None:
    with Notifier({"NOTIFY_SOCKET": address}) as notifier:
        notifier.ready()
        notifier.tell("STATUS=x")


@unix
def test_a_manager_that_reads_nothing_does_not_hold_up_the_loop(manager: Manager) -> None:
    with Notifier({"NOTIFY_SOCKET": manager.address}) as notifier:
        # More than any socket buffers; a blocking send would never return.
        for _ in range(20_000):
            notifier.tell("WATCHDOG=1")
    assert 0 < len(manager.told()) < 20_000


# -- being asked to end -----------------------------------------------------------------------------------------------


def test_each_signal_is_one_request_and_the_second_one_is_at_once() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Keyboard() as keyboard:
        assert keyboard() is None
        signal.raise_signal(signal.SIGTERM)
        assert [keyboard() for _ in range(3)] == [Ask.LEAVE, None, None]
        signal.raise_signal(signal.SIGTERM)
        assert [keyboard() for _ in range(3)] == [Ask.STOP, None, None]
    assert signal.getsignal(signal.SIGTERM) is before


def test_two_signals_between_two_steps_stop_at_once() -> None:
    with Keyboard() as keyboard:
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert keyboard() is Ask.STOP


def test_the_signal_is_given_back_after_an_error_and_left_alone_in_threads() -> None:
    before = signal.getsignal(signal.SIGTERM)

    def fails() -> None:
        with Keyboard():
            raise SettingsError("whatever")

    with pytest.raises(SettingsError, match="whatever"):
        fails()
    assert signal.getsignal(signal.SIGTERM) is before
    seen: list[object] = []

    def inside() -> None:
        with Keyboard():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert seen == [before]


STOPS = {"SIGINT": Ask.LEAVE, "SIGHUP": Ask.LEAVE, "SIGTERM": Ask.LEAVE, "SIGTSTP": Ask.STOP}


@unix
@pytest.mark.parametrize("ignored", [None, *STOPS])
def test_each_signal_has_its_request_and_one_that_was_ignored_stays_so(
    ignored: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`nohup` ignores one; that takes none of the others."""
    monkeypatch.setattr(_keyboard, "_leave_dead_terminal", lambda: left.append("terminal"))
    for name, ask in STOPS.items():
        left: list[str] = []
        before = signal.signal(getattr(signal, ignored or name), signal.SIG_IGN if ignored else signal.SIG_DFL)
        kept = signal.getsignal(getattr(signal, name))
        try:
            with Keyboard() as keyboard:
                signal.raise_signal(getattr(signal, name))
                assert keyboard() is (None if name == ignored else ask)
                assert keyboard.interrupted is (name not in ("SIGTERM", ignored))
                assert keyboard.terminated is (name == "SIGTERM" != ignored)
                assert left == ["terminal"] * (name == "SIGHUP" != ignored)
            assert signal.getsignal(getattr(signal, name)) is kept
        finally:
            signal.signal(getattr(signal, ignored or name), before)


@pytest.mark.parametrize(
    ("typed", "asks"),
    [
        ([b"\x1b"], [Ask.STOP]), ([b" "], [Ask.STOP]), ([b"x\r\n\x02\x04"], [None]), ([b""], [None]),
        ([b"\x03"], [Ask.LEAVE]), ([b"\x03", b"", b"\x03"], [Ask.LEAVE, None, Ask.STOP]), ([b"\x03\x03"], [Ask.STOP]),
        ([b"a\x03 "], [Ask.STOP]), ([b" \x03", b""], [Ask.STOP, None]),
    ],
)  # fmt: skip
def test_keys_that_stop_and_keys_that_leave(typed: list[bytes], asks: list[Ask | None]) -> None:
    keyboard, keys = Keyboard(), iter(typed)
    keyboard._read = lambda: next(keys)
    assert [keyboard() for _ in typed] == asks
    assert keyboard.interrupted is (b"\x03" in b"".join(typed))


@unix
@pytest.mark.parametrize("front", [True, False])
def test_the_terminal_is_read_key_by_key_in_front_and_as_before_after(
    front: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import pty
    import termios

    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    with os.fdopen(ours, "wb", buffering=0), os.fdopen(theirs, "r") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr(os, "tcgetpgrp", lambda file: os.getpgrp() + (not front) + 100 * (file != theirs))
        with Keyboard() as keyboard:
            # Local modes: no line is waited for.
            assert bool(termios.tcgetattr(theirs)[3] & termios.ICANON) is not front
            assert keyboard() is None
            os.write(ours, b" ")
            assert keyboard() is (Ask.STOP if front else None)
            # In the background the kernel would stop who reads.
            os.write(ours, b" ")
            monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() + 1)
            assert keyboard() is None

            def gone(_: int) -> int:
                raise OSError(5, "gone")

            monkeypatch.setattr(os, "tcgetpgrp", gone)
            assert keyboard() is None
        assert termios.tcgetattr(theirs) == before
    assert _keyboard._unix_keys(theirs) == b""  # closed: no error either


def test_without_a_terminal_nothing_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with (tmp_path / "keys").open("w+") as file:
        file.write("   ")
        file.seek(0)
        for stdin in (None, file):
            monkeypatch.setattr(sys, "stdin", stdin)
            with Keyboard() as keyboard:
                assert keyboard() is None


def test_on_windows_keys_come_from_its_console(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = [b"a", b"\x1b"]
    console = SimpleNamespace(kbhit=lambda: bool(keys), getch=lambda: keys.pop(0))
    monkeypatch.setitem(sys.modules, "msvcrt", console)
    monkeypatch.setattr(_keyboard, "sys", SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True), platform="win32"))
    with Keyboard() as keyboard:
        assert (keyboard(), keyboard()) == (Ask.STOP, None)


@unix
@pytest.mark.parametrize(("number", "closed"), [(errno.EIO, True), (errno.ENOTTY, False)])
def test_output_to_a_terminal_that_is_closed_is_discarded(
    number: int, closed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import termios

    def attributes(_: int) -> None:
        raise termios.error(number, "gone")

    ended, closed_again = list[object](), list[object]()
    system = SimpleNamespace(isatty=lambda file: file == 1, dup2=lambda *files: ended.append(files), devnull=os.devnull,
                             open=lambda *args: args, close=closed_again.append,
                             O_WRONLY=os.O_WRONLY)  # fmt: skip
    monkeypatch.setattr(_keyboard, "os", system)
    monkeypatch.setattr(termios, "tcgetattr", attributes)
    _keyboard._leave_dead_terminal()
    # 1 is a terminal that answers, 2 one that does not.
    assert ended == [((os.devnull, os.O_WRONLY), 2)] * closed
    assert closed_again == [(os.devnull, os.O_WRONLY)] * closed


@unix
@pytest.mark.parametrize("problem", [None, OSError("gone")])
def test_a_terminal_is_given_back_from_the_background_too(
    problem: Exception | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import termios

    seen: list[object] = []

    def restore(*given: object) -> None:
        seen.append((given, signal.getsignal(signal.SIGTTOU)))
        if problem is not None:
            raise problem

    monkeypatch.setattr(termios, "tcsetattr", restore)
    before = signal.getsignal(signal.SIGTTOU)
    _keyboard._restore(7, "as before")
    thread = threading.Thread(target=_keyboard._restore, args=(7, "as before"))
    thread.start()
    thread.join()
    given = (7, termios.TCSADRAIN, "as before")
    assert seen == [(given, signal.SIG_IGN), (given, before)]
    assert signal.getsignal(signal.SIGTTOU) is before


# -- a steady process -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("enabled", [True, False])
def test_nothing_is_collected_in_a_run_and_all_is_as_before_after_it(enabled: bool) -> None:
    was = gc.isenabled()
    try:
        (gc.enable if enabled else gc.disable)()
        frozen = gc.get_freeze_count()
        with steady():
            before = gc.get_stats()
            for _ in range(10_000):  # a collector that works comes every 700 objects
                itself: list[object] = []
                itself.append(itself)
            assert gc.get_stats() == before
        assert gc.isenabled() == enabled
        assert gc.get_freeze_count() == frozen
    finally:
        (gc.enable if was else gc.disable)()


# -- cycle times ------------------------------------------------------------------------------------------------------


def times_of(moments: list[float], cycle: float = 0.01) -> CycleTimes:
    times = CycleTimes(cycle)
    for moment in moments:
        times.take(moment, 0.0)
    return times


@given(st.lists(st.integers(1, 40), max_size=60), st.floats(1e-3, 1.0), st.floats(0.0, 1e6))
def test_cycles_and_missed_ones_fill_the_run(periods: list[int], cycle: float, begin: float) -> None:
    """A period of n cycles misses n - 1: together they are all that could have been."""
    moments = [begin]
    for period in periods:
        moments.append(moments[-1] + period * cycle)
    times = times_of(moments, cycle)
    assert times.count == len(periods)
    assert times.missed == sum(periods) - len(periods)
    assert times.late == sum(period >= 2 for period in periods)
    assert times.table()["missed_share"] == pytest.approx(times.missed / max(1, sum(periods)))


@given(st.lists(st.floats(0.0, 0.19), min_size=1, max_size=200), st.floats(0.01, 1.0))
def test_a_quantile_is_that_of_all_periods_to_ten_microseconds(periods: list[float], share: float) -> None:
    moments = [0.0]
    for period in periods:
        moments.append(moments[-1] + period)
    found = times_of(moments).quantile(share)
    exact = sorted(periods)[max(0, math.ceil(share * len(periods) - 1e-9) - 1)]
    # The upper edge of a bin of 10 us; sums of floats add a few 1e-15.
    assert exact - 1e-9 <= found <= exact + 1e-5 + 1e-9


@given(st.lists(st.floats(-1.0, 10.0), max_size=30))
def test_a_jitter_is_neither_late_nor_missed_and_odd_clocks_do_no_harm(periods: list[float]) -> None:
    moments, now = [0.0], 0.0
    for period in periods:
        now += period
        moments.append(now)
    times = times_of(moments)
    assert times.missed >= 0
    assert 0.0 <= times.quantile(0.99) <= 0.2
    steady_times = times_of([0.01 * k + 0.004 * (k % 2) for k in range(50)])
    assert (steady_times.late, steady_times.missed) == (0, 0)


def test_nothing_was_measured_without_a_period() -> None:
    for moments in ([], [1.0]):
        assert times_of(moments).table() == {
            "cycles": 0, "late": 0, "missed": 0, "missed_share": 0.0, "p50_s": 0.0, "p99_s": 0.0, "longest_s": 0.0,
            "longest_step_s": 0.0,
        }  # fmt: skip
