"""A robot and a layout proposed from the column titles of a log of another robot than the neck."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from softneck.core import DataError, SettingsError, SoftneckError, did_you_mean, to_si
from softneck.robot import Robot

from ._column_titles import read_title
from ._layout import Column, Layout, Source, Term
from ._table_format import SniffResult, sniff
from .formats._text import DATE

# Words for motors; other columns that move are outputs.
_MOTOR_WORDS = {
    "motor", "motors", "setpoint", "set", "target", "command", "cmd", "input", "u", "pressure", "pump", "valve",
    "voltage", "volt", "chamber", "tendon", "cable", "servo", "actuator", "winch", "pwm", "duty", "control", "force",
    "torque", "heater",
}  # fmt: skip
# These move no winch: a log with one of them and without any channel of a neck is another robot's.
_NO_WINCH = {"pressure", "pump", "valve", "voltage", "volt", "chamber", "pwm", "duty", "heater"}
_OF_A_NECK = ("pitch", "roll", "inclination", "orientation", "pitch_reference", "roll_reference", "position",
              "set-point", "velocity")  # fmt: skip
_UNIT = re.compile(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$")
_WORD = re.compile(r"[a-z]+|\d+")


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Columns named by a user, by title or index."""

    motors: tuple[str, ...]
    outputs: tuple[str, ...]
    positions: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RobotGuess:
    """A robot, whose directions are to be identified, a layout of its log, and the reasons for each column."""

    robot: Robot
    layout: Layout
    lines: tuple[str, ...]

    @property
    def remark(self) -> str:
        """Return the remark for the layout file."""
        moved, outputs = (", ".join(part.names) for part in (self.robot.motors, self.robot.outputs))
        return f"NOT SURE: robot: {moved} move, {outputs} are outputs (80 % sure): by words in the titles"


def is_of_another_robot(path: str | Path) -> bool:
    """Return whether titles name pressures, pumps or voltages, and no motor or angle of a neck."""
    try:
        titles = [title for title in sniff(path, fewest=2).columns if isinstance(title, str)]
        spoken = any(_words(title) & _NO_WINCH for title in titles)
        return spoken and not any(read_title(t).role in _OF_A_NECK for t in titles) and bool(guess_robot(path))
    except SoftneckError:
        return False


def guess_robot(path: str | Path) -> RobotGuess:
    """Propose a robot by a log's titles: words for motors, and all other moving columns as outputs."""
    table = sniff(path, fewest=2)
    time, run, rest = _clock(table)
    motors = [title for title in rest if _words(title) & _MOTOR_WORDS]
    outputs = [title for title in rest if title not in motors]
    if not motors:
        raise DataError(
            f"{path}: no title names a motor, pressure, valve or set-point; it has {', '.join(rest) or 'none'}. "
            "Write a robot.toml (`softneck robot new`) and a layout."
        )
    if not outputs:
        raise DataError(f"{path}: beside {', '.join(motors)} no column moves that could be an output.")
    robot, units = _propose_robot(path, table, motors, outputs)
    layout = _layout(table, robot, motors, outputs, (time, run))
    unknown = [
        f"{title}: its unit is unknown here and taken as 1"
        for title in rest
        if _UNIT.search(title) and not _unit_of(table, title)
    ]
    lines = (
        *table.lines,
        *(f"{title}: its unit is unknown here and taken as 1" for title in unknown),
        f"motors [{units[0]}]: {', '.join(motors)}: because of words in their titles",
        f"outputs [{units[1]}]: {', '.join(outputs)}: because they move and have no other role",
        "directions: to be identified; write tendon angles or a matrix into the robot file if you know them",
    )
    return RobotGuess(robot, layout, lines)


