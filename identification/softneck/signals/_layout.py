"""Foreign logs become recordings through a layout: a TOML file that says which column is what."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from softneck.core import DataError, FileFormatError, SettingsError, SoftneckError, Vector, to_si

from ._channels import known_channels, may_miss, si_unit
from ._files import integers, median_step, numbers, read_table
from ._mat import read_mat
from ._recording import Recording, check_times
from ._sample_time import estimate_sample_time
from ._tilt import pitch_roll

Column = str | int


@dataclass(frozen=True, slots=True)
class Term:
    """One column times a factor."""

    column: Column
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Source:
    """Where a channel comes from: the sum of terms, in `unit`, times `sign`."""

    terms: tuple[Term, ...]
    unit: str
    sign: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """How a log is read.

    Attributes:
        channels: channel name -> source.
        inclination, orientation: sources of the tilt vector, instead of pitch and roll.
        time: the time column's source, or None.
        sample_time: true sample time [s]; None takes it from the time column.
        estimate: take the sample time at which logged positions and velocities agree.
        new_run_at_restart: a time that goes back starts a new run.
        run: the column that numbers the runs, or None.
        variable: the matrix of a MAT file; None takes its vectors by name.
        header: whether the first line names the columns.
        delimiter: between cells.
        rows: first and last row (not included) to take.
    """

    channels: Mapping[str, Source]
    inclination: Source | None = None
    orientation: Source | None = None
    time: Source | None = None
    sample_time: float | None = None
    estimate: bool = False
    new_run_at_restart: bool = False
    run: Column | None = None
    variable: str | None = None
    header: bool = True
    delimiter: str = ","
    rows: tuple[int, int] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """A recording and what the importer did that a user should know."""

    recording: Recording
    notes: tuple[str, ...] = field(default=())


def read_layout(path: str | Path) -> Layout:
    """Read a layout file (docs, "Layouts").

    Raises:
        FileFormatError: no such file or no TOML.
        SettingsError: a key, channel or unit that a layout does not have.
    """
    source = Path(path)
    try:
        table = tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileFormatError(f"{source}: no such file.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise FileFormatError(f"{source}: is no TOML file ({error}).") from error
    try:
        return _layout(table)
    except SoftneckError as error:
        raise SettingsError(f"{source}: {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise SettingsError(f"{source}: a value is of the wrong type ({error}).") from error


def import_log(path: str | Path, layout: Layout) -> Imported:
    """Read a foreign table as a recording.

    Raises:
        FileFormatError: no such file or no table.
        DataError: a column is missing, holds no numbers, or the times do not fit.
    """
    source = Path(path)
    frame = read_log(source, layout)
    if layout.rows is not None:
        frame = frame.iloc[layout.rows[0] : layout.rows[1]].reset_index(drop=True)
    try:
        return _imported(frame, layout)
    except SoftneckError as error:
        raise DataError(f"{source}: {error}") from error


def read_log(source: Path, layout: Layout) -> pd.DataFrame:
    """Return a log's table by its ending: `.parquet`, `.mat`, or else text.

    Raises:
        FileFormatError: no such file or no table.
        DataError: a MAT file without the variable.
    """
    suffix = source.suffix.lower()
    if suffix == ".mat":
        if not source.is_file():
            raise FileFormatError(f"{source}: no such file.")
        return read_mat(source, layout.variable, tuple(str(c) for c in _columns(layout)))
    if layout.variable is not None:
        raise DataError(f"{source}: the layout's `variable` is for a `.mat` file.")
    kind = ".parquet" if suffix == ".parquet" else ".csv"
    frame = read_table(source, kind, header=layout.header, delimiter=layout.delimiter)
    frame.columns = [name.strip() if isinstance(name, str) else name for name in frame.columns]
    return frame


def _columns(layout: Layout) -> tuple[Column, ...]:
    """Return all columns that a layout names."""
    sources = [*layout.channels.values(), layout.inclination, layout.orientation, layout.time]
    named = [term.column for source in sources if source is not None for term in source.terms]
    return (*named, layout.run) if layout.run is not None else tuple(named)


def _imported(frame: pd.DataFrame, layout: Layout) -> Imported:
    channels = {name: _values(frame, source, name) for name, source in layout.channels.items()}
    if layout.inclination is not None and layout.orientation is not None:
        i = _values(frame, layout.inclination, "pitch")
        o = _values(frame, layout.orientation, "pitch")
        channels["pitch"], channels["roll"] = pitch_roll(i, o)
    time, run, sample_time, notes = _times(frame, layout, channels)
    return Imported(Recording(time, sample_time, channels, run), notes)


def _sample_time(
    layout: Layout, channels: Mapping[str, Vector], run: np.ndarray, nominal: float | None
) -> tuple[float | None, tuple[str, ...]]:
    """Return the sample time that overrules the column's `nominal`, and what velocities say of either."""
    given = layout.sample_time
    if layout.estimate:
        found = estimate_sample_time(channels, run)
        return found.value, (f"sample time estimated from positions and velocities: {found}",)
    judged = given if given is not None else nominal
    try:
        found = estimate_sample_time(channels, run)
    except DataError:
        return given, ()
    if judged is None or not found.contradicts(judged):
        return given, ()
    hint = 'write `sample_time_s = "estimate"` in [time] to use it'
    return given, (f"warning: {1e3 * judged:g} ms does not fit: positions and velocities agree at {found}; {hint}",)


