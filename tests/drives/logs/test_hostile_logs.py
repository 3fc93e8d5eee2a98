"""Logs that are cut, foreign, of another version or made up: each is read up to its damage, or is one clear line."""

from __future__ import annotations

import contextlib
import json
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from softneck.core import FileFormatError, OutputFileError, SoftneckError
from softneck.drives import read_run_log, replay
from softneck.drives.logs._cycle import LoggedPilot
from softneck.drives.logs._log_file import changed_files
from softneck.drives.logs._run_log import LOG_VERSION, METADATA, RunLogger, run_facts

from ..bench import Bench

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run: 4 cycles."""
    path = tmp_path_factory.mktemp("logs") / "run.mcap"
    bench = Bench()
    with RunLogger(path, wait=True) as log:
        log.describe(run_facts(bench.master.settings, {}, simulated=True))
        pilot = LoggedPilot(bench.pilot)
        bench.master.pilot = pilot
        bench.run.watches = (log.watch(pilot),)
        bench.link.tap = log.frame
        bench.master.start()
        bench.pass_time(0.04)
    return path


# -- cut at every byte ------------------------------------------------------------------------------------------------

# Every byte of the file; `make test` takes each 13th, which hits every kind of record as well.
EVERY = pytest.mark.parametrize("step", [13, pytest.param(1, marks=pytest.mark.slow)])


@EVERY
def test_a_run_log_that_is_cut_at_any_byte_is_read_up_to_there(short: Path, tmp_path: Path, step: int) -> None:
    content, path = short.read_bytes(), tmp_path / "cut.mcap"
    whole = read_run_log(short).cycles
    before = -1
    for size in range(0, len(content), step):
        path.write_bytes(content[:size])
        try:
            log = read_run_log(path)
        except FileFormatError as error:
            # The settings are in front of the first cycle; without them nothing can be said.
            assert before < 0, size
            told = str(error)
            assert told.startswith(f"{path}: ")
            continue
        assert "ends in the middle" in log.cut
        assert log.cycles == whole[: len(log.cycles)]
        assert len(log.cycles) >= before
        before = len(log.cycles)
    assert before == len(whole)


# -- made by others ---------------------------------------------------------------------------------------------------


def written(path: Path, *, metadata: dict[str, str] | None, messages: list[tuple[str, bytes]] = []) -> Path:  # noqa: B006
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="another")
        if metadata is not None:
            writer.add_metadata(METADATA, metadata)
        schema = writer.register_schema("some/Thing", "ros2msg", b"float64 x")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in {t for t, _ in messages}}
        for k, (topic, data) in enumerate(messages):
            writer.add_message(channels[topic], k, data, k)
        writer.finish()
    return path


def test_a_log_of_another_tool_is_no_log_of_ours(tmp_path: Path) -> None:
    path = written(tmp_path / "ros.mcap", metadata=None, messages=[("/odom", bytes(24))])
    with pytest.raises(FileFormatError, match=r"ros\.mcap: is MCAP, but not a log of `softneck drives`"):
        read_run_log(path)


def test_a_log_of_another_version_says_which(tmp_path: Path) -> None:
    path = written(tmp_path / "new.mcap", metadata={"version": str(LOG_VERSION + 1), "facts": "{}"})
    with pytest.raises(FileFormatError, match=rf"has log version {LOG_VERSION + 1}; this softneck reads {LOG_VERSION}"):
        read_run_log(path)


def test_topics_of_others_in_a_log_of_ours_are_left_alone(short: Path, tmp_path: Path) -> None:
    facts = json.dumps(read_run_log(short).facts)
    metadata = {"version": str(LOG_VERSION), "facts": facts}
    path = written(tmp_path / "more.mcap", metadata=metadata, messages=[("/camera", b"\xff\x00" * 50)])
    log = read_run_log(path)
    assert (log.cycles, log.rows, log.events, log.cut) == ((), (), (), "")


@pytest.mark.parametrize(
    "record",
    [
        # Opcode, then a length that no machine has memory for (mcap.dev/spec: Metadata 0Ch, Chunk 06h, Message 05h).
        struct.pack("<BQ", 0x0C, 2**63 - 1),
        struct.pack("<BQ", 0x06, 2**62) + bytes(100),
        struct.pack("<BQ", 0x05, 2**40) + bytes(100),
        # A metadata record whose inner text claims 4 GB.
        struct.pack("<BQI", 0x0C, 40, 2**32 - 1) + bytes(36),
        # A compressed chunk that says it becomes 2**60 bytes.
        struct.pack("<BQQQQI", 0x06, 45, 0, 0, 2**60, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", 1) + b"x",
    ],
    ids=["metadata", "chunk", "message", "inner text", "uncompressed"],
)
def test_hostile_lengths_reserve_no_memory(tmp_path: Path, record: bytes) -> None:
    path = tmp_path / "hostile.mcap"
    path.write_bytes(b"\x89MCAP0\r\n" + struct.pack("<BQII", 0x01, 8, 0, 0) + record)
    with pytest.raises(
        FileFormatError,
        match=r"hostile\.mcap: (is not a log of `softneck drives`|unpacks to .* it is damaged or hostile)",
    ):
        read_run_log(path)


@pytest.mark.slow
@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    facts=JSON | st.fixed_dictionaries({"files": JSON}) | st.none(),
    entry=st.none() | st.tuples(st.sampled_from(["settings", "files", "experiment", "jog", "simulated"]), JSON),
    messages=st.lists(st.tuples(st.sampled_from(["/cycle", "/signals", "/events"]), JSON), max_size=4),
)
def test_whatever_a_log_holds_is_a_log_or_one_clear_error(
    short: Path, tmp_path: Path, facts: Any, entry: Any, messages: list[tuple[str, Any]]
) -> None:
    """JSON of any shape in every place where ours is expected."""
    if facts is None:
        facts = dict(read_run_log(short).facts)
        if entry is not None:
            facts[entry[0]] = entry[1]
    path = written(
        tmp_path / "any.mcap",
        metadata={"version": str(LOG_VERSION), "facts": json.dumps(facts)},
        messages=[(topic, json.dumps(table).encode()) for topic, table in messages],
    )
    try:
        log = read_run_log(path)
    except SoftneckError as error:
        told = str(error)
        assert told.startswith(str(path))
        return
    changed_files(log)
    for use in (log.settings, log.signals, log.recording, lambda: replay(log)):
        with contextlib.suppress(SoftneckError):
            use()


# -- disks ------------------------------------------------------------------------------------------------------------


def test_a_full_disk_costs_the_log_but_not_the_run(tmp_path: Path) -> None:
    """What an owner wants: an experiment that goes well goes on, and whoever looks later knows of the missing log."""
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    (tmp_path / "run.part.mcap").symlink_to("/dev/full")
    bench = Bench()
    log = RunLogger(tmp_path / "run.mcap", force=True, wait=True)
    log.describe(run_facts(bench.master.settings, {}, simulated=True))
    pilot = LoggedPilot(bench.pilot)
    bench.master.pilot = pilot
    bench.run.watches = (log.watch(pilot),)
    bench.link.tap = log.frame
    bench.master.start()
    bench.pass_time(3.0)
    assert (str(bench.master.supervisor.phase), bench.master.supervisor.fault) == ("running", None)
    with pytest.raises(
        OutputFileError, match=r"run\.part\..*the log is not complete: No space left on device\. The run went"
    ):
        log.close()
    assert not (tmp_path / "run.mcap").exists()
    # Closing twice is no error: contexts do that.
    log.close()


def test_a_folder_that_cannot_be_written_is_told_before_anything_moves(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(OutputFileError, match=r"run\.mcap: cannot be written: .*Choose another folder"):
        RunLogger(tmp_path / "file" / "run.mcap")


def test_a_clock_that_jumps_while_a_log_is_written_does_not_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = iter([1.7e9, *(1.7e9 + 3600.0 * (-1) ** k * k for k in range(10**4))])
    monkeypatch.setattr("time.time", lambda: next(now))
    path = tmp_path / "run.mcap"
    from softneck.drives.master import Frame

    with RunLogger(path, wait=True, epoch=1000.0) as log:
        log.describe({"files": {}})
        for k in range(100):
            log.frame(0.01 * k, True, Frame(0x80))
    with path.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages("/frames")]
    # Whole nanoseconds.
    assert times == pytest.approx([1e12 + 1e7 * k for k in range(100)], abs=1.0)
