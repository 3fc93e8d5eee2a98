"""Frames in logs: they read back, and every frame has words."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.drives import read_run_log
from softneck.drives.logs._cycle import frame_of, frame_text, meaning
from softneck.drives.logs._run_log import RunLogger
from softneck.drives.master import Frame
from softneck.drives.master._fieldbus import BUS_OFF

FRAMES = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans(), st.booleans())


@given(FRAMES)
def test_a_frame_reads_back_from_its_text(frame: Frame) -> None:
    assert frame_of(frame_text(frame)) == frame


@settings(max_examples=25, deadline=None)
@given(frames=st.lists(st.tuples(st.floats(0.0, 60.0), st.booleans(), FRAMES), min_size=1, max_size=40))
def test_frames_outside_cycles_read_back(
    tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[float, bool, Frame]]
) -> None:
    path = tmp_path_factory.mktemp("frames") / "run.mcap"
    frames.sort(key=lambda item: item[0])
    with RunLogger(path, wait=True, epoch=1_700_000_000.0) as log:
        log.describe({"files": {}})
        for item in frames:
            log.frame(*item)
    read = read_run_log(path)
    assert read.frames() == list(read.outside) == frames


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (Frame(0, b"\x01\x02"), "NMT start to node 2"),
        (Frame(0x80), "SYNC"),
        (Frame(0x81, bytes.fromhex("1023010000000000")), "emergency 2310h of node 1"),
        (Frame(0x703, b"\0", remote=True), "guarding of node 3"),
        (Frame(0x703, b"\x85"), "node 3 is OPERATIONAL"),
        (BUS_OFF, "bus-off"),
        (Frame(0x601, bytes.fromhex("4000100000000000")), "SDO to node 1: 1000h:0"),
    ],
)
def test_a_frame_in_words(frame: Frame, text: str) -> None:
    assert meaning(frame).startswith(text)


@given(FRAMES)
def test_any_frame_has_words(frame: Frame) -> None:
    assert meaning(frame)
