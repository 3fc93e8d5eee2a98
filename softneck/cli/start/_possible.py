"""Checks before the steps: disk, compiler, keys of the robot file, sensor, feasible default requirements."""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import tomli_w

from softneck import tuning, verification
from softneck.core import OutputFileError, SettingsError, to_si, write_text
from softneck.robot import OPTIONAL_KEYS, ROBOT_KEYS, Robot
from softneck.signals import Recording, recorded_noise

from ..shared._console import note

# A project of 140 s of recording takes 7 MB, and as much again while files are replaced.
_LEAST_BYTES = 50_000_000


def require_disk(folder: Path) -> None:
    """Raise OutputFileError if the disk has no space for a project."""
    there = next(path for path in (folder, *folder.parents) if path.exists())
    free = shutil.disk_usage(there).free
    if free < _LEAST_BYTES:
        raise OutputFileError(
            f"{folder}: only {free / 1e6:.0f} MB are free there, a project takes up to {_LEAST_BYTES / 1e6:.0f} MB; "
            "free some, or choose another folder."
        )


def backend(*, packaged: bool = True) -> str:
    """Return the backend of the FMUs: "python", with a note, if no C compiler or library is found.

    `packaged`: whether the robot has 3 motors and 2 outputs; softneck contains libraries for these only.
    """
    from softneck.fmu.compiled import _library

    if _library.local_compiler() is not None or _library.have_zig() or (packaged and _library.packaged_library()):
        return "compiled"
    note("no C compiler was found: the FMUs are written with the Python backend and need softneck where they run")
    return "python"


def has_pytest() -> bool:
    """Return whether the closed loop's test can be run."""
    return find_spec("pytest") is not None


#: In the folder: requirements of `tune` without the infeasible defaults.
FILE = "requirements.toml"
_METRIC = re.compile(r"`([\w.]+)`.* cannot be: ")


def lacking(robot: Robot) -> list[str]:
    """Return the keys of motors and sensor that controller and observer need and the robot file lacks."""
    told = robot.as_dict()
    asked = [(table, key) for table in ("motors", "sensor") for key in ROBOT_KEYS[table] if key not in OPTIONAL_KEYS]
    return [f"{table}.{key}" for table, key in asked if key not in told.get(table, {})]


def require_known(robot: Robot) -> None:
    """Raise SettingsError with all keys that a robot file lacks."""
    if absent := lacking(robot):
        raise SettingsError(f"robot.toml: add {', '.join(absent)}; controller and observer need them.")


def possible(plants: tuple[str, ...]) -> str:
    """Write `FILE` without the defaults of `tune` that are infeasible for its `plants`; return the reasons, or ""."""
    refused = impossible(plants)
    if refused:
        said = "".join(f"# {why}\n" for why in refused.values())
        table = {"version": 1, "require": dict.fromkeys(refused, False)}
        head = f"# The defaults of `softneck tune` that cannot be are left out:\n{said}"
        write_text(FILE, head + tomli_w.dumps(table), force=True)
    return " ".join(refused.values())


def impossible(plants: tuple[str, ...]) -> dict[str, str]:
    """Return metric -> the reason that a default requirement of `tune` is infeasible."""
    things, refused = verification.named_plants(list(plants)), dict[str, str]()
    while True:
        task = tuning.task_of(things, {"require": dict.fromkeys(refused, False)}, 0)
        try:
            tuning.check_feasibility(task.asked, task.plant)
        except SettingsError as error:
            metric = _METRIC.match(str(error))
            if metric is None or metric[1] in refused:
                raise
            refused[metric[1]] = str(error)
        else:
            return refused


#: Value, certainty in %, reason.
Entry = tuple[float | list[float], int, str]
# Ends of motors' ranges that differ by less of the widest range are one end.
_ALIKE = 0.1


def propose_missing(file: Path, recordings: Sequence[Recording], *, motors: bool) -> list[str]:
    """Add what a robot file lacks of the sensor and, if `motors`, of the motors' limits; return the keys.

    Each value comes from the recordings and is marked as not sure.
    """
    robot = Robot.read(file)
    told = robot.as_dict()
    sensor = {
        "noise_std": (
            _digits(recorded_noise(recordings) / to_si(robot.outputs.unit)[0]),
            80,
            "white noise of the recordings, by their fourth differences",
        ),
        "delay_s": (0.0, 50, "recordings show only its sum with the plant's dead time; all of it counts as dead time"),
        "rate_hz": (_digits(1.0 / recordings[0].sample_time), 80, "one measurement a sample of the recordings"),
    }
    proposed: list[str] = []
    limits = _limits(robot, recordings) if motors else {}
    for name, found in (("motors", limits), ("sensor", sensor)):
        missing = {key: entry for key, entry in found.items() if key not in told.get(name, {})}
        if missing:
            _add(file, name, missing)
            said = ", ".join(f"{key} = {value}" for key, (value, *_) in missing.items())
            note(f"not sure: {file} lacks values of {name}: {said} from the recordings; correct them there")
        proposed += missing
    return proposed


def _add(file: Path, name: str, entries: dict[str, Entry]) -> None:
    """Add key -> (value, certainty in %, reason) to a table of a TOML file."""
    text = file.read_text(encoding="utf-8")
    table = tomllib.loads(text)
    lines = [f"# NOT SURE ({sure} %): {why}\n{key} = {value}\n" for key, (value, sure, why) in entries.items()]
    if name in table and f"\n[{name}]" in f"\n{text}":
        head, mark, rest = f"\n{text}".partition(f"\n[{name}]")
        first, end, after = rest.partition("\n")
        text = f"{head}{mark}{first}{end}{''.join(lines)}{after}".lstrip("\n")
    else:
        text = f"{text.rstrip()}\n\n[{name}]\n{''.join(lines)}"
    try:
        tomllib.loads(text)
    except ValueError:  # the table stood in another form, such as `sensor.delay_s = 0.1`
        values = table.get(name, {}) | {key: value for key, (value, *_) in entries.items()}
        text = tomli_w.dumps(table | {name: values})
    write_text(file, text, force=True)


def _limits(robot: Robot, recordings: Sequence[Recording]) -> dict[str, Entry]:
    """Return the range and the rate of the motors in the recordings, in the robot's unit."""
    unit = to_si(robot.motors.unit)[0]
    set_points = np.concatenate([recording.set_points for recording in recordings]) / unit
    lowest, highest = set_points.min(axis=0), set_points.max(axis=0)
    # Motors that were recorded in one range have it; a weaker one is not sent where it has never been.
    alike = np.ptp([lowest, highest], axis=1).max() <= _ALIKE * np.ptp([lowest, highest])
    rates = []
    for recording in recordings:
        moved = recording.motor_positions if recording.has_motor_positions else recording.set_points
        inside = np.diff(recording.run) == 0
        rates.append(float(np.nanmax(np.abs(np.diff(moved, axis=0))[inside], initial=0.0)) / recording.sample_time)
    measured = any(recording.has_motor_positions for recording in recordings)
    how = "fastest measured move" if measured else "largest step of a set-point in a sample"
    range_why = "range of the set-points in the recordings"
    return {
        "setpoint_min": (_digits(lowest.min()) if alike else [*map(_digits, lowest)], 70, range_why),
        "setpoint_max": (_digits(highest.max()) if alike else [*map(_digits, highest)], 70, range_why),
        "rate_limit": (_digits(max(rates) / unit), 50, f"{how} in the recordings"),
    }


def _digits(value: float) -> float:
    return float(f"{value:.3g}")
