"""Logs of runs: they read back to the bit, replay to the same decisions, and others can read them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import CheckFailedError, DataError, FileFormatError, OutputFileError, SettingsError
from softneck.cosim import load_loop
from softneck.drives import default_drives, prepare, read_run_log, replay, run_simulated
from softneck.drives.logs._cycle import Cycle, LoggedPilot, decode_cycle, encode_cycle
from softneck.drives.logs._log_file import changed_files
from softneck.drives.logs._run_log import RunLogger, run_facts
from softneck.drives.master import Frame, Phase
from softneck.drives.master._gate import Reading
from softneck.drives.running._pilot import LoopPilot

from ...data import slow_but
from ..bench import Bench
from ..conftest import Project
from ..scenarios import SCENARIOS

NUMBERS = st.floats(allow_nan=True, allow_infinity=True)
FRAMES = st.builds(Frame, st.integers(0, 0x7FF), st.binary(max_size=8), st.booleans(), st.booleans())
TRIPLES = st.tuples(NUMBERS, NUMBERS, NUMBERS)
ANSWERS = st.one_of(
    st.tuples(st.just("step"), st.one_of(st.none(), TRIPLES, st.text())),
    st.tuples(st.just("finished"), st.booleans()),
    st.tuples(st.just("start"), st.none()),
)
CYCLES = st.builds(
    Cycle,
    st.floats(0.0, 1e9),
    st.lists(FRAMES, max_size=4).map(tuple),
    st.one_of(st.none(), st.builds(Reading, st.tuples(NUMBERS, NUMBERS), st.tuples(NUMBERS, NUMBERS), st.booleans())),
    st.lists(st.tuples(st.sampled_from(["start", "finish", "leave", "stop"]), st.text()), max_size=2).map(tuple),
    st.lists(ANSWERS, max_size=2).map(tuple),
    st.lists(FRAMES, max_size=4).map(tuple),
    st.sampled_from([str(phase) for phase in Phase]),
    TRIPLES, TRIPLES, TRIPLES,
)  # fmt: skip


def logged_bench(path: Path, name: str | None = None) -> Bench:
    """A bench with a log from its first cycle on, played through a scenario of the fault table."""
    scenario = SCENARIOS[name] if name else None
    bench = Bench(off=scenario.others_off if scenario else frozenset(), change=scenario.change if scenario else None)
    tap, master = bench.link.tap, bench.master
    with RunLogger(path, wait=True) as log:
        log.describe(run_facts(master.settings, {}, simulated=True))
        pilot = LoggedPilot(bench.pilot)
        master.pilot = pilot
        bench.run.watches = (log.watch(pilot),)

        def both(now: float, from_master: bool, frame: Frame) -> None:
            if tap is not None:
                tap(now, from_master, frame)
            log.frame(now, from_master, frame)

        bench.link.tap = both
        bench.start()
        if scenario is not None:
            scenario.play(bench)
    return bench


# -- to the bit -------------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(CYCLES)
def test_a_cycle_reads_back_to_the_bit(cycle: Cycle) -> None:
    text = json.dumps(encode_cycle(cycle), allow_nan=False)
    # By text, for NaN is not equal to itself.
    assert repr(decode_cycle(json.loads(text))) == repr(cycle)


# -- replay -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", slow_but(SCENARIOS, list(SCENARIOS)[::4]))
def test_every_fault_of_the_table_replays_to_the_same_stop(tmp_path: Path, name: str) -> None:
    bench = logged_bench(tmp_path / "run.mcap", name)
    log = read_run_log(tmp_path / "run.mcap")
    assert log.cut == ""
    result = replay(log)
    assert result.difference is None, str(result.difference)
    assert result.cycles == bench.master.cycle
    assert result.phase == str(bench.phase)
    fault = bench.master.supervisor.fault
    assert result.fault == ("" if fault is None else str(fault))


@pytest.fixture(scope="module")
def run(project: Project, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run of controller and observer, logged."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    with RunLogger(path, wait=True) as log:
        files = {"controller": project.controller, "loop": project.loop}
        setup = load_loop(project.loop)
        result = run_simulated(prepare(setup, project.controller), default_drives(), log=log, files=files)
    assert result.completed
    recording = read_run_log(path).recording()
    expected = result.recording()
    for name, values in expected.channels.items():
        np.testing.assert_array_equal(recording.channels[name], values)
    assert recording.sample_time == expected.sample_time
    return path


@pytest.mark.slow
def test_the_controller_computed_again_gives_the_same_run(run: Path, project: Project) -> None:
    log = read_run_log(run)
    assert changed_files(log) == []
    pilot = LoopPilot(prepare(load_loop(project.loop), project.controller).loop)
    result = replay(log, pilot)
    result.require()
    assert (result.phase, result.fault) == ("done", "")
    assert result.answers == len(log.rows)


@pytest.mark.slow
def test_another_controller_is_found_at_its_first_answer(run: Path, project: Project) -> None:
    other = project.write_loop("other_reference.toml", 'kind = "step"\npitch_deg = 15.5\nat_s = 1.0', 4.0)
    log = read_run_log(run)
    result = replay(log, LoopPilot(prepare(load_loop(other), project.controller).loop))
    assert result.difference is not None
    with pytest.raises(CheckFailedError, match=r"the replay differs from the log at cycle \d+, t = [\d.]+ s: the cont"):
        result.require()
    first = next(k for k, cycle in enumerate(log.cycles) if cycle.phase == "running")
    # The step comes 1 s, 100 cycles, after the begin.
    assert result.difference.cycle == first + 1 + 100


def test_a_changed_frame_is_found_and_explained(run: Path) -> None:
    log = read_run_log(run)
    k = len(log.cycles) // 2
    old = log.cycles[k]
    new = replace_frame(old)
    changed = replace(log, cycles=(*log.cycles[:k], new, *log.cycles[k + 1 :]))
    found = replay(changed).difference
    assert found is not None
    assert (found.cycle, found.what) == (k, "frame 201h")
    assert found.logged.startswith("to node 1: control word 0000h, target 0 counts")


def replace_frame(cycle: Cycle) -> Cycle:
    return cycle._replace(sent=(Frame(0x201, bytes(6)), *cycle.sent[1:]))


def test_other_limits_are_found(run: Path) -> None:
    log = read_run_log(run)
    table = json.loads(json.dumps(log.facts))
    table["settings"]["limits"]["speed"] = 1.0
    assert replay(replace(log, facts=table)).difference is not None


# -- a cut log, a killed process --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_log_is_read_up_to_its_cut(run: Path, tmp_path: Path) -> None:
    whole, cycles = run.read_bytes(), read_run_log(run).cycles
    path = tmp_path / "cut.mcap"
    rng = np.random.default_rng(0)
    before = 0
    for size in sorted(rng.integers(12_000, len(whole) - 30_000, 12)):
        path.write_bytes(whole[:size])
        log = read_run_log(path)
        assert "ends in the middle" in log.cut
        assert len(log.cycles) >= before
        assert log.cycles == cycles[: len(log.cycles)]
        before = len(log.cycles)
        if log.cycles:
            result = replay(log)
            result.require()
            assert "replayed up to the cut" in result.notes[-1]
    assert before > 100


@settings(max_examples=20, deadline=None)
@given(st.data())
def test_a_damaged_log_is_one_line_or_a_cut(
    run: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(run.read_bytes())
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("damaged") / "run.mcap"
    path.write_bytes(content)
    with contextlib.suppress(FileFormatError):
        read_run_log(path)


@pytest.mark.parametrize("content", [b"", b"no log", b"\x89MCAP0\r\n", bytes(range(256))])
def test_what_is_no_log_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=r"run\.mcap: is not a log of `softneck drives`"):
        read_run_log(path)


KILLED = """
import os, signal, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from softneck.drives.logs._run_log import RunLogger, run_facts
from softneck.drives.logs._cycle import LoggedPilot
from tests.drives.bench import Bench
bench = Bench()
folder = Path(sys.argv[1])
log = RunLogger(folder / "run.mcap")
log.describe(run_facts(bench.master.settings, {}, simulated=True))
pilot = LoggedPilot(bench.pilot)
bench.master.pilot = pilot
bench.run.watches = (log.watch(pilot),)
bench.link.tap = log.frame
bench.master.start()
begin = time.monotonic()
for k in range(140):
    bench.step()
    time.sleep(max(0.0, begin + 0.01 * (k + 1) - time.monotonic()))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.slow
