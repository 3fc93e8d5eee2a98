"""The layout of an unknown log: a TOML file that maps columns to channels."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, ReprMixin, SettingsError, SoftneckError, require_file, settings_text, to_si
from softneck.robot import Robot

from ..recording._channels import NECK, known_channels, si_unit
from ..recording._files import WHITESPACE, TextForm
from .formats._text import DATE, ENCODINGS

Column = str | int
DUPLICATES = ("first", "last")
#: Keys of [file] and attributes of `Layout`, in the order of the file.
FILE_KEYS = ("variable", "sheet", "encoding", "skip", "unit_row", "header", "delimiter", "decimal", "rows")
_TIME_KEYS = {"column", "terms", "unit", "factor", "sample_time_s", "new_run_at_restart", "duplicates", "run_column",
              "merge"}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Term:
    """One column times a factor."""

    column: Column
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """Source of a channel: a sum of terms in `unit`, times `sign`; `integrate` takes its integral over time.

    The unit of an integrated source is that of the rate; each run starts at 0.
    """

    terms: tuple[Term, ...]
    unit: str
    sign: float = 1.0
    integrate: bool = False


#: Sensor axes about which pitch and roll may rotate.
AXES = ("x", "-x", "y", "-y")


@dataclass(frozen=True, slots=True)
class Quaternion:
    """Columns of a sensor's orientation, and the axes of pitch and roll."""

    w: Column
    x: Column
    y: Column
    z: Column
    pitch: str = "y"
    roll: str = "x"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Layout(ReprMixin):
    """How to read a log: its format, and the source and unit of each channel.

    Attributes:
        inclination, orientation: sources of a tilt vector, instead of pitch and roll.
        quaternion: of the sensor, instead of pitch and roll.
        time: the time column's source, or None; its unit may be `date`.
        merge: rows are messages of several clocks: keep those of the outputs, set-points hold their last value.
        sample_time: true sample time [s]; None takes it from the time column.
        estimate: estimate the sample time from positions and velocities.
        new_run_at_restart: a time that goes back starts a new run.
        duplicates: row to keep of one time stamp, `first` or `last`; None refuses duplicates.
        run: the column of run numbers, or None.
        variable: the matrix of a MAT file; None takes its vectors by name.
        sheet: of a spreadsheet; None takes the largest.
        header: whether the first line names the columns.
        delimiter: between cells, one character or `whitespace`.
        decimal: the decimal mark, `.` or `,`.
        unit_row: whether a line of units follows the names; it is skipped.
        rows: first and last row (not included).
    """

    channels: Mapping[str, Source]
    inclination: Source | None = None
    orientation: Source | None = None
    quaternion: Quaternion | None = None
    time: Source | None = None
    merge: bool = False
    sample_time: float | None = None
    estimate: bool = False
    new_run_at_restart: bool = False
    duplicates: str | None = None
    run: Column | None = None
    variable: str | None = None
    sheet: str | None = None
    encoding: str = "utf-8"
    header: bool = True
    delimiter: str = ","
    decimal: str = "."
    skip: int = 0
    unit_row: bool = False
    rows: tuple[int, int] | None = None
    robot: Robot = NECK

    @property
    def form(self) -> TextForm:
        """Return the format of a text table."""
        return TextForm(self.header, self.delimiter, self.decimal, self.skip, self.unit_row, self.encoding)


def read_layout(path: str | Path, *, robot: Robot = NECK) -> Layout:
    """Read the layout file (docs, "Layouts") of a log of `robot`.

    Raises:
        FileFormatError: no such file or no TOML.
        SettingsError: an unknown key, channel or unit.
    """
    source = Path(path)
    require_file(source)
    try:
        text = settings_text(source)
    except (UnicodeDecodeError, OSError, ValueError) as error:  # ValueError: a null character in the path
        raise FileFormatError(f"{source}: is not a TOML file ({error}).") from error
    try:
        return parse_layout(text, robot=robot)
    except FileFormatError as error:
        raise FileFormatError(f"{source}: {error}") from error
    except SoftneckError as error:
        raise SettingsError(f"{source}: {error}") from error


def parse_layout(text: str, *, robot: Robot = NECK) -> Layout:
    """Parse the TOML text of a layout for `robot`; the inverse of `layout_toml`.

    Raises:
        FileFormatError: no TOML.
        SettingsError: an unknown key, channel or unit.
    """
    try:
        table = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:  # int() refuses thousands of digits
        raise FileFormatError(f"is not a TOML file ({error}).") from error
    try:
        return _layout(table, robot)
    except SoftneckError:
        raise
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SettingsError(f"a value is of the wrong type ({error}).") from error


