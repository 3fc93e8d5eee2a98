"""Ports, buses and sensors that fail: one clear line with advice, before anything moves, or a ramp to rest."""

from __future__ import annotations

import errno
import math
import os
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import (
    CanInclinometer,
    CanLink,
    PythonInclinometer,
    SerialInclinometer,
    default_drives,
    open_bus,
    preflight,
    reset,
    scan,
    simulated_neck,
    stop,
)
from softneck.drives.bus._link import BusError, VirtualLink, reason
from softneck.drives.master import Frame, Tilt
from softneck.drives.master._fieldbus import BUS_OFF
from softneck.drives.running._stop import require_reset, require_stopped
from softneck.drives.sensing._serial import SensorError
from softneck.drives.sensing._sources import look_at, make_python_sensor
from softneck.plant import NeckParameters


@pytest.fixture
def port() -> Iterator[tuple[int, str]]:
    theirs, ours = os.openpty()
    tty.setraw(ours)
    try:
        yield theirs, os.ttyname(ours)
    finally:
        for end in (theirs, ours):
            try:
                os.close(end)
            except OSError:
                continue


def serial_error(number: int, name: str) -> serial.SerialException:
    """As pyserial wraps what the operating system says: the number stands in its text as well."""
    text = os.strerror(number)
    return serial.SerialException(number, f"could not open port {name}: [Errno {number}] {text}: '{name}'")


# -- what it is and what to do ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (serial_error(errno.EACCES, "/dev/ttyACM0"), r"Permission denied: '/dev/ttyACM0'\. .*group `dialout`.*\.$"),
        (serial_error(errno.ENOENT, "/dev/ttyACM0"), r"Is it plugged in.*by-id"),
        (serial_error(errno.EBUSY, "/dev/ttyACM0"), r"Another program has it open"),
        (OSError(errno.ENODEV, "No such device"), r"No such device\. `ip link show`"),
        (OSError(errno.EAFNOSUPPORT, "Address family not supported"), r"This kernel has no CAN: `sudo modprobe can"),
        (can.CanOperationError("Failed to transmit: [Errno 100] Network is down"), r"`sudo ip link set can0 up`"),
        (PermissionError(errno.EPERM, "Operation not permitted"), "This user is not permitted"),
        (RuntimeError(), r"^RuntimeError\.$"),
    ],
)  # fmt: skip
def test_an_error_of_the_machine_comes_with_advice_and_without_its_number(error: Exception, text: str) -> None:
    with pytest.raises(ValueError, match=text) as found:
        raise ValueError(reason(error))
    assert "Errno" not in str(found.value)
    assert "\n" not in str(found.value)


def test_a_port_without_permission_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(name: str, *_: Any, **__: Any) -> None:
        raise serial_error(errno.EACCES, name)

    monkeypatch.setattr(serial, "Serial", refuses)
    with pytest.raises(SensorError, match=r"^inclinometer /dev/ttyACM0: cannot be opened: .*dialout.*Nothing moved\.$"):
        SerialInclinometer("/dev/ttyACM0")


def test_a_port_of_another_user_is_one_line(port: tuple[int, str]) -> None:
    """A port that nobody may open; root, who may open all, becomes another user meanwhile."""
    Path(port[1]).chmod(0o000)
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        if os.access(port[1], os.R_OK, effective_ids=True):
            pytest.skip("this user may open every port")
        with pytest.raises(SensorError, match=r"cannot be opened: could not open port .*Permission denied.*dialout"):
            SerialInclinometer(port[1])
    finally:
        os.seteuid(user)


