"""Studies that are killed, interrupted, or run on a Dask cluster of which a worker dies; all in real processes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest

from softneck.cosim import load_study, read_runs, study

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow

LOOP = """
duration_s = 0.4
[plant]
python = "study_parts:Lag"
parameters = { sleep = 0.15 }
[controller]
python = "study_parts:Gain"
[reference]
kind = "step"
pitch_deg = 10.0
"""
STUDY = """
loop = "loop.toml"
runs = 40
seed = 2
[vary]
"plant.parameters.pole" = { uniform = [0.8, 0.95] }
"""
_COMMAND = [sys.executable, "-c", "from softneck.cli import main; main()", "study", "study.toml", "-o", "out"]
# A busy machine starts a process in tens of seconds.
_PATIENCE = 120.0


@pytest.fixture
def place(tmp_path: Path) -> Path:
    shutil.copy(Path(__file__).with_name("study_parts.py"), tmp_path)
    (tmp_path / "loop.toml").write_text(LOOP)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


@contextmanager
def running(command: list[str], place: Path) -> Iterator[subprocess.Popen[str]]:
    """A command in a process group of its own, which ends with the block."""
    process = subprocess.Popen(
        command, cwd=place, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        for stream in (process.stdout, process.stderr):
            if stream is not None:
                stream.close()


def wait_for_runs(folder: Path, number: int, process: subprocess.Popen[str]) -> int:
    """Wait until so many runs have ended, and not all of them."""
    end = time.monotonic() + _PATIENCE
    while time.monotonic() < end:
        try:
            done = len(read_runs(folder))
        except Exception:  # the folder begins, or a small file was just joined
            done = 0
        if done >= number:
            return done
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        time.sleep(0.05)
    pytest.fail("the study did not get on")


def gone(group: int) -> bool:
    """Wait until a process group has no member; loky's tracker sees its parent's end a moment later."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


def the_same(first: pd.DataFrame, second: pd.DataFrame) -> None:
    pd.testing.assert_frame_equal(first.drop(columns="seconds"), second.drop(columns="seconds"), check_exact=True)


def test_kill_9_and_resume(place: Path) -> None:
    with running([*_COMMAND, "--workers", "2"], place) as process:
        wait_for_runs(place / "out", 5, process)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    before = read_runs(place / "out")
    assert 5 <= len(before) < 40
    done = subprocess.run([*_COMMAND, "--workers", "2", "--json"], cwd=place, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["runs"] == 40
    after = pd.read_csv(place / "out" / "runs.csv")
    assert after["run"].tolist() == list(range(40))
    kept = after[after["run"].isin(before["run"])]
    assert kept["seconds"].tolist() == before["seconds"].tolist()  # those were not run again
    the_same(read_runs(place / "out"), study(load_study(place / "study.toml"), workers=0))


def test_ctrl_c_ends_cleanly(place: Path) -> None:
    with running([*_COMMAND, "--workers", "2"], place) as process:
        wait_for_runs(place / "out", 4, process)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=_PATIENCE)
        assert process.returncode == 130
        assert said.strip().splitlines()[-1].startswith("softneck: interrupted; files already finished are kept")
        assert "Traceback" not in said
        assert gone(process.pid)
    runs = study(place / "study.toml", workers=0, output=place / "out")
    assert runs["run"].tolist() == list(range(40))


@pytest.fixture
def cluster(place: Path) -> Iterator[tuple[str, list[subprocess.Popen[str]]]]:
    """The address of a scheduler on loopback, and its two workers."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port)]
    worker = [
        sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
        "--local-directory", str(place),
    ]  # fmt: skip
    with (
        running([*dask, "--no-dashboard"], place) as _,
        running([*worker, "--name", "a"], place) as a,
        running([*worker, "--name", "b"], place) as b,
    ):
        from distributed import Client

        end = time.monotonic() + _PATIENCE
        while True:
            try:
                with Client(address, timeout=5, set_as_default=False) as client:
                    client.wait_for_workers(2, timeout=_PATIENCE)
                break
            except OSError:
                assert time.monotonic() < end
        yield address, [a, b]


def on_cluster(place: Path, address: str) -> None:
    """Have the study of `place` run there."""
    file = place / "study.toml"
    file.write_text(f'dask = "{address}"\n{file.read_text()}')


def test_dask_with_a_worker_that_dies(place: Path, cluster: tuple[str, list[subprocess.Popen[str]]]) -> None:
    """A scheduler and two workers on loopback; one is killed in the middle, no run is lost, no number changed."""
    address, workers = cluster
    on_cluster(place, address)
    with running([*_COMMAND, "--json"], place) as process:
        wait_for_runs(place / "out", 5, process)
        os.killpg(workers[0].pid, signal.SIGKILL)
        out, said = process.communicate(timeout=_PATIENCE)
        assert process.returncode == 0, said
    assert json.loads(out)["failed"] == 0
    the_same(read_runs(place / "out"), study(load_study(place / "study.toml"), workers=0))


def test_no_scheduler_is_a_clear_line(place: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    on_cluster(place, address)
    done = subprocess.run(_COMMAND, cwd=place, capture_output=True, text=True)
    assert done.returncode == 2
    line = [line for line in done.stderr.splitlines() if line.startswith("softneck:")]
    assert len(line) == 1
    assert f"no Dask scheduler answers at {address}" in line[0]
    assert not (place / "out").exists()