def _layout(table: dict[str, Any], robot: Robot) -> Layout:
    _known_keys(table, {"file", "time", "channels", "tilt", "quaternion"}, "the layout")
    file, time = table.get("file", {}), table.get("time", {})
    tilt = table.get("tilt", {})
    _known_keys(file, {*FILE_KEYS}, "[file]")
    _known_keys(time, _TIME_KEYS, "[time]")
    _known_keys(tilt, {"inclination", "orientation"}, "[tilt]")
    quaternion = table.get("quaternion", {})
    for name, given in (("tilt", tilt), ("quaternion", quaternion)):
        if given and (robot.outputs.names != ("pitch", "roll") or to_si(robot.outputs.unit)[1] != "rad"):
            raise SettingsError(f"[{name}] gives pitch and roll, which are not the outputs of robot {robot.label()}.")
    if len(tilt) == 1:
        raise SettingsError("[tilt] needs both `inclination` and `orientation`.")
    if type(time.get("run_column", "")) not in (str, int):
        raise SettingsError(f"[time] run_column must be a name or an index; got {time['run_column']!r}.")
    rows = file.get("rows")
    if rows is not None and not (
        isinstance(rows, list) and [type(row) for row in rows] == [int, int] and 0 <= rows[0] < rows[1]
    ):
        raise SettingsError(f"[file] rows must be [first, last] with 0 <= first < last; got {rows}.")
    if file.get("unit_row") is True and file.get("header") is False:
        raise SettingsError("[file] unit_row is the line below the names; a file without `header` has none.")
    return Layout(
        channels={
            robot.own(name): _channel_source(name, entry, robot) for name, entry in table.get("channels", {}).items()
        },
        inclination=_source(tilt["inclination"], "rad", "[tilt] inclination") if tilt else None,
        orientation=_source(tilt["orientation"], "rad", "[tilt] orientation") if tilt else None,
        quaternion=_quaternion(quaternion) if quaternion else None,
        time=_time_source(time),
        merge=_flag(time, "merge", default=False),
        sample_time=None if time.get("sample_time_s") == "estimate" else _positive(time.get("sample_time_s")),
        estimate=time.get("sample_time_s") == "estimate",
        new_run_at_restart=_flag(time, "new_run_at_restart", default=False),
        duplicates=_choice(time, "duplicates", DUPLICATES, None),
        run=time.get("run_column"),
        variable=str(file["variable"]) if "variable" in file else None,
        sheet=str(file["sheet"]) if "sheet" in file else None,
        encoding=_choice(file, "encoding", ENCODINGS, "utf-8") or "utf-8",
        header=_flag(file, "header", default=True),
        delimiter=_delimiter(file.get("delimiter", ",")),
        decimal=_choice(file, "decimal", (".", ","), ".") or ".",
        skip=_skip(file.get("skip", 0)),
        unit_row=_flag(file, "unit_row", default=False),
        rows=(rows[0], rows[1]) if rows is not None else None,
        robot=robot,
    )


def _time_source(time: dict[str, Any]) -> Source | None:
    if not time.keys() & {"column", "terms"}:
        return None
    entry = {"unit": "s", **_only(time, "column", "terms", "unit", "factor")}
    if entry["unit"] != DATE:
        return _source(entry, "s", "[time]")
    if type(entry.get("column")) not in (str, int) or "factor" in entry:
        raise SettingsError("[time] of unit `date` needs one `column`, without a factor.")
    return Source((Term(entry["column"]),), DATE)


def _quaternion(entry: dict[str, Any]) -> Quaternion:
    _known_keys(entry, {"w", "x", "y", "z", "pitch", "roll"}, "[quaternion]")
    parts = [entry.get(name) for name in "wxyz"]
    if any(type(part) not in (str, int) for part in parts):
        raise SettingsError("[quaternion] needs the columns `w`, `x`, `y` and `z`: names, or indices from 0.")
    pitch, roll = _choice(entry, "pitch", AXES, "y") or "y", _choice(entry, "roll", AXES, "x") or "x"
    if pitch[-1] == roll[-1]:
        raise SettingsError(f"[quaternion] pitch and roll are turns about two axes; got `{pitch}` and `{roll}`.")
    return Quaternion(parts[0], parts[1], parts[2], parts[3], pitch, roll)  # pyright: ignore[reportArgumentType]


