"""A robot and a layout of a log of any robot, from the roles of its columns."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from softneck.core import DataError, SettingsError, SoftneckError, did_you_mean, to_si
from softneck.robot import MOST_MOTORS, Robot

from ..recording._channels import MOTOR_POSITIONS, MOTOR_VELOCITIES, SET_POINTS, parse_column, si_unit
from ._column_titles import ambiguity, name_of
from ._draft import SURE, Doubt, Draft
from ._guess import guess_clock
from ._guess_names import by_names
from ._guess_units import Unit, clock_unit, unread_clocks
from ._layout import Column, Layout, Source, Term
from ._roles import NOTHING_NEW, Roles, find_roles, may_be_motor, names_a_place
from ._table_format import MIN_COLUMNS, SniffResult, sniff
from .formats._text import DATE

if TYPE_CHECKING:
    import pandas as pd

_OF_A_NECK = ("pitch", "roll", "inclination", "orientation")
_UNIT = re.compile(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$")
_WORD = re.compile(r"[a-z]+|\d+")
_RANGE = re.compile(r"(\d+)-(\d+)")


@dataclass(frozen=True, slots=True)
class NamedColumns:
    """Columns named by a user, by title, index or, without titles, a range of indices such as `0-3`."""

    motors: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    positions: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RobotGuess:
    """A robot, whose directions are to be identified, a layout of its log, the reasons for each column, and doubts."""

    robot: Robot
    layout: Layout
    lines: tuple[str, ...]
    doubts: tuple[Doubt, ...] = ()


def has_column(path: str | Path, title: str) -> bool:
    """Return whether a column of a log has this title."""
    return title in sniff(path, fewest=2).columns


def is_of_another_robot(path: str | Path) -> bool:
    """Return whether a log names no three motors of a neck, and a robot can be proposed from its titles."""
    try:
        table = sniff(path, fewest=2)
        draft = Draft(table)
        with np.errstate(all="ignore"):
            by_names(draft)
        motors = any(draft.has(names) for names in (SET_POINTS, MOTOR_POSITIONS, MOTOR_VELOCITIES))
        angles = draft.quaternion is not None or any(name in draft.picks for name in _OF_A_NECK)
        if motors and angles:
            return False
        if len(table.columns) < MIN_COLUMNS:
            return True
        roles = find_roles(table, {})
        if len(roles.motors) > MOST_MOTORS:
            return True
        # Three motors are a neck's, unless titles name other outputs than angles.
        if motors and not any(names_a_place(table, column) for column in roles.outputs):
            return False
        return bool(guess_robot(path, sample_time=1.0 if roles.time is None else None))
    except SoftneckError:
        return False


def guess_robot(
    path: str | Path, named: NamedColumns | None = None, *, robot: Robot | None = None, sample_time: float | None = None
) -> RobotGuess:
    """Propose the robot and the layout of a log; what is not named follows from titles, units and motion.

    Args:
        named: columns that the user named, in the order of the robot's channels.
        robot: of the log; None takes the neck if the named columns fit it, else proposes a robot.
        sample_time: of a log without a clock [s].

    Raises:
        DataError: no motors or outputs were found; the message names the columns of the best candidates.
        SettingsError: names that contradict each other, or a sample time of a log that has a clock.
    """
    table = sniff(path, fewest=2)
    given = _given(path, table, named or NamedColumns())
    roles, clock = find_roles(table, given), None
    if sample_time is None:
        clock = guess_clock(table, [column for columns in given.values() for column in columns])
        if clock is not None and clock[0].time is not None:
            roles = find_roles(table, {**given, "time": [term.column for term in clock[0].time.terms]})
    if not roles.motors or not roles.outputs:
        what = "motor" if not roles.motors else "output"
        still = [f"{name} is {why}" for name, why in roles.left_out.items() if why.startswith("constant")]
        beside = f" ({'; '.join(still)})" if still else ""
        line = columns_line(path, table, roles)
        raise DataError(f"{path}: no column was recognised as {what}{beside}. Name them: {line}")
    if roles.time is None and sample_time is None and clock is None:
        raise DataError(f"{path}: no column is a time; say its sample time: --sample-time S.")
    whole = bool(given["motors"] and given["outputs"])
    if robot is None:
        neck = whole and _of_neck(table, roles)
        robot = Robot.preset() if neck else _propose_robot(path, table, roles)
    _require_counts(path, robot, roles)
    channels = [
        *zip(robot.set_points, roles.motors, strict=True),
        *zip(robot.outputs.names, roles.outputs, strict=True),
    ]
    channels += zip(robot.motor_positions, roles.positions, strict=False)  # of no motor or of all
    layout, of_clock = _layout(path, table, robot, channels, roles, sample_time)
    if clock is not None:
        layout = replace(clock[0], channels=layout.channels, run=roles.run, robot=robot, merge=layout.merge)
        of_clock = clock[2]
    taken = [f"motors: {_list(roles.motors)}{f': {roles.why}' if roles.why else ''}"]
    taken += [f"measured positions: {_list(roles.positions)}"] if roles.positions else []
    taken += [f"outputs: {_list(roles.outputs)}"]
    taken += [] if clock is None else clock[1]
    doubts = [*_unit_doubts(table, channels), *of_clock]
    if not whole:
        why = f"{_list(roles.motors)} move, {_list(roles.outputs)} are outputs"
        doubts.insert(0, Doubt("robot", robot.set_points[:1], why, 0.8, "by titles"))
    # Lines of a clock that was guessed say what is doubted of it.
    said = [f"not sure: {doubt}" for doubt in doubts[not whole :] if clock is None or doubt not in of_clock]
    return RobotGuess(robot, layout, (*table.lines, *taken, *said, *roles.lines), tuple(doubts))


def _unit_doubts(table: SniffResult, channels: Sequence[tuple[str, Column]]) -> list[Doubt]:
    """Return a doubt for each unit of the titles that is unknown or ambiguous, with the channels that have it."""
    found: dict[str, Doubt] = {}
    for name, column in channels:
        title = table.title(column)
        why = ambiguity(title, table.columns) if title.unit else "it is unknown here"
        if title.written and why:
            before = found.get(title.written, Doubt(f"unit `{title.written}`", (), title.unit or "1", 0.6, why))
            found[title.written] = replace(before, channels=(*before.channels, name))
    return list(found.values())


def describe_columns(
    path: str | Path, named: NamedColumns | None = None
) -> tuple[pd.DataFrame, dict[Column, tuple[str, str]]]:
    """Return a log's table, and of each column the unit of its title ("" for none) and what it seems to be.

    `named`: columns that the user named; a role with a name that is not there is found without names.
    """
    table, given = sniff(path, fewest=2), dict[str, list[Column]]()
    for role, titles in asdict(named or NamedColumns()).items():
        with suppress(DataError):
            given[role] = [column for title in titles for column in _columns(path, table, title)]
    roles = find_roles(table, given)
    said: dict[Column, str] = {**dict.fromkeys(table.words, "words"), **roles.left_out}
    for what, columns in (("set-point of motor", roles.motors), ("position of motor", roles.positions),
                          ("output", roles.outputs)):  # fmt: skip
        said |= {column: f"{what} {k}" for k, column in enumerate(columns, start=1)}
    said |= {column: what for column, what in ((roles.time, "time"), (roles.run, "run number")) if column is not None}
    return table.frame, {column: (table.title(column).unit or "", what) for column, what in said.items()}


def columns_line(path: str | Path, table: SniffResult | None = None, roles: Roles | None = None) -> str:
    """Return the command that names a log's columns, with the best candidates filled in."""
    table = sniff(path, fewest=2) if table is None else table
    roles = find_roles(table, {}) if roles is None else roles
    spent = [name for name, why in roles.left_out.items() if why.startswith(NOTHING_NEW)]
    moving = [name for name in table.columns if name not in (roles.time, roles.run, *spent)]
    motors, outputs = list(roles.motors), list(roles.outputs) if roles.motors else []
    motors = motors or _first_block(table, [name for name in moving if may_be_motor(table, name)])
    free = [name for name in moving if name not in (*motors, *roles.positions)]
    outputs = outputs or [name for name in free if name not in roles.left_out or not roles.motors][:4]
    words = ["softneck", "import", str(path)]
    for option, columns in (
        ("--motor", motors or ["COL"]), ("--position", roles.positions), ("--output", outputs or ["COL"])
    ):  # fmt: skip
        words += [word for text in _ranges(columns) for word in (option, text)]
    clock = roles.time is not None or guess_clock(table, [*motors, *outputs]) is not None
    words += [] if clock else ["--sample-time", "S"]
    return f"`{shlex.join(words)} -o rec.csv`; for its limits see `softneck robot new`"