@pytest.mark.parametrize(
    "error",
    [PermissionError(errno.EPERM, "Operation not permitted"), NameError("name 'canOpen' is not defined"),
     AttributeError("windll"), can.CanInitializationError("no such device")],
    ids=["permission", "driver missing", "another system", "device"],
)  # fmt: skip
def test_whatever_a_driver_raises_while_a_bus_opens_is_one_line(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def refuses(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(can, "Bus", refuses)
    with (
        pytest.raises(BusError, match=r"^bus kvaser:0 cannot be opened: .*\. Nothing was sent\.$"),
        open_bus("kvaser:0"),
    ):
        pass


# -- a bus that works no more -----------------------------------------------------------------------------------------


class Broken:
    """A bus whose interface is down."""

    def send(self, *_: Any, **__: Any) -> None:
        raise can.CanOperationError("Failed to transmit: [Errno 100] Network is down")

    def _recv_internal(self, timeout: float) -> tuple[None, bool]:
        assert timeout >= 0.0
        time.sleep(timeout)
        return None, False


@pytest.mark.parametrize(
    "act",
    [lambda link: preflight(link, default_drives()), lambda link: stop(link, default_drives()),
     lambda link: reset(link, default_drives()), scan],
    ids=["check", "stop", "reset", "scan"],
)  # fmt: skip
def test_a_bus_that_is_down_is_not_blamed_on_the_drives(act: Callable[[Any], object]) -> None:
    link = CanLink(Broken(), "socketcan:can0")
    with pytest.raises(BusError, match=r"takes no frames: Failed to transmit: Network is down\. `sudo ip link set"):
        act(link)
    assert BUS_OFF in link.receive(0.0)


def test_a_deadline_that_passed_is_no_error() -> None:
    with can.Bus("deadline", interface="virtual") as bus:
        assert CanLink(bus, "virtual:deadline").receive(-1e-3) == []


def test_a_wall_clock_that_is_set_back_does_not_make_a_bus_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """python-can's `recv` measures on the wall clock; this waited for two hours."""
    moments = iter([10_000.0 - 7200.0 * k for k in range(1000)])
    monkeypatch.setattr("can.bus.time", lambda: next(moments))
    with can.Bus("clock", interface="virtual") as bus:
        begin = time.monotonic()
        assert CanLink(bus, "virtual:clock").receive(0.05) == []
    # 50 ms, and what a busy machine adds.
    assert time.monotonic() - begin < 30.0


# -- stop and reset tell how it ended ---------------------------------------------------------------------------------


def test_a_drive_that_may_still_have_power_is_an_error() -> None:
    require_stopped({1: "DISABLED", 2: "FAULT", 3: "SWITCHED_ON"})
    for state in ("ENABLED", "QUICK_STOP", "REACTION", "UNKNOWN", "no answer"):
        with pytest.raises(
            CheckFailedError, match=rf"^node 2: {state}: not stopped for sure\. Press the hardware stop"
        ):
            require_stopped({1: "DISABLED", 2: state})


def test_a_fault_that_stays_is_an_error() -> None:
    require_reset({1: "DISABLED", 2: "DISABLED"})
    for state in ("FAULT", "no answer"):
        with pytest.raises(
            CheckFailedError, match=rf"^node 3: {state} after the reset\. Is the hardware stop released"
        ):
            require_reset({1: "DISABLED", 3: state})


# -- the inclinometer before anything moves ---------------------------------------------------------------------------


class Says:
    """An inclinometer that always says the same."""

    def __init__(self, tilt: Tilt | None) -> None:
        self.tilt = tilt

    def take(self, frames: Sequence[Frame]) -> None:
        del frames

    def read(self, now: float, frames: Sequence[Frame]) -> Tilt | None:
        del now, frames
        return self.tilt


@pytest.mark.parametrize(
    ("tilt", "holds", "found"),
    [
        (Tilt(0.01, -0.02), True, "pitch 0.57, roll -1.15 deg"),
        (None, False, "no sample within 0.5 s"),
        (Tilt(math.nan, 0.0), False, "pitch nan"),
        (Tilt(math.inf, 0.0), False, "pitch inf"),
        (Tilt(1e30, 0.0), False, "pitch 57"),
        (Tilt(0.0, 0.0, valid=False), False, "pitch 0.00"),
        (Tilt(1.5, 0.0), False, "pitch 85.94"),
    ],
)
def test_no_drive_gets_power_without_an_angle(tilt: Tilt | None, holds: bool, found: str) -> None:
    file = default_drives()
    link = VirtualLink(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, homed=True))
    report = preflight(link, file, homed=True, sensor=Says(tilt))
    row = report.rows[-1]
    assert (row.name, row.holds) == ("inclinometer", holds)
    assert row.found.startswith(found)
    if not holds:
        with pytest.raises(CheckFailedError, match=r"inclinometer: .*Nothing was moved\."):
            report.require()
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)


def test_an_inclinometer_on_the_bus_is_started_and_asked() -> None:
    with can.Bus("tilt", interface="virtual") as theirs, can.Bus("tilt", interface="virtual") as ours:
        link = CanLink(ours, "virtual:tilt")
        data = (1000).to_bytes(4, "little") + (-2000).to_bytes(4, "little", signed=True)
        theirs.send(can.Message(arbitration_id=0x18A, data=data, is_extended_id=False))
        tilt = look_at(CanInclinometer(10), link, 0.5)
        assert tilt is not None
        assert tuple(map(math.degrees, tilt.values)) == pytest.approx((1.0, -2.0))
        assert look_at(CanInclinometer(10), link, 0.05) is None


