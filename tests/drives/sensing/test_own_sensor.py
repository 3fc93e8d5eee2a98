"""The example of an inclinometer of one's own: through the drives file, over a pseudo-terminal."""

from __future__ import annotations

import importlib.util
import math
import os
import struct
import threading
import time
import tty
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.drives import load_drives, open_sensor

from ...data import ROOT

PATH = ROOT / "examples" / "drives" / "my_sensor.py"


def _loaded() -> ModuleType:
    spec = importlib.util.spec_from_file_location("my_sensor_example", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


EXAMPLE = _loaded()


def packet(pitch: float, roll: float, *, before: bytes = b"") -> bytes:
    """A packet of the sensor; `before` are further fields in it."""
    fields = before + struct.pack(">BBfff", 14, 0x0C, roll, pitch, 1.0)
    content = b"\x75\x65\x80" + bytes((len(fields),)) + fields
    return content + EXAMPLE.checksum(content)


@given(
    rows=st.lists(st.tuples(st.floats(-1.0, 1.0, width=32), st.floats(-1.0, 1.0, width=32)), min_size=1, max_size=6),
    # Without the header's "u": a false header with a large length would wait for more bytes than there are.
    noise=st.binary(max_size=12).filter(lambda data: b"u" not in data),
    cut=st.integers(1, 20),
)
def test_packets_give_the_same_samples_however_they_are_torn(
    rows: list[tuple[float, float]], noise: bytes, cut: int
) -> None:
    stream = noise + b"".join(packet(pitch, roll, before=b"\x03\x07\x00") for pitch, roll in rows)
    packets = EXAMPLE.Packets()
    samples = [packets.feed(stream[k : k + cut]) for k in range(0, len(stream), cut)]
    newest = [sample for sample in samples if sample is not None]
    # Of several in one piece the newest counts; the last one of all is always there.
    assert newest
    assert newest[-1].values == rows[-1]
    assert {sample.values for sample in newest} <= set(rows)


def test_a_wrong_checksum_is_no_sample_and_costs_its_packet_only() -> None:
    bad = bytearray(packet(0.1, 0.2))
    bad[8] ^= 1
    assert EXAMPLE.Packets().feed(bytes(bad)) is None
    assert EXAMPLE.Packets().feed(bytes(bad) + packet(0.5, 0.25)).values == (0.5, 0.25)


def test_the_drives_file_opens_it(tmp_path: Path) -> None:
    theirs, ours = os.openpty()
    tty.setraw(ours)
    try:
        (tmp_path / "my_sensor.py").write_text(PATH.read_text(encoding="utf-8"), encoding="utf-8")
        text = (ROOT / "examples" / "drives" / "drives.toml").read_text(encoding="utf-8")
        lines = f'kind = "python"\npython = "my_sensor:make"\noptions = {{ port = "{os.ttyname(ours)}" }}\n#'
        (tmp_path / "drives.toml").write_text(text.replace('kind = "can"  ', lines, 1), encoding="utf-8")
        file = load_drives(tmp_path / "drives.toml")
        with open_sensor(file.sensor_kind, file.sensor_node, file.sensor_source) as sensor:
            assert sensor.read(0.0, ()) is None
            sender = threading.Thread(target=lambda: os.write(theirs, packet(math.radians(10.0), 0.0)))
            sender.start()
            sender.join()
            time.sleep(0.05)
            tilt = sensor.read(0.01, ())
            assert tilt is not None
            # 32-bit floats.
            assert math.degrees(tilt.values[0]) == pytest.approx(10.0, rel=1e-6)
            assert sensor.problem == ""
    finally:
        os.close(theirs)
        os.close(ours)