def _ranges(columns: Sequence[Column]) -> list[str]:
    """Return columns as options name them; successive indices as one range."""
    if all(isinstance(one, int) for one in columns) and len(columns) > 1:
        first, last = int(columns[0]), int(columns[-1])
        if list(columns) == list(range(first, last + 1)):
            return [f"{first}-{last}"]
    return [str(one) for one in columns]


def _first_block(table: SniffResult, columns: Sequence[Column]) -> list[Column]:
    """Return the first columns whose motions are of one size, as a log's inputs stand before its outputs."""
    found: list[Column] = []
    for column in columns[:-1]:
        spans = [float(np.nanstd(table.columns[one])) for one in (*found, column)]
        if max(spans) > 5.0 * min(spans):
            break
        found.append(column)
    return found


def _list(columns: Sequence[Column]) -> str:
    return ", ".join(map(str, columns))


def _given(path: str | Path, table: SniffResult, named: NamedColumns) -> dict[str, list[Column]]:
    """Return the columns that were named, by role."""
    found: dict[str, list[Column]] = {}
    for role, titles in (("motors", named.motors), ("outputs", named.outputs), ("positions", named.positions)):
        found[role] = [column for title in titles for column in _columns(path, table, title)]
    every = [column for columns in found.values() for column in columns]
    if twice := next((column for column in every if every.count(column) > 1), None):
        raise SettingsError(f"column `{twice}` is named twice.")
    return found


