"""A stand-in of each kind of log, of a virtual neck: how many go whole, and in which line the others end."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import softneck
from softneck.cli.start import _plan, _start
from softneck.cli.start._plan import Options
from softneck.core import Vector
from softneck.identification.selection import _auto
from softneck.plant import NeckParameters
from softneck.signals import SET_POINTS, guess_layout, import_log, prepare, signal
from softneck.signals.recording._channels import MOTOR_POSITIONS

from ...signals import log_writers as write
from ..conftest import Call
from .conftest import facts_of

Columns = Mapping[str, Vector]
#: [characters] Of the last line, whatever ends a run.
LINE = 160


@cache
def neck() -> dict[str, Vector]:
    """20 s of the paper's neck under `mixed`, as t, s1 to s3, x1 to x3, pitch and roll in SI units.

    It begins and ends at rest, as on hardware: sums of velocities begin at 0.
    """
    plant = softneck.VirtualNeck(NeckParameters.paper())
    r = softneck.record(prepare(signal("mixed", duration=20.0), ramp_s=1.0)[0], plant, seed=1)
    found = {"t": r.time}
    for short, names in (("s", SET_POINTS), ("x", MOTOR_POSITIONS)):
        found |= {f"{short}{j}": r.channels[name] for j, name in enumerate(names, 1)}
    return found | {"pitch": r.channels["pitch"], "roll": r.channels["roll"]}


def titled(*, degrees: bool = False, leave_out: str = "", s: str = "target_motor", x: str = "encoder") -> Columns:
    """Its columns under titles of a logger, without those that begin with a letter of `leave_out`."""
    names = {"t": "time", **{f"s{j}": f"{s}{j}" for j in (1, 2, 3)}, **{f"x{j}": f"{x}{j}" for j in (1, 2, 3)}}
    return {names.get(key, key): np.degrees(values) if degrees and key != "t" else values
            for key, values in neck().items() if key[0] not in leave_out}  # fmt: skip


def abroad(words: Mapping[str, str]) -> Columns:
    angles = {key: values if key == "t" else np.degrees(values) for key, values in neck().items()}
    return write.titled(angles, words)


def rates() -> Vector:
    return np.column_stack([np.gradient(neck()[f"x{j}"], neck()["t"]) for j in (1, 2, 3)])


def csv(path: Path, table: Mapping[str, Vector | float] | pd.DataFrame) -> None:
    pd.DataFrame(table).to_csv(path, index=False)


def bare(path: Path, *columns: Vector) -> None:
    """No titles, no clock, spaces around the commas."""
    np.savetxt(path, np.column_stack(columns), delimiter=" , ", fmt="%.8g")


def of(*names: str) -> list[Vector]:
    return [neck()[name] for name in names]


def quaternions(path: Path) -> None:
    q = np.array([write.from_angles(p, r) for p, r in zip(*of("pitch", "roll"), strict=True)])
    csv(path, {**titled(leave_out="xpr"), **{f"imu.orientation.{part}": q[:, k] for k, part in enumerate("wxyz")}})


def epoch_ms(path: Path) -> None:
    csv(path, {**titled(), "time": np.round(1.7637e12 + 1e3 * neck()["t"])})


def ros2(path: Path) -> None:
    names = {f"s{j}": f"cmd.position[{j - 1}]" for j in (1, 2, 3)}
    names |= {f"x{j}": f"state.position[{j - 1}]" for j in (1, 2, 3)}
    stamp = np.round(1e9 * neck()["t"])
    head = {"header.stamp.sec": 1_763_700_000 + stamp // 1e9, "header.stamp.nanosec": stamp % 1e9}
    csv(path, {**head, **{names.get(key, f"tilt.{key}"): values for key, values in neck().items() if key != "t"}})


def tilted(path: Path) -> None:
    """Inclination and orientation [deg], as the data's README turns them into pitch and roll."""
    x, y = np.tan(of("pitch", "roll"))
    angles = {"inclination_sensor": np.arctan(np.hypot(x, y)), "orientation_sensor": np.arctan2(x, -y) % (2.0 * np.pi)}
    csv(path, {**titled(degrees=True, leave_out="pr"), **{name: np.degrees(angle) for name, angle in angles.items()}})


