"""The lab's inclinometer over a pseudo-terminal: good, late, torn, broken and binary lines, and another sensor."""

from __future__ import annotations

import math
import os
import re
import threading
import time
import tty
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.drives import SerialInclinometer
from softneck.drives.sensing._serial import SensorError, TiltLines, tilt_of_line


def line(inclination: float, orientation: float) -> bytes:
    return f"i{inclination:.2f},o{orientation:.2f}\n".encode()


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The sensor's end, and the name of ours."""
    theirs, ours = os.openpty()
    tty.setraw(ours)
    try:
        yield theirs, os.ttyname(ours)
    finally:
        os.close(theirs)
        os.close(ours)


def opened(terminal: tuple[int, str], *before: bytes, **options: float) -> SerialInclinometer:
    """A sensor that opened while `before` came."""
    sender = threading.Timer(0.05, lambda: os.write(terminal[0], b"".join(before or (b"\n", line(1.0, 90.0)))))
    sender.start()
    try:
        return SerialInclinometer(terminal[1], start=float(options.get("start", 5.0)))
    finally:
        sender.join()


def settled(sensor: SerialInclinometer) -> object:
    """What the sensor gives once a pseudo-terminal has passed the bytes on."""
    time.sleep(0.05)
    return sensor.read(0.0, ())


@given(st.integers(0, 18000), st.integers(0, 36000))
def test_a_line_gives_pitch_and_roll_of_its_tilt(inclination: int, orientation: int) -> None:
    i, o = inclination / 100, orientation / 100
    tilt = tilt_of_line(line(i, o)[:-1])
    assert tilt is not None
    # The tilt vector's components (README of the recordings; motor 1 at 90 deg).
    a, b = math.radians(i), math.radians(o)
    assert math.tan(tilt.values[0]) * math.cos(a) == pytest.approx(math.sin(a) * math.sin(b), abs=1e-9)
    assert math.tan(tilt.values[1]) * math.cos(a) == pytest.approx(-math.sin(a) * math.cos(b), abs=1e-9)


@given(st.lists(st.tuples(st.integers(0, 9000), st.integers(0, 36000)), max_size=20), st.data())
def test_samples_do_not_depend_on_how_the_bytes_are_torn(rows: list[tuple[int, int]], data: st.DataObject) -> None:
    stream = b"\n" + b"".join(line(i / 100, o / 100) for i, o in rows)
    whole, torn = TiltLines(), TiltLines()
    expected = whole.feed(stream)
    assert len(expected) == len(rows)
    samples, place = [], 0
    while place < len(stream):
        size = data.draw(st.integers(1, 30))
        samples += torn.feed(stream[place : place + size])
        place += size
    assert samples == expected


@given(st.lists(st.binary(max_size=200), max_size=8))
def test_any_bytes_give_samples_of_good_lines_only(pieces: list[bytes]) -> None:
    lines = TiltLines()
    for piece in pieces:
        for sample in lines.feed(piece):
            assert math.isfinite(sample.values[0])
            assert math.isfinite(sample.values[1])
    # However long the noise was: two good lines after it, and the second counts.
    assert lines.feed(b"\n" + line(5.0, 90.0) + line(6.0, 90.0))[-1].values[0] == pytest.approx(math.radians(6.0))


@pytest.mark.parametrize(
    "text",
    [b"i12.34,o12", b"i12.3,o120.00", b"12.34,o120.00", b"i12.34", b"o120.00", b"i-1.00,o2.00",
     b"i1.00,o2.00i3.00,o4.00",
     b"i200.00,o1.00", b"i1.00,o361.00", b"i1.00,onan", b"123", b"", b"\xff\xfe\x00"],
)  # fmt: skip
def test_what_is_no_line(text: bytes) -> None:
    assert tilt_of_line(text) is None


def test_upright_has_no_orientation() -> None:
    assert tilt_of_line(b"i0.00,onan\r") == tilt_of_line(b"i0.00,o0.00")


def test_a_sensor_over_a_terminal(terminal: tuple[int, str]) -> None:
    sensor = opened(terminal, b"4,o1", b"20.00\n", b"123\n", line(10.0, 90.0))
    try:
        first = sensor.read(0.0, ())
        assert first is not None
        assert first.values[0] == pytest.approx(math.radians(10.0))
        # Late: nothing came since, and the read does not wait for it.
        begin = time.monotonic()
        assert all(sensor.read(0.0, ()) is None for _ in range(20))
        assert time.monotonic() - begin < 1.0
        # Torn: the second half comes later. Of several the newest counts.
        os.write(terminal[0], line(11.0, 90.0) + b"i12.0")
        assert settled(sensor) == tilt_of_line(b"i11.00,o90.00")
        os.write(terminal[0], b"0,o90.00\n" + line(13.0, 90.0))
        assert settled(sensor) == tilt_of_line(b"i13.00,o90.00")
        # Broken and binary ones give nothing, and cost nothing but themselves.
        os.write(terminal[0], b"i1x.00,o90.00\n" + bytes(range(128, 256)) * 3)
        assert settled(sensor) is None
        os.write(terminal[0], b"\n" + line(14.0, 90.0))
        assert settled(sensor) == tilt_of_line(b"i14.00,o90.00")
        assert sensor.lines.bad >= 3
    finally:
        sensor.close()


def test_a_sensor_that_must_be_asked(terminal: tuple[int, str]) -> None:
    ended = threading.Event()

    def answers() -> None:
        os.write(terminal[0], b"123\n")
        while not ended.is_set():
            for _ in os.read(terminal[0], 16):
                os.write(terminal[0], line(7.0, 90.0))

    thread = threading.Thread(target=answers, daemon=True)
    thread.start()
    sensor = SerialInclinometer(terminal[1], request=True, start=5.0)
    assert settled(sensor) == tilt_of_line(b"i7.00,o90.00")
    ended.set()
    sensor.read(0.0, ())
    thread.join(timeout=5.0)
    sensor.close()


@pytest.mark.parametrize(
    ("sent", "start", "message"),
    [
        (b"\x75\x65\x80\x0e" * 400, 0.3, r"sends no lines such as i12\.34,o120\.00 at 9600 baud, but b'ue"),
        (b"\n" + b"$GPGGA,1,2\n" * 30, 5.0, r"sends no .* but b'\$GPGGA,1,2': another sensor, or another baud rate\?"),
        (b"\n", 0.3, r"silent for 0\.3 s at 9600 baud\. Some firmware must be asked: `request = true`"),
    ],
    ids=["3DM-GX5", "NMEA", "silent"],
)
def test_another_protocol_is_one_line(terminal: tuple[int, str], sent: bytes, start: float, message: str) -> None:
    pieces = [sent[k : k + 40] for k in range(0, len(sent), 40)]
    with pytest.raises(SensorError, match=f"inclinometer {re.escape(terminal[1])}: {message}"):
        opened(terminal, *pieces, start=start)


def test_a_port_that_is_not_there() -> None:
    message = r"inclinometer /dev/ttyNONE: cannot be opened: .*No such file.*Is it plugged in.*by-id.*Nothing moved\."
    with pytest.raises(SensorError, match=message):
        SerialInclinometer("/dev/ttyNONE")