def _columns(path: str | Path, table: SniffResult, asked: str) -> list[Column]:
    """Return a column by its title or index, or those of a range of indices."""
    known = [*table.columns, *table.words]
    span = _RANGE.fullmatch(asked)
    if span is not None and asked not in known:
        return [_column(path, table, str(k)) for k in range(int(span[1]), int(span[2]) + 1)]
    return [_column(path, table, asked)]


def _column(path: str | Path, table: SniffResult, asked: str) -> Column:
    column: Column = int(asked) if asked.isdecimal() and asked not in table.columns else asked
    if isinstance(column, int) and column not in table.columns and column < len(table.frame.columns):
        column = table.frame.columns[column]  # an index of a log with titles
    if column in table.words:
        raise DataError(f"{path}: column `{asked}` holds no numbers.")
    if column not in table.columns:
        known = [str(title) for title in table.columns]
        hint = did_you_mean(asked, known) or f"it has {', '.join(known)}."
        raise DataError(f"{path}: there is no column `{asked}`; {hint.strip()}")
    return column


def _require_counts(path: str | Path, robot: Robot, roles: Roles) -> None:
    motors = len(robot.motors.names)
    for count, needed, what in (
        (len(roles.motors), motors, "motor"),
        (len(roles.outputs), len(robot.outputs.names), "output"),
        (len(roles.positions), motors if roles.positions else 0, "position"),
    ):
        if count != needed:
            raise DataError(f"{path}: robot {robot.label()} needs {needed} --{what}; {count} were given.")


def _of_neck(table: SniffResult, roles: Roles) -> bool:
    """Return whether columns are three winches in angles, pitch and roll."""
    units = [table.title(column).unit or "rad" for column in roles.motors]
    titled = [table.title(column).role for column in roles.outputs]
    return len(units) == 3 and titled == ["pitch", "roll"] and all(to_si(unit)[1] == "rad" for unit in units)


def _propose_robot(path: str | Path, table: SniffResult, roles: Roles) -> Robot:
    content = {
        "name": re.sub(r"[^A-Za-z0-9_ ]+", "_", Path(path).stem),
        "motors": {"names": _names(roles.motors), "unit": _common_unit(path, table, roles.motors)},
        "outputs": {"names": _names(roles.outputs), "unit": _common_unit(path, table, roles.outputs)},
        "directions": {"kind": "identified"},
    }
    try:
        return Robot.from_dict(content)
    except SettingsError as error:
        raise DataError(f"{path}: {str(error).removesuffix('.')}. Name fewer: --motor COL, --output COL.") from error


