"""Recordings as CSV and Parquet files with units in the column titles."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    MOST_TOML,
    DataError,
    FileFormatError,
    SoftneckError,
    Vector,
    as_path,
    atomic_write,
    error_reason,
    finite_matrix,
    require_file,
    require_numbers,
    require_package,
    require_size,
    require_table,
    to_si,
)
from softneck.robot import Robot, find_robot, robot_file_of

from ._channels import column_name, file_unit, known_channels, may_miss, parse_column
from ._recording import Recording, concatenate, median_step, require_same_robot

if TYPE_CHECKING:
    import pandas as pd

# Characters of a plain table of numbers; pandas reads files with any other.
_CSV_CHARACTERS = "0123456789+-.eE,\n"
# [bytes] pandas is faster on larger files, its import included.
_MAX_PLAIN_BYTES = 20_000_000
# Rows of a file written at once, so that memory does not grow with its length.
_ROWS_AT_ONCE = 4096
_ALL = slice(None)


def read_plain_csv(source: Path) -> dict[str, Vector] | None:
    """Return title -> column of a CSV file of plain numbers, or None for any other file.

    An empty cell is NaN. Numbers equal those of pandas: both round a decimal to the nearest double.
    """
    try:
        if source.stat().st_size > _MAX_PLAIN_BYTES:
            return None
        head, _, body = source.read_text(encoding="utf-8").replace("\r\n", "\n").partition("\n")
        if head.startswith("# "):  # the line that names the robot
            head, _, body = body.partition("\n")
    except (OSError, UnicodeDecodeError):
        return None
    require_numbers(source, 1, 1 + head.count(","))
    titles = head.split(",")
    if body.strip(_CSV_CHARACTERS) or not all(titles) or len(set(titles)) < len(titles) or '"' in head:
        return None
    rows = [line.split(",") for line in body.split("\n") if line]
    if not rows or any(len(row) != len(titles) for row in rows):
        return None
    try:
        columns = [
            np.array([float(cell) if cell else math.nan for cell in column]) for column in zip(*rows, strict=True)
        ]
    except ValueError:
        return None
    return dict(zip(titles, columns, strict=True))


# Start of the first line of a recording whose robot is not the neck; the robot follows as JSON.
ROBOT_LINE = "# robot "
# The delimiter that stands for any number of blanks or tabs.
WHITESPACE = "whitespace"


def write_recording(path: str | Path, recording: Recording, *, force: bool = False) -> None:
    """Write a `.csv` or `.parquet` recording; a missing sample is an empty cell.

    Raises:
        OutputFileError: the file exists (and not `force`) or cannot be written.
        DataError: another ending than `.csv` or `.parquet`, or a channel without a sample.
        SettingsError: `.parquet`, and pyarrow is not installed.
    """
    suffix = recording_suffix(path)
    require_samples(recording)
    if suffix == ".parquet":
        require_package("pyarrow")
    with atomic_write(path, force=force) as temporary:
        if suffix == ".csv":
            robot = recording.robot  # the preset `neck` needs no line
            line = f"{ROBOT_LINE}{json.dumps(robot.as_dict())}\n" if robot.in_header() else ""
            _write_csv(recording, temporary, line)
        else:
            recording_frame(recording).to_parquet(temporary, index=False)


def _write_csv(recording: Recording, path: Path, before: str) -> None:
    """Write a table with the shortest digits that read back to the same number; NaN is an empty cell."""
    with path.open("w", encoding="utf-8") as file:
        for start in range(0, len(recording), _ROWS_AT_ONCE):
            columns = _columns_by_title(recording, slice(start, start + _ROWS_AT_ONCE))
            if start == 0:
                file.write(before + ",".join(columns) + "\n")
            rows = zip(*(column.tolist() for column in columns.values()), strict=True)
            file.writelines(",".join("" if cell != cell else repr(cell) for cell in row) + "\n" for row in rows)


def recording_frame(recording: Recording) -> pd.DataFrame:
    """Return the recording as a table with the columns of its file."""
    import pandas as pd

    frame = pd.DataFrame(_columns_by_title(recording))
    if recording.robot.in_header():
        frame.attrs["robot"] = recording.robot.as_dict()
    return frame


def _columns_by_title(recording: Recording, part: slice = _ALL) -> dict[str, np.ndarray]:
    """Return title with unit -> column in that unit, of the rows in `part`."""
    robot = recording.robot
    columns: dict[str, np.ndarray] = {column_name("time"): recording.time[part]}
    for name in known_channels(robot):
        if name in recording.channels:
            columns[column_name(name, robot)] = recording.channels[name][part] / to_si(file_unit(name, robot))[0]
    if recording.run.any():
        columns["run"] = recording.run[part]
    return columns


def read_recording(path: str | Path, *, robot: str | Path | Robot | None = None) -> Recording:
    """Read a recording in the format of `write_recording`.

    Args:
        path: a `.csv` or `.parquet` file.
        robot: a robot, a preset's name or a robot file. None takes `robot.toml` beside the file or above it, else the
            robot named in the file, else the neck.

    Raises:
        FileFormatError: no such file, or no table.
        DataError: columns, units, numbers or times do not fit the robot; the message names the problem.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> from softneck.signals import write_recording
        >>> write_recording("neck.csv", recording)
        >>> len(softneck.read_recording("neck.csv"))
        1000
    """
    source = as_path(path)
    if source.is_dir():
        require_file(source)
    suffix = recording_suffix(source)
    if source.is_file():
        require_size(source)
    stored = robot_in_file(source, suffix)
    columns: Mapping[str, pd.Series | Vector] | None = read_plain_csv(source) if suffix == ".csv" else None
    if columns is None:
        columns = _columns(read_table(source, suffix, TextForm(skip=0 if stored is None else 1)))
    try:
        return _from_columns(columns, _resolve_robot(source, stored, robot))
    except SoftneckError as error:
        raise DataError(f"{source}: {error}") from error


#: A recording, its file, a table with units in its titles, an array in SI, or a list of these.
RecordingLike: TypeAlias = (
    "Recording | str | Path | pd.DataFrame | Mapping[str, ArrayLike] | np.ndarray | Sequence[RecordingLike]"
)


def open_recording(thing: object, robot: Robot | str | Path | None = None) -> Recording:
    """Return `thing` as a recording; several become runs of one.

    `thing`: a recording, its file, a DataFrame or a dict of columns with units in their titles, an array (time, motors
    and outputs, or motors alone) in SI at the robot's sample time, or a list of them. `robot`: as in `read_recording`;
    an array needs one.
    """
    if isinstance(thing, str | Path):
        return read_recording(thing, robot=robot)
    if isinstance(thing, Recording):
        if robot is not None:
            require_same_robot(thing.robot, find_robot(robot), "the robot and a recording")
        return thing
    if isinstance(thing, Mapping) or hasattr(thing, "columns"):
        return from_frame(thing, robot)
    if isinstance(thing, list | tuple):
        return concatenate([open_recording(item, robot) for item in thing], names=recording_names(thing))
    if isinstance(thing, np.ndarray) and robot is not None:
        whose = find_robot(robot)
        motors = len(whose.set_points)
        alone = thing.ndim == 2 and thing.shape[1] == motors
        whole = finite_matrix("recording", thing, motors + (0 if alone else len(whose.outputs.names)), missing=True)
        return Recording.from_arrays(whole[:, :motors], None if alone else whole[:, motors:], robot=whose)
    hint = "an array needs `robot=`" if isinstance(thing, np.ndarray) else f"got a {type(thing).__name__}"
    raise DataError(f"a recording, its file, a DataFrame, a dict of columns or a list of them is needed; {hint}.")


def recording_names(things: Sequence[object]) -> list[str]:
    """Return names of recordings for messages: their files, else their number."""
    return [str(item) if isinstance(item, str | Path) else f"recording {k}" for k, item in enumerate(things, start=1)]


def from_frame(frame: object, robot: Robot | str | Path | None = None) -> Recording:
    """Return the recording of a table or of a mapping, title with unit -> column."""
    import pandas as pd

    try:
        table = frame if isinstance(frame, pd.DataFrame) else pd.DataFrame(frame)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError) as error:
        raise DataError(f"the columns do not make a table ({error}).") from error
    if table.index.name == column_name("time"):
        table = table.reset_index()
    stored = table.attrs.get("robot")
    return _from_columns(_columns(table), find_robot(Robot.from_dict(stored) if robot is None and stored else robot))


def robot_in_file(source: Path, suffix: str) -> Robot | None:
    """Return the robot that a file names, or None."""
    stored: object = None
    try:
        if suffix == ".parquet" and source.is_file():
            from pyarrow import ArrowException
            from pyarrow.parquet import read_schema

            try:
                attributes = (read_schema(source).metadata or {}).get(b"PANDAS_ATTRS", b"{}")
            except (ValueError, OSError, ArrowException):
                return None  # the reader of the table reports the damage
            stored = json.loads(attributes).get("robot")
        elif suffix == ".csv" and source.is_file():
            with source.open(encoding="utf-8", errors="replace") as file:
                line = file.readline(MOST_TOML)
            stored = json.loads(line.removeprefix(ROBOT_LINE)) if line.startswith(ROBOT_LINE) else None
        return None if stored is None else Robot.from_dict(stored)  # pyright: ignore[reportArgumentType]
    except (ValueError, AttributeError, TypeError, RecursionError) as error:
        raise DataError(f"{source}: does not name its robot ({error}).") from error


def _resolve_robot(source: Path, stored: Robot | None, given: str | Path | Robot | None) -> Robot:
    """Return the given robot, else that of `robot.toml`, else the one the file names, else the neck."""
    found = find_robot(given, beside=source) if given is not None or robot_file_of(source) is not None else stored
    found = Robot.preset("neck") if found is None else found
    if stored is not None and stored.hash != found.hash:
        raise DataError(f"is a recording of robot {stored.label()}, not of {found.label()}.")
    return found


@dataclass(frozen=True, slots=True)
class TextForm:
    """Format of a text table; the defaults are those of a recording."""

    header: bool = True
    delimiter: str = ","
    decimal: str = "."
    skip: int = 0
    unit_row: bool = False
    encoding: str = "utf-8"


def read_table(source: Path, suffix: str, form: TextForm) -> pd.DataFrame:
    """Read a table; columns of numbers are floats."""
    import pandas as pd

    require_file(source)
    if suffix == ".parquet":
        return _read_parquet(source)
    require_table(source, zeros=form.encoding.startswith("utf-16") or form.encoding == "utf-32")
    try:
        with warnings.catch_warnings():
            # pandas only warns of rows longer than the header, whose cells cannot be assigned to columns.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            return pd.read_csv(
                source,
                header=0 if form.header else None,
                sep=r"\s+" if form.delimiter == WHITESPACE else form.delimiter,
                decimal=form.decimal,
                skiprows=[*range(form.skip), form.skip + 1] if form.unit_row else form.skip,
                index_col=False,
                skipinitialspace=True,
                keep_default_na=False,
                na_values=[""],
                low_memory=False,
                encoding=form.encoding,
            )
    except pd.errors.ParserWarning as error:
        raise FileFormatError(
            f"{source}: cannot be read as a table (rows have more cells than the titles: a stray delimiter, or a "
            "decimal comma?)."
        ) from error
    except (ValueError, OSError, ArithmeticError, MemoryError) as error:
        raise FileFormatError(f"{source}: cannot be read as a table ({error_reason(error)}).") from error


def _read_parquet(source: Path) -> pd.DataFrame:
    from pyarrow import ArrowException
    from pyarrow.parquet import ParquetFile

    try:
        file = ParquetFile(source)
        require_numbers(source, file.metadata.num_rows, file.metadata.num_columns)
        # Without the metadata of pandas, which may be damaged; an index is an ordinary column.
        return file.read().to_pandas(ignore_metadata=True)
    except (ValueError, OSError, ArithmeticError, MemoryError, ArrowException) as error:
        raise FileFormatError(f"{source}: cannot be read as a table ({error_reason(error)}).") from error


def _columns(frame: pd.DataFrame) -> dict[str, pd.Series]:
    """Return title -> column; drop the empty column that a delimiter at the end of each line makes."""
    import pandas as pd

    columns = {str(title): pd.Series(frame[title]) for title in frame.columns}
    return {
        title: cells for title, cells in columns.items() if not (title.startswith("Unnamed: ") and cells.isna().all())
    }


def _from_columns(columns: Mapping[str, pd.Series | Vector], robot: Robot) -> Recording:
    run = np.zeros(0, dtype=np.int64)
    channels: dict[str, Vector] = {}
    for title, cells in columns.items():
        if title.strip() == "run":
            run = integers(cells)
            continue
        # pandas renames the second of two equal titles to `pitch [deg].1`.
        name, factor = parse_column(re.sub(r"\]\.\d+$", "]", title), robot)
        if name in channels:
            raise DataError(f"channel `{name}` is in two columns; drop one.")
        channels[name] = factor * numbers(cells, name, missing=may_miss(name, robot))
    if "time" not in channels:
        raise DataError("there is no column `time [s]`.")
    time = channels.pop("time")
    recording = Recording(time, median_step(time, run), channels, run, robot)
    require_samples(recording)
    return recording


def require_samples(recording: Recording) -> None:
    """Raise DataError if an output or motor position has no sample at all."""
    for name in (*recording.robot.outputs.names, *recording.robot.motor_positions):
        if name in recording.channels and np.isnan(recording.channels[name]).all():
            keep = name not in recording.robot.motor_positions
            hint = "A recording needs it; record it again" if keep else "Leave the column out"
            raise DataError(
                f"channel `{name}` has no sample in any of its {len(recording)} rows; is its sensor connected? {hint}."
            )


def numbers(column: pd.Series | Vector, name: str, *, missing: bool, nan_words: bool = False) -> Vector:
    """Return a column as floats; an empty cell is NaN where `missing` samples are allowed.

    `missing`: whether samples may be missing. `nan_words`: whether a missing sample may be written as `NaN`, as MATLAB
    and numpy write it.
    """
    if isinstance(column, np.ndarray):
        if not missing and np.isnan(column).any():
            raise _number_error(name, "an empty cell", int(np.argmax(np.isnan(column))), missing=missing)
        return column
    import pandas as pd

    values = np.asarray(pd.to_numeric(column, errors="coerce"), dtype=np.float64)
    bad = np.isnan(values)
    if missing and bad.any():
        gap = column.isna().to_numpy()
        bad = bad & ~gap
        if nan_words and bad.any():
            bad[bad] = [str(cell).strip().lower() != "nan" for cell in column[bad]]
    if bad.any():
        row = int(np.argmax(bad))
        text = " ".join(str(column.iloc[row]).split())[:60]  # a cell in quotes may hold lines
        cell = "an empty cell" if pd.isna(column.iloc[row]) else f"`{text}`"
        raise _number_error(name, cell, row, missing=missing)
    return values


def _number_error(name: str, cell: str, row: int, *, missing: bool) -> DataError:
    hint = "A missing sample is an empty cell." if missing else "Fix the log or cut it before that row."
    return DataError(f"column `{name}` holds {cell} at row {row} (the first is 0), where a number is needed. {hint}")


def integers(column: pd.Series | Vector) -> np.ndarray:
    """Return the column `run`; raise DataError unless it holds integers."""
    values = numbers(column, "run", missing=False)
    # Not every integer beyond 2^53 is a float.
    if not (np.abs(values) < 2**53).all() or not np.array_equal(values, np.round(values)):
        raise DataError("column `run` must hold integers.")
    return values.astype(np.int64)


def recording_suffix(path: str | Path) -> str:
    """Return `.csv` or `.parquet`; raise DataError for a path with another ending."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".csv", ".parquet"):
        raise DataError(f"{path}: a recording is a `.csv` or a `.parquet` file; got `{suffix or 'no ending'}`.")
    return suffix