def _channel_source(name: str, entry: Any, robot: Robot) -> Source:
    name, known = robot.own(name), known_channels(robot)
    if name not in known or name == "time":
        raise SettingsError(f"[channels.{name}]: not a channel of a recording; known: {', '.join(known)}.")
    return _source(entry, si_unit(name, robot), f"[channels.{name}]")


def _source(entry: Any, quantity: str, where: str) -> Source:
    if not isinstance(entry, dict):
        raise SettingsError(f"{where} must be a table with `column` (or `terms`) and `unit`.")
    _known_keys(entry, {"column", "terms", "unit", "sign", "factor", "integrate"}, where)
    terms = entry.get("terms", [_only(entry, "column", "factor")])
    for term in terms:
        if not isinstance(term, dict) or type(term.get("column")) not in (str, int):
            raise SettingsError(f"{where} needs `column`: a name, or an index from 0 for a file without header.")
        _known_keys(term, {"column", "factor"}, where)
    if "unit" not in entry:
        raise SettingsError(f"{where} names no unit.")
    integrate = _flag(entry, "integrate", default=False)
    if to_si(entry["unit"])[1] != (f"{quantity}/s" if integrate else quantity):
        hint = f"; a rate in {quantity}/s is integrated to {quantity}" if integrate else f"; its SI unit is {quantity}"
        raise SettingsError(f"{where} cannot be in `{entry['unit']}`{hint}.")
    parsed = tuple(Term(term["column"], _factor(term.get("factor", 1.0), where)) for term in terms)
    if entry.get("sign", 1) not in (1, -1) or isinstance(entry.get("sign"), bool):
        raise SettingsError(f"{where}: sign must be 1 or -1; got {entry['sign']!r}. Scale it by `factor`.")
    return Source(parsed, entry["unit"], float(entry.get("sign", 1)), integrate)


def _factor(value: Any, where: str) -> float:
    number = float(value)
    if not math.isfinite(number) or number == 0.0:
        raise SettingsError(f"{where}: a factor must be a finite number other than 0; got {value}.")
    return number


def _only(entry: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: entry[key] for key in keys if key in entry}


def _positive(value: Any) -> float | None:
    if value is None:
        return None
    if not isinstance(value, int | float) or not 0 < value < float("inf"):
        raise SettingsError(f"[time] sample_time_s must be a positive number or `estimate`; got {value!r}.")
    return float(value)


def _known_keys(table: Any, known: set[str], where: str) -> None:
    if not isinstance(table, dict):
        raise SettingsError(f"{where} must be a table.")
    unknown = sorted(set(table) - known)
    if unknown:
        raise SettingsError(f"{where} has the unknown key `{unknown[0]}`; known: {', '.join(sorted(known))}.")


def _flag(table: dict[str, Any], key: str, *, default: bool) -> bool:
    value = table.get(key, default)
    if not isinstance(value, bool):
        raise SettingsError(f"`{key}` must be true or false; got {value!r}.")
    return value


def _choice(table: dict[str, Any], key: str, allowed: tuple[str, ...], default: str | None) -> str | None:
    value = table.get(key, default)
    if value is not default and value not in allowed:
        raise SettingsError(f"`{key}` must be one of {', '.join(allowed)}; got {value!r}.")
    return value