def test_a_port_that_vanishes_ends_the_samples_and_says_why(port: tuple[int, str]) -> None:
    # Opening a port drops what came before.
    sender = threading.Timer(0.1, lambda: os.write(port[0], b"\ni1.00,o90.00\n"))
    sender.start()
    sensor = SerialInclinometer(port[1])
    sender.join()
    assert sensor.read(0.0, ()) is not None
    os.close(port[0])
    for _ in range(20):
        assert sensor.read(0.0, ()) is None
        sensor.take(())
    assert sensor.problem
    assert "Errno" not in sensor.problem
    sensor.close()


@pytest.mark.parametrize(
    "line",
    [b"\x01\x03\x04\x00\x11\x00\x2a\xaa\xbb", b"i", b"\xff" * 40, b"inan,onan\n", b"i1e99,o1.00\n", b"$GPGGA,1*33\r\n"],
    ids=["Modbus", "our own requests", "wrong baud rate", "not a number", "infinite", "NMEA"],
)
def test_another_protocol_in_the_middle_of_a_run_is_no_sample(port: tuple[int, str], line: bytes) -> None:
    sender = threading.Timer(0.1, lambda: os.write(port[0], b"\ni1.00,o90.00\n"))
    sender.start()
    sensor = SerialInclinometer(port[1])
    sender.join()
    sensor.read(0.0, ())
    os.write(port[0], line * 20)
    time.sleep(0.05)
    assert sensor.read(0.0, ()) is None
    sensor.close()


# -- a sensor of one's own --------------------------------------------------------------------------------------------


class Own:
    """A sensor of somebody else's."""

    def __init__(self, answer: Any) -> None:
        self.answer, self.asked = answer, 0

    def take(self, frames: Sequence[Frame]) -> None:
        del frames

    def read(self, now: float, frames: Sequence[Frame]) -> Any:
        del now, frames
        self.asked += 1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


NONSENSE = st.one_of(
    st.text(), st.integers(), st.floats(), st.tuples(st.floats(), st.floats()), st.lists(st.integers()),
    st.just(ValueError("line\nbreak")), st.just(KeyError("x")), st.just(SystemError()),
    st.just(Tilt("a", 0.0)), st.just(Tilt(None, 0.0)),  # pyright: ignore[reportArgumentType]
)  # fmt: skip


@given(NONSENSE)
def test_nonsense_of_ones_own_sensor_is_no_sample_and_is_asked_for_once(answer: Any) -> None:
    own = Own(answer)
    sensor = PythonInclinometer(own, "mine:make")
    assert [sensor.read(0.01 * k, ()) for k in range(5)] == [None] * 5
    assert own.asked == 1
    assert sensor.problem.startswith("`read` r")
    assert "\n" not in sensor.problem


@given(st.builds(Tilt, st.floats(), st.floats(), st.floats(), st.floats(), st.booleans()))
def test_samples_of_ones_own_sensor_pass_as_they_are(tilt: Tilt) -> None:
    """Also NaN and what is not believable: the gate of the master judges them, as all others."""
    sensor = PythonInclinometer(Own(tilt), "mine:make")
    assert repr(tuple(sensor.read(0.0, ()) or ())) == repr(tuple(tilt))
    assert sensor.problem == ""


def test_a_sensor_of_ones_own_that_waits_is_named() -> None:
    own = Own(None)
    own.read = lambda _now, _frames: time.sleep(0.03)  # type: ignore[method-assign]
    sensor = PythonInclinometer(own, "mine:make")
    sensor.read(0.0, ())
    with pytest.raises(ValueError, match=r"^`read` took \d+ ms; it must not wait\.$"):
        raise ValueError(sensor.problem)


@pytest.mark.parametrize("text", ["1/0", "def make(", "raise RuntimeError('two\\nlines')", "import nowhere_at_all"])
def test_a_module_that_cannot_be_imported_is_one_line(
    tmp_path: Path, text: str, request: pytest.FixtureRequest
) -> None:
    name = f"broken_sensor_{abs(hash(request.node.name))}"
    (tmp_path / f"{name}.py").write_text(text, encoding="utf-8")
    with pytest.raises(
        SettingsError, match=rf"^\[sensor\] python = `{name}:make` cannot be found \(\w+: [^\n]*\); write"
    ):
        make_python_sensor(f"{name}:make", {}, tmp_path)
