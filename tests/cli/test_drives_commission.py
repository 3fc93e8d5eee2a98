"""`softneck drives commission`: what it prints and writes, exit codes, and bad input of which nothing comes."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from softneck.cli._main import run
from softneck.cli.drives import _target as cli_target
from softneck.cli.drives._target import Target
from softneck.drives import load_drives
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning import _commission
from softneck.drives.commissioning._moves import Guards, Moves
from softneck.drives.running._bus_loop import Session
from softneck.robot import Robot

from ..drives.commissioning.planted import plant, planted_link
from ..drives.commissioning.toy import Toy, mover_of

SIMULATED = ["drives", "commission", "--simulated"]


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Toy:
    """In the place of the simulated drives' moves, which take seconds; all else is as it is."""
    made = Toy()

    def measured(
        _session: Session, _guards: Guards, *, motors: list[int], report: object
    ) -> tuple[Moves, None]:  # fmt: skip
        del report
        return made.run(mover_of(motors=tuple(motors))), None

    monkeypatch.setattr(_commission, "measure", measured)
    monkeypatch.setattr(_commission, "expected_of", lambda *_: None)
    return made


def test_nothing_to_find_is_exit_code_0_and_two_files(
    toy: Toy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SIMULATED, "-o", str(tmp_path / "c"), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["holds"]
    assert said["findings"] == []
    assert [motor["tendon"] for motor in said["motors"]] == [1, 2, 3]
    assert said["motors"][0]["slack_rad"] == pytest.approx(toy.slack[0], abs=0.06)
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == ["drives.toml", "robot.toml"]
    # What was proposed is read by every other command, with each other.
    robot = Robot.read(tmp_path / "c" / "robot.toml")
    assert robot.drives == "drives.toml"
    assert load_drives(tmp_path / "c" / "drives.toml").moves == robot


def test_a_mistake_is_exit_code_1_one_line_and_still_both_files(
    toy: Toy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    toy.pull = (1, -1, 1)
    assert run([*SIMULATED, "-o", str(tmp_path)]) == 1
    said = capsys.readouterr()
    assert "2 (node 2)" in said.out
    assert said.err.splitlines()[-1] == (
        "softneck: 1 finding(s): motor 2: reversed: it pulls while the counts fall."
    )  # fmt: skip
    assert load_drives(tmp_path / "drives.toml").drives[1].scale.reversed
    assert "motor 2: reversed: it pulls while the counts fall. Take the proposed `reversed`." in said.err


def test_two_devices_with_one_number_write_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextlib.contextmanager
    def planted(chosen: Target, *, moves: bool, **_: object) -> Iterator[VirtualLink]:
        assert moves
        yield planted_link(chosen.file, plant(chosen.file, ["duplicate:2"]), None, sample_time=0.02)

    monkeypatch.setattr(cli_target, "open_link", planted)
    assert run([*SIMULATED, "-o", str(tmp_path), "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["findings"][0]["name"] == "duplicate node"
    assert "node 2: 2 devices answer (serial numbers 1002, 2002)" in said.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--travel", "100"], "`--travel` must be between 1 and 30 [rad]"),
        (["--pace", "0"], "`--pace` must be between"),
        (["--log", "x.blf"], "x.blf: a log ends in .mcap."),
        (["--motor", "5"], "`--motor` must be a whole number between 1 and 3"),
        (["--override", "all"], "is not one of"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    arguments: list[str], line: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*SIMULATED, "-o", str(tmp_path / "c"), *arguments]) == 2
    told = [text for text in capsys.readouterr().err.splitlines() if not text.endswith("...")]
    assert len(told) == 1, told
    assert line in told[0]
    assert not list((tmp_path / "c").glob("*")) if (tmp_path / "c").exists() else True


@pytest.mark.parametrize("name", ["drives.toml", "robot.toml"])
def test_a_file_that_is_there_is_not_replaced(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / name).write_text("mine")
    assert run([*SIMULATED, "-o", str(tmp_path)]) == 2
    assert f"{name}: exists already; use --force" in capsys.readouterr().err
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(name, "mine")]


def test_a_folder_that_cannot_be_written_is_told_before_anything_is_sent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    # Root may write anywhere.
    monkeypatch.setattr("softneck.drives.commissioning._commission.tempfile.TemporaryFile", refused)
    assert run([*SIMULATED, "-o", str(tmp_path)]) == 2
    assert "cannot be written: Permission denied. Choose another folder; nothing was sent." in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert run([*SIMULATED, "-o", str(tmp_path / "file" / "c")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_bus_needs_arming_and_a_drives_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["drives", "commission", "--bus", "virtual:nobody", "-o", str(tmp_path)]) == 2
    assert "need --drives DRIVES.toml" in capsys.readouterr().err
    file = tmp_path / "drives.toml"
    entries = "".join(f"[[drive]]\nnode = {node}\npeak_current_A = 10.0\n" for node in (1, 2, 3))
    file.write_text(f'profile = "ipos2015"\n{entries}[sensor]\nkind = "can"\n')
    command = ["drives", "commission", "--drives", str(file), "--bus", "virtual:nobody", "-o", str(tmp_path / "c")]
    assert run(command) == 2
    assert "say --arm if they may" in capsys.readouterr().err
    # Nobody is there: another bit rate, or no power.
    assert run([*command, "--arm"]) == 1
    assert "virtual:nobody: no node answers. Are the drives on, is the bit rate right" in capsys.readouterr().err
    assert not list((tmp_path / "c").glob("*"))
    assert run([*command, "--pace", "1"]) == 2


def test_ctrl_c_is_130_and_drives_are_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the keyboard says it: the motor goes back to where it stood, and what is not known stays as it was given."""
    from softneck.drives.running._keyboard import Keyboard
    from softneck.drives.running._timing import Ask

    asked = []

    def hit(self: Keyboard) -> Ask | None:
        asked.append(1)
        if len(asked) == 800:
            self.interrupted = True
            return Ask.LEAVE
        return None

    monkeypatch.setattr(Keyboard, "__call__", hit)
    assert run([*SIMULATED, "-o", str(tmp_path)]) == 130
    assert "somebody asked for the end" in capsys.readouterr().err
    assert len(asked) > 800