def test_a_killed_process_loses_less_than_the_last_second(tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), str(root)], capture_output=True, check=False)
    assert done.returncode == -9, done.stderr.decode()
    assert not (tmp_path / "run.mcap").exists()
    log = read_run_log(tmp_path / "run.part.mcap")
    assert "ends in the middle" in log.cut
    # 140 cycles of 10 ms; one second is 100 of them.
    assert len(log.cycles) > 40
    replay(log).require()
    with pytest.raises(OutputFileError, match=r"run\.part\.mcap: exists already"):
        RunLogger(tmp_path / "run.mcap")


def test_the_loop_does_not_wait_for_the_disk(tmp_path: Path) -> None:
    log = RunLogger(tmp_path / "run.mcap")
    log._queue.maxsize = 4
    taken = log._take
    log._take = lambda entry: (time.sleep(0.05), taken(entry))[1]  # type: ignore[method-assign]
    for k in range(600):
        log.frame(0.01 * k, True, Frame(0x80))
        if k % 2:
            log._put(log_entry(k))
    assert log.lost > 0
    with pytest.raises(OutputFileError, match=r"cycle\(s\) were dropped: the disk did not keep up"):
        log.close()


def log_entry(k: int):
    from softneck.drives.logs._run_log import _Entry

    return _Entry([], None, None, (), 0.01 * k)


