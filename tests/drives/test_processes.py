"""Faults of real processes: drives, inclinometer and host on UDP multicast in a network namespace of their own.

End states are exact and told by the drives' process. Time bounds are generous (500 ms), for the machine that runs the
tests is nobody's own.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from softneck.drives import read_run_log, replay

from .processes import CASES, NAMESPACE, UDP, World, write_project

SCRIPT = Path(__file__).with_name("processes.py")


def allowed(*command: str) -> bool:
    if any(shutil.which(name) is None for name in ("unshare", "ip", command[0])):
        return False
    return subprocess.run([*command, "true"], capture_output=True, check=False).returncode == 0


pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or not allowed(*NAMESPACE),
    reason="needs unshare and ip (util-linux, iproute2) and the right to a network namespace of its own",
)


def played(cases: Sequence[str], *options: str) -> list[dict[str, Any]]:
    """Play cases one after the other; where the machine allows it, before its ordinary work."""
    more = ["--realtime"] if allowed("chrt", "-f", "1") else []
    command = [sys.executable, str(SCRIPT), *cases, "--attempts", "3", *more, *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.mark.slow
def test_all_end_states_are_exact() -> None:
    """Three parts of the cases at once, each in a network of its own: they mostly wait."""
    # A forked process ends sooner than an interpreter of its own, which here is met at its end.
    whole = [name for name in CASES if "interrupt" in name or "while_writing" in name]
    forked = [name for name in CASES if name not in whole]
    parts = [(whole, ()), (forked[::2], ("--fork",)), (forked[1::2], ("--fork",))]
    with ThreadPoolExecutor(len(parts)) as pool:
        found = {one["case"]: one for told in pool.map(lambda part: played(part[0], *part[1]), parts) for one in told}
    assert set(found) == set(CASES)
    assert [one for one in found.values() if not one["exact"]] == []
    reactions = {name: one["reaction_s"] for name, one in found.items() if one["reaction_s"] is not None}
    assert {name for name, seconds in reactions.items() if not 0.0 < seconds < 0.5} == set()


@pytest.mark.slow
def test_a_log_of_a_real_bus_gives_the_same_decisions(tmp_path: Path) -> None:
    """Over UDP multicast, ended by SIGTERM; the files of the run are gone, so that its own answers are used."""
    path = tmp_path / "run.mcap"
    (found,) = played(["terminated"], "--extra=--log", f"--extra={path}", "--extra=--force")
    assert found["exact"], json.dumps(found)
    log = read_run_log(path)
    assert log.cut == ""
    assert log.cycles[-1].phase == "done"
    replay(log).require()
    assert len(log.recording()) > 5
    assert len(log.frames()) > 6 * len(log.cycles)


@pytest.mark.slow
def test_a_bus_that_is_down_is_one_line_and_nothing_moves(tmp_path: Path) -> None:
    # A namespace begins with its loopback down: no multicast leaves or arrives.
    write_project(tmp_path)
    words = [f"{tmp_path}/pi.npz", "--loop", f"{tmp_path}/short.toml", "--drives", f"{tmp_path}/drives.toml"]
    code = "from softneck.cli import main; main()"
    command = [*NAMESPACE, sys.executable, "-c", code, "drives", "run", *words, "--bus", UDP, "--arm"]
    done = subprocess.run(
        [*command, "--override", "certificate"], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode in (1, 2)
    assert done.stderr.strip().splitlines()[-1].startswith(f"softneck: bus {UDP} ")


def test_a_case_that_cannot_start_is_not_exact(tmp_path: Path) -> None:
    world = World(tmp_path)
    assert not world.all("DISABLED")
    assert world.left(0.0) is None
