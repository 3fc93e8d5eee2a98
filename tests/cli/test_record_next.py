"""softneck record MODEL: the file that says what to record next, and what plays it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from softneck.identification import OutputError
from softneck.signals import read_recording

from ..data import Truth, guarded_of, recording_from, short_neck
from .conftest import Call


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two lines that part in pitch."""
    path = tmp_path_factory.mktemp("models") / "two.npz"
    P = short_neck().set_points
    lines = [OutputError(delay=0.06).fit(recording_from(P, truth=Truth(gain=(gain, 0.008)))) for gain in (0.01, 0.012)]
    guarded_of(lines, short_neck()).save(path)
    return path


def test_it_writes_what_to_record_and_says_why(call: Call, two: Path) -> None:
    said = call("record", two, "-o", "next.csv", "--duration", 20, "--max-position", 1, "--json")
    assert said.code == 0, said.err
    facts = json.loads(said.out)
    assert facts["rows"] == 1000
    assert [part["start_s"] for part in facts["parts"]] == [0.0, 10.0]
    assert all(part["why"].startswith("members part by ") for part in facts["parts"])
    doubt = facts["disagreement_deg"]
    assert doubt["before"] > doubt["expected_after"] > 0.0
    P = read_recording("next.csv").set_points
    assert np.abs(P).max() <= 1.0


def test_record_plays_it_and_nothing_is_replaced_unasked(call: Call, two: Path) -> None:
    assert call("record", two, "-o", "next.csv", "--duration", 10).code == 0
    before = Path("next.csv").read_bytes()
    again = call("record", two, "-o", "next.csv", "--duration", 10, "--seed", 3)
    assert again.code == 2
    assert "next.csv" in again.error
    assert Path("next.csv").read_bytes() == before
    assert call("record", two, "-o", "next.csv", "--duration", 10, "--seed", 3, "--force").code == 0
    played = call("record", "next.csv", "-o", "rec.csv")
    assert played.code == 0, played.err
    np.testing.assert_array_equal(read_recording("rec.csv").set_points, read_recording("next.csv").set_points)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("--duration", "2"), "`duration` must be between 4 and 3600"),
        (("--max-position", "0"), "`position` must be positive"),
    ],
)
def test_bad_settings_are_one_line(call: Call, two: Path, arguments: tuple[str, ...], what: str) -> None:
    said = call("record", two, "-o", "next.csv", *arguments)
    assert said.code == 2
    assert what in said.error
    assert not Path("next.csv").exists()


def test_a_model_of_one_piece_is_one_line(call: Call, rls_file: Path) -> None:
    said = call("record", rls_file, "-o", "next.csv")
    assert said.code == 2
    assert "`rls` has no members that could part" in said.error


def test_a_robot_that_names_its_drives_has_their_slack_and_speed(call: Call, two: Path) -> None:
    drives = "".join(f"[[drive]]\nnode = {node}\npeak_current_A = 10.0\n" for node in (1, 2, 3))
    Path("drives.toml").write_text(
        f'profile = "ipos2015"\n[limits]\nslack_unwind_rad = 0.7\nspeed_rad_s = 8.0\n{drives}'
    )
    Path("robot.toml").write_text('name = "lab"\nextends = "neck"\n[drives]\nfile = "drives.toml"\n')
    said = call("record", two, "-o", "next.csv", "--duration", 20, "--robot", "robot.toml")
    assert said.code == 0, said.err
    P = read_recording("next.csv").set_points
    assert -0.7 <= P.min() < -0.6
    # A quarter of what the drives take, as `drives record` has it; rounding of sums of steps.
    assert np.abs(np.diff(P, axis=0)).max() <= 2.0 * 0.02 + 1e-9
    said = call("record", two, "-o", "b.csv", "--duration", 10, "--robot", "robot.toml", "--max-position", 9)
    assert said.code == 2
    assert "--max-position 9 is beyond the 6 rad" in said.error