@pytest.mark.parametrize("frames", [1, 50, 5000])
def test_a_full_disk_is_one_line_and_the_loop_goes_on(tmp_path: Path, frames: int) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    (tmp_path / "run.part.mcap").symlink_to("/dev/full")
    log = RunLogger(tmp_path / "run.mcap", force=True)
    for k in range(frames):
        log.frame(0.01 * k, True, Frame(0x80, k.to_bytes(2, "little")))
    with pytest.raises(OutputFileError, match="the log is not complete: No space left on device"):
        log.close()


def test_logs_have_endings_and_are_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"a log ends in \.mcap"):
        RunLogger(tmp_path / "run.txt")
    (tmp_path / "run.mcap").write_text("kept")
    with pytest.raises(OutputFileError, match="exists already"):
        RunLogger(tmp_path / "run.mcap")
    with RunLogger(tmp_path / "empty.mcap") as log:
        log.describe(run_facts(Bench().master.settings, {}, simulated=True))
    empty = read_run_log(tmp_path / "empty.mcap")
    with pytest.raises(DataError, match="holds no cycle"):
        replay(empty)


# -- others read it ---------------------------------------------------------------------------------------------------


def test_mcap_opens_with_the_index_of_its_own_reader(run: Path) -> None:
    from mcap.reader import make_reader

    with run.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert {channel.topic for channel in summary.channels.values()} == {"/cycle", "/frames", "/signals", "/events"}
        rows = [json.loads(message.data) for _, _, message in reader.iter_messages("/signals")]
    expected = read_run_log(run).signals()
    np.testing.assert_array_equal([row["pitch_measured"] for row in rows], expected["pitch_measured"])


@pytest.mark.slow
def test_wireshark_reads_what_python_can_writes_of_a_log(run: Path) -> None:
    tool = shutil.which("tshark")
    if tool is None:
        if os.environ.get("CI"):
            pytest.fail("tshark is missing; `.ci/run` installs it")
        pytest.skip("tshark is not installed")
    fields = ("can.id", "can.flags.rtr", "canopen.pdo.data.bytes", "_ws.malformed")
    command = ["-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=;"]
    command += [part for field in fields for part in ("-e", field)]
    path = run.with_suffix(".blf")
    frames = [item for item in read_run_log(run).frames() if not item[2].error]
    # As docs/reference/files.md says it.
    with can.Logger(str(path)) as writer:
        for time_, sent, frame in frames:
            data = None if frame.remote else frame.data
            writer(can.Message(time_, frame.identifier, is_extended_id=False, is_remote_frame=frame.remote, data=data,
                               is_rx=not sent))  # fmt: skip
    done = subprocess.run([tool, "-r", str(path), *command], capture_output=True, text=True, check=True)
    rows = [line.split(";") for line in done.stdout.splitlines()]
    assert len(rows) == len(frames)
    for (_, _, frame), (identifier, remote, data, malformed) in zip(frames, rows, strict=True):
        assert not malformed
        assert int(identifier, 0) == frame.identifier
        assert (remote in ("1", "True")) == frame.remote
        if data:
            assert data.replace(":", "") == frame.data.hex()


@pytest.mark.slow
def test_a_log_holds_every_frame_on_the_wire_once(project: Project, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    wire: list[tuple[bool, Frame]] = []
    with RunLogger(path, wait=True) as log:
        taken = log.frame

        def frame(now: float, from_master: bool, frame: Frame) -> None:
            wire.append((from_master, frame))
            taken(now, from_master, frame)

        log.frame = frame  # type: ignore[method-assign]
        run_simulated(prepare(load_loop(project.loop), project.controller), default_drives(), log=log)
    ours = [(sent, frame) for _, sent, frame in read_run_log(path).frames()]
    for side in (True, False):
        # What a cycle received came on the wire before it, and what it sent goes out after: each side has its order.
        assert [frame for sent, frame in ours if sent is side] == [frame for sent, frame in wire if sent is side]