def jittering(path: Path) -> None:
    """The time column says 10 ms where it is 20, and jitters; positions and velocities tell better."""
    v = rates()
    jitter = np.random.default_rng(2).uniform(-1.0, 1.0, len(v))
    csv(path, {**titled(), "time": 0.5 * neck()["t"] + 1e-3 * jitter, **{f"VelM{j}": v[:, j - 1] for j in (1, 2, 3)}})


def velocities(path: Path) -> None:
    v = rates()
    csv(path, {**titled(leave_out="sx"), **{f"VelM{j}": v[:, j - 1] for j in (1, 2, 3)}})


def commands(path: Path) -> None:
    """An arm's: angles, positions, velocities, a current, and commands of both axes in degrees before the motors."""
    _, s1, s2, s3 = of("t", "s1", "s2", "s3")
    theta, phi = np.degrees(s1 - 0.5 * (s2 + s3)), np.degrees(0.866 * (s2 - s3))
    current = 30.0 * np.random.default_rng(4).standard_normal(len(s1))
    x = np.column_stack(of("x1", "x2", "x3"))
    # Without co-contraction, which two commands do not ask for.
    x = x - x.mean(axis=1, keepdims=True)
    v = np.gradient(x, neck()["t"], axis=0)
    bare(path, np.zeros(len(s1)), *of("pitch", "roll"), x, v, current, theta, phi)


WHOLE: dict[str, Callable[[Path], None]] = {
    "degrees.csv": lambda p: csv(p, titled(degrees=True)),
    "german cp1252.csv": lambda p: write.write_text(p, abroad(write.GERMAN), encoding="cp1252"),
    "spanish utf-16.csv": lambda p: write.write_text(p, abroad(write.SPANISH), encoding="utf-16"),
    "tabs.txt": lambda p: write.write_text(p, titled(), sep="\t"),
    "sheet.xlsx": lambda p: write.write_sheet(p, titled()),
    "iso dates.csv": lambda p: write.write_dates(p, {**titled(), "t": neck()["t"]}, "iso"),
    "epoch ms.csv": epoch_ms,
    "ros 2 names.csv": ros2,
    "bag.mcap": lambda p: write.write_mcap(p, neck()),
    "quaternion.csv": quaternions,
    "matrices.mat": lambda p: write.write_mat(p, neck()),
    "structures.mat": lambda p: write.write_trials(p, [neck(), neck()]),
    "inclination and orientation.csv": tilted,
    "positions only.csv": lambda p: csv(p, titled(leave_out="s")),
    "velocities only.csv": velocities,
    "one axis.csv": lambda p: csv(p, titled(leave_out="r")),
    "estimated sample time.csv": jittering,
    "no titles.csv": lambda p: bare(p, *of("pitch", "roll", "x1", "x2", "x3"), rates()),
    "no titles, commands.csv": commands,
}


def held(path: Path) -> None:
    """Set-points in degrees that never change, and the neck on its way there."""
    csv(path, {**titled(degrees=True, leave_out="s"), **{f"target_motor{j}": 115.189 / j for j in (1, 2, 3)}})


def one_step(path: Path) -> None:
    """The first two seconds, and then rest at where they ended."""
    rows = np.minimum(np.arange(600), 100)
    csv(path, pd.DataFrame(titled()).iloc[rows].assign(time=0.02 * np.arange(600)))