def robot_of_columns(
    path: str | Path, named: NamedColumns, *, robot: Robot | None = None, sample_time: float | None = None
) -> RobotGuess:
    """Return robot and layout of a log whose columns the user named.

    `named`: its columns, in the order of the robot's channels. `robot`: None takes the neck if the columns fit it, else
    proposes a robot. `sample_time`: [s] of a log without a clock.
    """
    table = sniff(path, fewest=2)
    if not named.motors or not named.outputs:
        raise SettingsError("name the columns of motors and outputs, by --motor COL and --output COL.")
    every = (*named.motors, *named.outputs, *named.positions)
    if twice := next((title for title in every if every.count(title) > 1), None):
        raise SettingsError(f"column `{twice}` is named twice.")
    motors, outputs, positions = (
        [_column(path, table, title) for title in titles] for titles in (named.motors, named.outputs, named.positions)
    )
    taken = {*motors, *outputs, *positions}
    roles = {title: read_title(str(title)).role for title in table.columns if title not in taken}
    time, run = (next((title for title in roles if roles[title] == role), None) for role in ("time", "run"))
    if time is None and sample_time is None:
        raise DataError(f"{path}: no column is a time; say its sample time: --sample-time S.")
    if time is not None and sample_time is not None:
        raise SettingsError(
            f"{path}: has a clock, `{time}`; leave out --sample-time, or say --resample {sample_time:g}."
        )
    if robot is None:
        robot = Robot.preset() if _of_neck(table, motors, outputs) else _propose_robot(path, table, motors, outputs)[0]
    for count, needed, what in (
        (len(motors), len(robot.motors.names), "motor"),
        (len(outputs), len(robot.outputs.names), "output"),
        (len(positions), len(robot.motors.names) if positions else 0, "position"),
    ):
        if count != needed:
            raise DataError(f"{path}: robot {robot.label()} needs {needed} --{what}; {count} were given.")
    layout = _layout(table, robot, motors, outputs, (time, run))
    logged = {name: Source((Term(title),), _unit_of(table, title) or robot.motors.unit)
              for name, title in zip(robot.motor_positions, positions, strict=False)}  # fmt: skip
    layout = replace(layout, channels={**layout.channels, **logged}, sample_time=sample_time or layout.sample_time)
    return RobotGuess(robot, layout, table.lines)


def _column(path: str | Path, table: SniffResult, asked: str) -> Column:
    """Return a column by its title or index."""
    column: Column = int(asked) if asked.isdecimal() and asked not in table.columns else asked
    if column in table.words:
        raise DataError(f"{path}: column `{asked}` holds no numbers.")
    if column not in table.columns:
        known = [str(title) for title in table.columns]
        hint = did_you_mean(asked, known) or f"it has {', '.join(known)}."
        raise DataError(f"{path}: there is no column `{asked}`; {hint.rstrip()}")
    return column


def _of_neck(table: SniffResult, motors: Sequence[Column], outputs: Sequence[Column]) -> bool:
    """Return whether columns are three winches in angles, pitch and roll."""
    units = [_unit_of(table, column) or "rad" for column in motors]
    named = [read_title(str(column)).role for column in outputs]
    return len(motors) == 3 and named == ["pitch", "roll"] and all(to_si(unit)[1] == "rad" for unit in units)


def _propose_robot(
    path: str | Path, table: SniffResult, motors: Sequence[Column], outputs: Sequence[Column]
) -> tuple[Robot, list[str]]:
    """Propose a robot for such columns; return it with the units of its motors and outputs."""
    units = [_common_unit(path, table, titles) for titles in (motors, outputs)]
    content = {
        "name": re.sub(r"[^A-Za-z0-9_ ]+", "_", Path(path).stem),
        "motors": {"names": _names(motors), "unit": units[0]},
        "outputs": {"names": _names(outputs), "unit": units[1]},
        "directions": {"kind": "identified"},
    }
    try:
        robot = Robot.from_dict(content)
    except SettingsError as error:
        raise DataError(
            f"{path}: {str(error).removesuffix('.')}. Leave out columns by a layout of your own."
        ) from error
    return robot, units


