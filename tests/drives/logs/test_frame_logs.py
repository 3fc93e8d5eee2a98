"""Logs of frames: BLF and candump read back, and every frame has words."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.drives.bus._meaning import meaning
from softneck.drives.logs._cycle import frame_of, frame_text
from softneck.drives.logs._frame_log import FrameLog
from softneck.drives.logs._run_log import RunLogger
from softneck.drives.master import Frame
from softneck.drives.master._cia301 import BUS_OFF

FRAMES = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans(), st.booleans())


@given(FRAMES)
def test_a_frame_reads_back_from_its_text(frame: Frame) -> None:
    assert frame_of(frame_text(frame)) == frame


@settings(max_examples=25, deadline=None)
@given(
    frames=st.lists(
        st.tuples(
            st.integers(0, 60_000),
            st.booleans(),
            st.one_of(
                st.builds(lambda number, data: Frame(number, data), st.integers(0, 0x7FF), st.binary(max_size=8)),
                st.builds(lambda node: Frame(0x700 + node, b"\0", remote=True), st.integers(1, 127)),
            ),
        ),
        min_size=1,
        max_size=40,
    )
)
def test_frame_logs_read_back(tmp_path_factory: pytest.TempPathFactory, frames: list[tuple[int, bool, Frame]]) -> None:
    folder = tmp_path_factory.mktemp("frames")
    frames.sort(key=lambda item: item[0])
    paths = [folder / "run.blf", folder / "run.log"]
    epoch = 1_700_000_000.0
    with RunLogger(paths, wait=True, epoch=epoch) as log:
        for milliseconds, from_master, frame in frames:
            log.frame(milliseconds / 1000.0, from_master, frame)
    for path in paths:
        read = list(FrameLog(path))
        assert [item[2] for item in read] == [item[2] for item in frames]
        # Microseconds in candump; a float of today's epoch has 0.24 us.
        times = [item[0] - epoch for item in read]
        np.testing.assert_allclose(times, [item[0] / 1000.0 for item in frames], atol=2e-6)
    # Only BLF has a place for the direction.
    assert [item[1] for item in FrameLog(paths[0])] == [item[1] for item in frames]


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