def layout_for(path: str | Path, robot: Robot, *, sample_time: float | None = None) -> RobotGuess:
    """Return the layout of a log titled by the channels of its robot, or by the names of its motors and outputs.

    `sample_time`: of a log without a clock [s].
    """
    table = sniff(path, fewest=2)
    roles = find_roles(table, {})
    rest = [title for title in table.columns if isinstance(title, str) and title not in (roles.time, roles.run)]
    if not rest:
        raise DataError(f"{path}: has no titles; name its columns: {columns_line(path, table, roles)}")
    found = {" ".join(_WORD.findall(name_of(title).lower())): title for title in rest}
    found |= {" ".join(_WORD.findall(_UNIT.sub("", title).lower())): title for title in rest}

    def title_of(*names: str) -> str:
        keys = [" ".join(_WORD.findall(name.lower())) for name in names]
        title = next((found[key] for key in keys if key in found), None)
        if title is None:
            raise DataError(
                f"{path}: no column is titled `{names[-1]}`; it has {', '.join(rest)}. Name its columns by --motor COL "
                "and --output COL."
            )
        return title

    channels = [
        (channel, title_of(f"motor_setpoint_{j}", channel, name))
        for j, (channel, name) in enumerate(zip(robot.set_points, robot.motors.names, strict=True), start=1)
    ]
    channels += [(name, title_of(name)) for name in robot.outputs.names]
    channels += _own_channels(rest, robot, dict(channels))
    layout, clock = _layout(path, table, robot, channels, roles, sample_time)
    doubts = (*_unit_doubts(table, channels), *clock)
    return RobotGuess(robot, layout, tuple(f"not sure: {doubt}" for doubt in doubts), doubts)


def _own_channels(titles: Sequence[str], robot: Robot, taken: dict[str, str]) -> list[tuple[str, str]]:
    """Return the other channels of a recording of `robot`, each with its title."""
    found: dict[str, str] = {}
    for title in titles:
        try:
            channel, _ = parse_column(title, robot)
        except SoftneckError:
            continue
        if channel not in taken and title not in taken.values():
            found.setdefault(channel, title)
    return list(found.items())


def _layout(
    path: str | Path, table: SniffResult, robot: Robot, channels: Sequence[tuple[str, Column]], roles: Roles,
    sample_time: float | None,
) -> tuple[Layout, list[Doubt]]:  # fmt: skip
    """Return the layout of a log, and what is doubted of its clock; `sample_time` is of one without [s]."""
    if roles.time is not None and sample_time is not None:
        raise SettingsError(
            f"{path}: has a clock, `{roles.time}`; leave out --sample-time, or say --resample {sample_time:g}."
        )
    default = dict.fromkeys(robot.outputs.names, robot.outputs.display_unit)
    sources = {name: Source((Term(title),), table.title(title).unit or default.get(name, robot.motors.unit))
               for name, title in channels}  # fmt: skip
    for name, title in channels:
        if to_si(sources[name].unit)[1] != si_unit(name, robot):
            raise DataError(
                f"{path}: `{title}` is in {sources[name].unit}; `{name}` of robot {robot.label()} needs a unit of "
                f"{si_unit(name, robot)}: take another column, or correct the title or the robot file."
            )
    time, doubts = None, []
    if roles.time is not None:
        named, dates = table.title(roles.time), roles.time in table.dates
        titled = named.unit if named.quantity == "s" else None
        unit = Unit(DATE, 1.0, "") if dates else clock_unit(table.columns[roles.time], titled, neck=False)
        time = Source((Term(roles.time, unit.factor),), unit.name)
        doubts = [Doubt("clock", ("time",), unit.name, unit.confidence, unit.why)] if unit.confidence < SURE else []
    elif sample_time is not None:
        doubts = unread_clocks(table, sample_time)
    layout = replace(
        table.form, channels=sources, time=time, run=roles.run, robot=robot,
        sample_time=(sample_time or robot.sample_time_s) if time is None else None,
        merge=table.form.merge and any(table.lacks(title) for name, title in channels if name in robot.set_points),
    )  # fmt: skip
    return layout, doubts


def _common_unit(path: str | Path, table: SniffResult, titles: Sequence[Column]) -> str:
    """Return the common unit in the titles; 1 without any."""
    units = [table.title(title).unit or "1" for title in titles]
    if len({to_si(unit)[1] for unit in units}) > 1:
        raise DataError(
            f"{path}: {_list(titles)} are in {', '.join(units)}, and a robot has one unit for all of them; name those "
            "of one unit by --motor COL and --output COL."
        )
    return units[0]


def _names(titles: Sequence[Column]) -> list[str]:
    """Return titles as unique names of letters, digits and _ that start with a letter."""
    names: list[str] = []
    for number, title in enumerate(titles):
        name = name_of(str(title)) or f"c{number + 1}"
        name = name if name[0].isalpha() else f"c_{name}"
        names.append(name if name not in names else f"{name}_{number + 1}")
    return names