def layout_for(path: str | Path, robot: Robot) -> Layout:
    """Return the layout of a log titled by the robot's channels, or by the names of its motors and outputs."""
    table = sniff(path, fewest=2)
    time, run, rest = _clock(table)
    found = {" ".join(_WORD.findall(_UNIT.sub("", title).lower())): title for title in rest}

    def title_of(*names: str) -> str:
        keys = [" ".join(_WORD.findall(name.lower())) for name in names]
        title = next((found[key] for key in keys if key in found), None)
        if title is None:
            raise DataError(f"{path}: no column is titled `{names[-1]}`; it has {', '.join(rest)}. Write a layout.")
        return title

    motors = [
        title_of(f"motor_setpoint_{j}", channel, name)
        for j, (channel, name) in enumerate(zip(robot.set_points, robot.motors.names, strict=True), start=1)
    ]
    outputs = [title_of(name) for name in robot.outputs.names]
    return _layout(table, robot, motors, outputs, (time, run))


def _clock(table: SniffResult) -> tuple[Column | None, Column | None, list[str]]:
    """Return the columns of time and run, and the titles of all others that move."""
    titles = [column for column in table.columns if isinstance(column, str)]
    if len(titles) < len(table.columns):
        raise DataError("the log has no titles; name its columns in a layout, and its robot in a robot.toml.")
    roles = {title: read_title(title).role for title in titles}
    time = next((title for title in titles if roles[title] == "time"), None)
    run = next((title for title in titles if roles[title] == "run"), None)
    moving = [t for t in titles if t not in (time, run) and np.nanmax(table.columns[t]) > np.nanmin(table.columns[t])]
    return time, run, moving


def _layout(
    table: SniffResult,
    robot: Robot,
    motors: Sequence[Column],
    outputs: Sequence[Column],
    clock: tuple[Column | None, Column | None],
) -> Layout:
    pairs = [*zip(robot.set_points, motors, strict=True), *zip(robot.outputs.names, outputs, strict=True)]
    default = dict.fromkeys(robot.set_points, robot.motors.unit) | dict.fromkeys(
        robot.outputs.names, robot.outputs.display_unit
    )
    time = None
    if clock[0] is not None:
        unit = DATE if clock[0] in table.dates else read_title(str(clock[0])).unit or "s"
        time = Source((Term(clock[0]),), unit)
    return replace(
        table.form,
        channels={name: Source((Term(title),), _unit_of(table, title) or default[name]) for name, title in pairs},
        time=time,
        sample_time=robot.sample_time_s if time is None else None,
        run=clock[1],
        robot=robot,
    )


def _common_unit(path: str | Path, table: SniffResult, titles: Sequence[Column]) -> str:
    """Return the common unit in the titles; 1 without any."""
    named = [_unit_of(table, title) or "1" for title in titles]
    if len({to_si(unit)[1] for unit in named}) > 1:
        raise DataError(
            f"{path}: {', '.join(map(str, titles))} are in {', '.join(named)}, and a robot has one unit for all of "
            "them; leave out columns by a layout of your own."
        )
    return named[0]


def _unit_of(table: SniffResult, title: Column) -> str | None:
    match = _UNIT.search(str(title))
    unit = match[1] if match else table.units.get(title)
    try:
        return None if unit is None else unit if to_si(unit) else None
    except DataError:
        return None


def _words(title: str) -> set[str]:
    return set(_WORD.findall(_UNIT.sub("", title).lower()))


def _names(titles: Sequence[Column]) -> list[str]:
    """Return titles as unique names of letters, digits and _ that start with a letter."""
    names: list[str] = []
    for number, title in enumerate(titles):
        name = re.sub(r"\W+", "_", _UNIT.sub("", str(title)).strip(), flags=re.ASCII).strip("_") or f"c{number + 1}"
        name = name if name[0].isalpha() else f"c_{name}"
        names.append(name if name not in names else f"{name}_{number + 1}")
    return names
