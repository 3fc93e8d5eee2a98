"""Hundreds of generated logs: what is imported without a doubt is what was measured."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from softneck.cli._main import run

from .log_generator import OTHERS, Log, clocks, encoders, formats, units, wraps

#: Groups, and how many of each are imported as they were measured; the others are doubted or refused.
GROUPS = {
    "units": (units, 64), "clocks": (clocks, 100), "wraps": (wraps, 40), "encoders": (encoders, 6),
    "formats": (formats, 13),
}  # fmt: skip


def outcome(log: Log, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """Import a log as `softneck import LOG --guess --yes` does, and compare with the truth."""
    path, out = folder / f"log{log.suffix}", folder / "out.csv"
    log.write(path)
    out.unlink(missing_ok=True)
    capsys.readouterr()
    code = run(["import", str(path), "--guess", "--yes", "-o", str(out), "--force", "--json"])
    said = capsys.readouterr()
    assert code in (0, 2), f"{log.name}: {said.err}"
    if code == 2:
        return "refused by name" if any(name in said.err for name in log.named) else "refused"
    facts, frame = json.loads(said.out), pd.read_csv(out, comment="#")
    outputs = [next((column for column in frame if column.startswith(name)), "") for name in ("pitch", "roll")]
    # In a unit of no angle a robot of its own is proposed: its columns or a line name the unit, and its numbers stay.
    own = [column for column in frame if column.startswith(("motor_setpoint", "cmd", "ref", "setpoint"))]
    if log.named and not all(column.endswith("[rad]") for column in own):
        unit = log.named[0]
        named = all(f"[{unit}]" in column for column in own) or f"`{unit}` is unknown" in said.out + said.err
        numbers = np.allclose(frame[own].to_numpy(), log.set_points * OTHERS[unit], atol=1e-6)
        return "right, by the unit's name" if named and len(own) == 3 and numbers else "wrong, sure"
    U = frame[[f"motor_setpoint_{j} [rad]" for j in (1, 2, 3)]].to_numpy()
    Y = frame[outputs].to_numpy() * [np.pi / 180.0 if "deg" in column else 1.0 for column in outputs]
    n = min(len(U), len(log.set_points))
    # Angles differ by half turns at most, as a sensor is mounted; cells have ten digits, and a resampled log is
    # shifted by less than a step.
    off = Y[:n] - log.angles[:n]
    right = (
        abs(facts["sample_time_s"] / log.sample_time - 1.0) < 0.02
        and abs(len(U) - len(log.set_points)) <= 2
        and np.allclose(U[:n], log.set_points[:n], atol=2e-3)
        and np.allclose(off - np.pi * np.round(np.median(off, axis=0) / np.pi), 0.0, atol=2e-3)
    )
    if log.positions is not None and right:
        X = frame[[f"motor_position_{j} [rad]" for j in (1, 2, 3)]].to_numpy()
        right = bool(np.allclose(X[:n], log.positions[:n], atol=2e-3))
    doubted = "doubted" if facts["doubts"] else "sure"
    return f"right, {doubted}" if right else f"wrong, {doubted}"


@pytest.mark.parametrize("group", GROUPS)
def test_no_log_is_imported_wrongly_without_a_doubt(
    group: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What cannot be taken is refused or doubted by its name."""
    make, right = GROUPS[group]
    logs = list(make())
    found = {log.name: outcome(log, tmp_path, capsys) for log in logs}
    assert [name for name, what in found.items() if what == "wrong, sure"] == []
    assert Counter(what.partition(",")[0] for what in found.values())["right"] >= right
    assert [log.name for log in logs if log.named and found[log.name] == "refused"] == []


@pytest.mark.parametrize(
    ("name", "sample_time", "doubts"),
    [
        ("time_ms_title_seconds_values.csv", 0.02, True),
        ("time_minutes.csv", 0.02, False),
        ("setpoints_in_turns.csv", 0.02, False),
        ("pitch_in_mrad.csv", 0.02, False),
        ("roll_wraps_at_180.csv", 0.02, False),
        ("ros2_topic_echo.csv", 0.02, True),
        ("labview.lvm", 0.02, False),
        ("long_format.csv", 0.02, False),
        ("arrays.npz", 0.02, False),
    ],
)
def test_a_reported_log_is_imported_as_its_title_says(
    name: str, sample_time: float, doubts: bool, shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = shared_data / "reports" / name, tmp_path / "out.csv"
    if not log.is_file():
        pytest.skip(f"{log} is not here")
    capsys.readouterr()
    assert run(["import", str(log), "--guess", "--yes", "-o", str(out), "--json"]) == 0
    facts, frame = json.loads(capsys.readouterr().out), pd.read_csv(out, comment="#")
    # Times in minutes have eight decimals: 0.3 us of 20 ms.
    assert facts["sample_time_s"] == pytest.approx(sample_time, rel=1e-3)
    assert bool(facts["doubts"]) == doubts
    # The same motion lies in all of these files: set-points [rad] and pitch [deg] of the first rows.
    np.testing.assert_allclose(frame.filter(like="motor_setpoint").to_numpy()[0], [0.75057, 2.3833, 1.6541], rtol=1e-3)
    pitch = frame.filter(regex="^pitch ").iloc[:, 0].to_numpy()
    pitch = pitch if "pitch [deg]" in frame else np.degrees(pitch)
    np.testing.assert_allclose(pitch[:2], [-0.02027, -0.013899], atol=2e-4)
    # Roll moves about 0, or about the edge of its sensor's range: no jumps, and its sign as logged.
    roll = frame.filter(regex="^roll ").iloc[:, 0].to_numpy()
    roll = roll if "roll [deg]" in frame else np.degrees(roll)
    np.testing.assert_allclose(roll[:2], [0.0060942, 0.0038181], atol=1e-2)


@pytest.mark.parametrize("command", ["import", "info"])
@pytest.mark.parametrize("rows", [0, 1, 2])
def test_too_few_rows_are_one_line(command: str, rows: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "log.csv"
    titles = ["time [s]", *(f"motor_setpoint_{j} [rad]" for j in (1, 2, 3)), "pitch [deg]", "roll [deg]"]
    lines = [f"{0.02 * k},{k},{k},{k},{k},{k}" for k in range(rows)]
    log.write_text("\n".join([",".join(titles), *lines, ""]))
    more = ["--guess", "--yes", "-o", str(tmp_path / "out.csv")] if command == "import" else []
    assert run([command, str(log), *more]) in (0, 2)
    assert not (tmp_path / "out.csv").exists()