ENDS: dict[str, tuple[Callable[[Path], None], str]] = {
    "constant set-points.csv": (held, "the motor set-points are constant; nothing can be identified."),
    "one step.csv": (one_step, "the rows held out stand still: pitch moves by 0.0 % of what it does in all rows."),
    "no motors.csv": (
        lambda p: csv(p, {**titled(leave_out="sx"), "target_pitch": 0.1, "target_roll": 0.1}),
        "no column is of a motor; record their set-points, positions or velocities too.",
    ),
    "no clock.csv": (
        lambda p: bare(p, *of("pitch", "roll", "s1", "s2", "s3")),
        "the sample time: no column rises by equal steps; say `--sample-time S`.",
    ),
    "no pitch of two.csv": (
        lambda p: csv(p, {**titled(leave_out="p"), "a": np.cos(neck()["t"]), "b": np.sin(3.0 * neck()["t"])}),
        "pitch: is it 'a', 'b'? Write `pitch = { column = 'a', unit = 'deg' }`.",
    ),
}


def to_the_observer(asked: Options) -> object:
    for step in _plan.steps(asked):
        if step.stage == "observer":
            return
        yield step


def ended(call: Call, name: str, write_log: Callable[[Path], None], *more: str) -> tuple[int, str]:
    """Write a log and start from it; return the exit code and the last line."""
    write_log(Path.cwd() / name)
    said = call("start", name, "-o", f"of {name}", "--yes", "--json", *more)
    if said.out:
        json.loads(said.out)
    return said.code, (said.err.splitlines() or [""])[-1]


# Degrees, factors and quaternions there and back, texts of 8 digits, and times that were resampled.
ROUNDING = 1e-4


def test_logs_of_each_kind_become_what_was_recorded(tmp_path: Path) -> None:
    lost = []
    for name, make in WHOLE.items():
        make(tmp_path / name)
        guess = guess_layout(tmp_path / name)
        assert guess.missing == (), name
        r = import_log(tmp_path / name, guess.layout).recording
        rows = len(neck()["t"])
        assert r.sample_time == pytest.approx(0.02, rel=2e-3), name  # of differences that stand for rates
        errors = [np.abs(r.channels[one][:rows] - neck()[one]).max() for one in r.robot.outputs.names]
        if max(errors) > ROUNDING or len(errors) + (name == "one axis.csv") != 2:
            lost.append(name)
    print(f"{len(WHOLE) - len(lost)} of {len(WHOLE)} kinds of logs are read whole")
    assert lost == []
    assert len(WHOLE) >= 16


@pytest.mark.slow
@pytest.mark.parametrize("name", WHOLE)
def test_logs_of_each_kind_go_as_far_as_models_and_a_controller(
    call: Call, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(_auto, "kinds_to_try", lambda: ("rls", "oe"))
    monkeypatch.setattr(_start, "steps", to_the_observer)
    monkeypatch.setattr(_start, "_facts", facts_of)
    code, last = ended(call, name, WHOLE[name])
    assert code == 0, last


@pytest.mark.slow
@pytest.mark.parametrize("name", ENDS)
def test_other_logs_end_in_one_short_line(call: Call, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setattr(_auto, "kinds_to_try", lambda: ("rls", "oe"))
    code, last = ended(call, name, ENDS[name][0])
    assert code in (1, 2)
    assert ENDS[name][1] in last
    assert len(last) <= LINE, len(last)


@pytest.mark.slow
@pytest.mark.nightly
def test_sixteen_kinds_and_more_go_whole(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    """All twelve steps of each; what is found wanting of a controller is a result."""
    monkeypatch.setattr(_auto, "kinds_to_try", lambda: ("rls", "oe"))
    found = {name: ended(call, name, make, "--kinds", "pi", "--budget", "4") for name, make in WHOLE.items()}
    whole = [name for name in found if Path(f"of {name}", "build", "report.html").is_file()]
    for name, (code, last) in found.items():
        print(f"{name:34} {'whole' if name in whole else last[:LINE]} (exit code {code})")
    print(f"{len(whole)} of {len(found)} go whole")
    assert len(whole) == len(found) >= 16