def _times(
    frame: pd.DataFrame, layout: Layout, channels: Mapping[str, Vector]
) -> tuple[Vector, np.ndarray, float, tuple[str, ...]]:
    run = np.zeros(len(frame), dtype=np.int64)
    notes: list[str] = []
    logged = None
    if layout.run is not None:
        run = integers(_column(frame, layout.run, "run"))
    if layout.time is not None:
        logged = _values(frame, layout.time, "time")
        if layout.new_run_at_restart:
            run[1:] = np.cumsum((np.diff(logged) <= 0) | (np.diff(run) != 0))
            notes.append(f"{run[-1] + 1 if run.size else 0} run(s), by restarts of the time column")
    nominal = median_step(logged, run) if logged is not None and logged.size > 1 else None
    sample_time, remarks = _sample_time(layout, channels, run, nominal)
    notes.extend(remarks)
    if sample_time is None:
        if logged is None:
            raise DataError("the layout gives neither a time column nor `sample_time_s`; give one.")
        return logged, run, median_step(logged, run), tuple(notes)
    if logged is not None and nominal is not None:
        # The layout knows the sample time better than this column, but a gap in it is one in the samples.
        check_times(logged, nominal, run, tolerance=0.5)
        whose = "the estimated" if layout.estimate else "the layout's"
        if abs(nominal - sample_time) > 1e-3 * sample_time:
            notes.append(
                f"the time column says {1e3 * nominal:g} ms a sample; {whose} {1e3 * sample_time:.4g} ms is used"
            )
    first = np.concatenate([[0], np.flatnonzero(np.diff(run)) + 1]) if run.size else np.zeros(0, dtype=np.int64)
    within = np.arange(run.size) - np.repeat(first, np.diff(np.append(first, run.size)))
    return within * sample_time, run, sample_time, tuple(notes)


def _values(frame: pd.DataFrame, source: Source, channel: str) -> Vector:
    total = np.zeros(len(frame))
    for term in source.terms:
        column = _column(frame, term.column, channel)
        total = total + term.factor * numbers(column, str(term.column), missing=may_miss(channel))
    return source.sign * to_si(source.unit)[0] * total


def _column(frame: pd.DataFrame, name: Column, channel: str) -> pd.Series:
    """Return a column by its name, or by its index where names are words."""
    places = [place for place, title in enumerate(frame.columns) if title == name]
    if len(places) > 1:
        raise DataError(f"column `{name}` for `{channel}` stands {len(places)} times in the file; use its index.")
    if not places and isinstance(name, int) and 0 <= name < frame.shape[1]:
        places = [name]
    if not places:
        listed = ", ".join(str(title) for title in frame.columns)
        raise DataError(f"column `{name}` for `{channel}` is not in the file; it has {listed}.")
    return frame.iloc[:, places[0]]


def _layout(table: dict[str, Any]) -> Layout:
    _known_keys(table, {"file", "time", "channels", "tilt"}, "the layout")
    file, time = table.get("file", {}), table.get("time", {})
    tilt = table.get("tilt", {})
    _known_keys(file, {"header", "delimiter", "rows", "variable"}, "[file]")
    _known_keys(time, {"column", "unit", "sample_time_s", "new_run_at_restart", "run_column"}, "[time]")
    _known_keys(tilt, {"inclination", "orientation"}, "[tilt]")
    if len(tilt) == 1:
        raise SettingsError("[tilt] needs both `inclination` and `orientation`.")
    if not isinstance(time.get("run_column", ""), str | int):
        raise SettingsError(f"[time] run_column must be a name or an index; got {time['run_column']!r}.")
    rows = file.get("rows")
    if rows is not None and not (
        isinstance(rows, list) and [type(row) for row in rows] == [int, int] and 0 <= rows[0] < rows[1]
    ):
        raise SettingsError(f"[file] rows must be [first, last] with 0 <= first < last; got {rows}.")
    return Layout(
        channels={name: _channel_source(name, entry) for name, entry in table.get("channels", {}).items()},
        inclination=_source(tilt["inclination"], "rad", "[tilt] inclination") if tilt else None,
        orientation=_source(tilt["orientation"], "rad", "[tilt] orientation") if tilt else None,
        time=_source({"unit": "s", **_only(time, "column", "unit")}, "s", "[time]") if "column" in time else None,
        sample_time=None if time.get("sample_time_s") == "estimate" else _positive(time.get("sample_time_s")),
        estimate=time.get("sample_time_s") == "estimate",
        new_run_at_restart=_flag(time, "new_run_at_restart", default=False),
        run=time.get("run_column"),
        variable=str(file["variable"]) if "variable" in file else None,
        header=_flag(file, "header", default=True),
        delimiter=str(file.get("delimiter", ",")),
        rows=(rows[0], rows[1]) if rows is not None else None,
    )


def _channel_source(name: str, entry: Any) -> Source:
    if name not in known_channels() or name == "time":
        raise SettingsError(f"[channels.{name}]: no channel of a recording; known: {', '.join(known_channels())}.")
    return _source(entry, si_unit(name), f"[channels.{name}]")


def _source(entry: Any, quantity: str, where: str) -> Source:
    if not isinstance(entry, dict):
        raise SettingsError(f"{where} must be a table with `column` (or `terms`) and `unit`.")
    _known_keys(entry, {"column", "terms", "unit", "sign", "factor"}, where)
    terms = entry.get("terms", [_only(entry, "column", "factor")])
    for term in terms:
        if not isinstance(term, dict) or not isinstance(term.get("column"), str | int):
            raise SettingsError(f"{where} needs `column`: a name, or an index from 0 for a file without header.")
        _known_keys(term, {"column", "factor"}, where)
    if "unit" not in entry:
        raise SettingsError(f"{where} names no unit.")
    if to_si(entry["unit"])[1] != quantity:
        raise SettingsError(f"{where} cannot be in `{entry['unit']}`; its SI unit is {quantity}.")
    parsed = tuple(Term(term["column"], float(term.get("factor", 1.0))) for term in terms)
    return Source(parsed, entry["unit"], float(entry.get("sign", 1.0)))


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