def _skip(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 10**6:
        raise SettingsError(f"[file] skip must be a number of lines; got {value!r}.")
    return value


def _delimiter(value: Any) -> str:
    # pandas would take more characters for a regular expression, and some of those never end.
    if value != WHITESPACE and not (isinstance(value, str) and len(value) == 1):
        raise SettingsError(f"[file] delimiter must be one character or `{WHITESPACE}`; got {value!r}.")
    return value


def layout_toml(layout: Layout, *, remarks: Mapping[str, str] | None = None, open_ends: Sequence[str] = ()) -> str:
    """Return a layout as TOML text; the inverse of `parse_layout`.

    Args:
        remarks: channel (or `time`, `file`, `inclination`, `orientation`) -> comment.
        open_ends: comments for the end: entries to fill in.

    Raises:
        SettingsError: the time is a sum of columns or has a sign, which a file cannot express.
    """
    why = remarks or {}
    blocks = [_file(layout, why), _time(layout, why)]
    simple = {name: source for name, source in layout.channels.items() if len(source.terms) == 1}
    # An empty [channels] is written too: it distinguishes a layout from other TOML files.
    lines = ["[channels]"]
    for name, source in simple.items():
        lines += [*_comment(why.get(name)), f"{name} = {_inline(source)}"]
    blocks.append(lines)
    for name, source in layout.channels.items():
        if name not in simple:
            blocks.append([*_comment(why.get(name)), f"[channels.{name}]", *_entries(source)])
    if layout.inclination is not None and layout.orientation is not None:
        tilt = ["[tilt]"]
        for name, source in (("inclination", layout.inclination), ("orientation", layout.orientation)):
            tilt += [*_comment(why.get(name)), f"{name} = {_inline(source)}"]
        blocks.append(tilt)
    if layout.quaternion is not None:
        axes = [f"{name} = {_text(getattr(layout.quaternion, name))}" for name in ("w", "x", "y", "z", "pitch", "roll")]
        blocks.append([*_comment(why.get("quaternion")), "[quaternion]", *axes])
    blocks.append([line for end in open_ends for line in _comment(end)])
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def _file(layout: Layout, why: Mapping[str, str]) -> list[str]:
    plain = Layout(channels={})
    changed = {key: getattr(layout, key) for key in FILE_KEYS if getattr(layout, key) != getattr(plain, key)}
    lines = [f"{key} = {_text(value)}" for key, value in changed.items()]
    return ["[file]", *_comment(why.get("file")), *lines] if lines else []


def _time(layout: Layout, why: Mapping[str, str]) -> list[str]:
    lines = _comment(why.get("time"))
    if layout.time is not None:
        if not layout.time.terms or layout.time.sign != 1.0:
            raise SettingsError("the time of a layout is one column without a sign; use its factor.")
        lines += _entries(layout.time)
    lines += _comment(why.get("sample_time"))
    if layout.estimate:
        lines.append('sample_time_s = "estimate"')
    elif layout.sample_time is not None:
        lines.append(f"sample_time_s = {layout.sample_time!r}")
    rest = {"new_run_at_restart": layout.new_run_at_restart, "duplicates": layout.duplicates, "run_column": layout.run,
            "merge": layout.merge}  # fmt: skip
    lines += [f"{key} = {_text(value)}" for key, value in rest.items() if value is not None and value is not False]
    return ["[time]", *lines] if lines else []


def _inline(source: Source) -> str:
    return "{ " + ", ".join(_entries(source)) + " }"


def _entries(source: Source) -> list[str]:
    unit = f"unit = {_text(source.unit)}"
    if len(source.terms) == 1:
        (term,) = source.terms
        entries = [f"column = {_text(term.column)}", unit]
        entries += [f"factor = {term.factor!r}"] if term.factor != 1.0 else []
    else:
        terms = ", ".join(f"{{ column = {_text(t.column)}, factor = {t.factor!r} }}" for t in source.terms)
        entries = [unit, f"terms = [{terms}]"]
    entries += [f"sign = {source.sign:g}"] if source.sign != 1.0 else []
    return entries + (["integrate = true"] if source.integrate else [])


def _text(value: str | int | tuple[int, int]) -> str:
    """Return a string, whole numbers or a boolean as TOML."""
    # Unlike JSON, TOML escapes DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _comment(text: str | None) -> list[str]:
    """Return comment lines; control characters, which TOML forbids there, become blanks."""
    if not text:
        return []
    return ["# " + "".join(c if c.isprintable() else " " for c in line) for line in text.splitlines()]


#: Subject of a doubt about the robot's outputs.
ONE_AXIS = "outputs"
# Format of a guess: `NOT SURE (70 %): why` for a channel's column and unit, else `NOT SURE: subject (80 % sure): why`.
_NOT_SURE = re.compile(r"NOT SURE(?: \((\d+ %)\))?: (.*?)(?=; NOT SURE|$)")
_KEY = re.compile(r"\[?(?:channels\.)?(\w+)")


def doubts_in(path: str | Path) -> tuple[str, ...]:
    """Return the doubts marked in a layout file, as `subject (80 % sure): why`; that about the outputs comes first.

    A user who confirms a guess deletes its remark.
    """
    try:
        text = settings_text(path)
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: is not a layout ({error}).") from error
    found: dict[str, list[str]] = {}
    marked: list[str] = []
    for line in text.splitlines():
        key = None if line.startswith("#") else _KEY.match(line)
        marked += [line] * line.startswith("#")
        for sure, why in _NOT_SURE.findall(" ".join(marked)) if key else ():
            found.setdefault(f"({sure} sure): {why}" if sure else why, []).extend([key[1]] if sure and key else [])
        marked = [] if key else marked
    changed = [" ".join([", ".join(keys), why]).strip() for why, keys in found.items()]
    return tuple(sorted(changed, key=lambda one: not one.startswith(f"{ONE_AXIS}: ")))
