"""The runs of a study on disk: small Parquet files as runs end, one table when all have."""

from __future__ import annotations

import json
import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softneck import __version__
from softneck.core import FileFormatError, OutputFileError, SettingsError, atomic_write
from softneck.core._budget import MOST_JSON, require_numbers, settings_text

from ._study import Study
from ._vary import Vary

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa


RUNS, DESCRIPTION, _PARTS = "runs.parquet", "study.json", "runs.parts"
# Small files are joined whenever there are so many of them: a folder stays readable, a merge stays rare.
_MERGE_AT = 100


class Store:
    """The folder of a study: `study.json` says what it is, Parquet files hold the runs that ended.

    A run counts from the moment its file has its final name; a file that was being written does not count.

    Attributes:
        folder: of the study.
        done: numbers of the runs that ended.
    """

    def __init__(self, study: Study, folder: Path, *, resume: bool = False, force: bool = False) -> None:
        """Begin the study in `folder`, or go on with what is there.

        Raises:
            OutputFileError: the folder holds a study and neither `resume` nor `force` is given.
            SettingsError: `resume` in a folder of another study, or of none.
        """
        self.folder, self._schema = folder, schema(study.vary, study.metrics)
        self._parts = folder / _PARTS
        if (folder / DESCRIPTION).exists() and not (resume or force):
            raise OutputFileError(f"{folder}: holds a study already; --resume continues it, --force replaces it.")
        if resume:
            self._check_same(study)
        else:
            self._clear()
            text = json.dumps(_description(study), indent=2) + "\n"
            with atomic_write(folder / DESCRIPTION, force=True) as temporary:
                temporary.write_text(text, encoding="utf-8")
        try:
            self._parts.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputFileError(f"{self._parts}: cannot be written: {error.strerror}.") from error
        self.done = set(self._table(["run"]).column("run").to_pylist())
        self._files = len(list(self._parts.glob("*.parquet")))

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows of runs that ended; they are there to stay when this returns."""
        import pyarrow as pa

        table = pa.Table.from_pylist([dict(row) for row in rows], schema=self._schema)
        self._write(table, self._parts / f"{rows[0]['run']:08d}-{uuid.uuid4().hex[:8]}.parquet")
        self.done.update(row["run"] for row in rows)
        self._files += 1
        if self._files >= _MERGE_AT:
            self._merge(self._parts / f"merged-{uuid.uuid4().hex[:8]}.parquet")
            self._files = 1

    def frame(self) -> pd.DataFrame:
        """Return all runs that ended, in the order of their numbers."""
        return _frame(self._table())

    def finish(self) -> pd.DataFrame:
        """Write all runs into one file, remove the small ones, return the table."""
        self._merge(self.folder / RUNS)
        shutil.rmtree(self._parts, ignore_errors=True)
        return self.frame()

    def _table(self, columns: list[str] | None = None) -> pa.Table:
        return read_tables(_files(self.folder), self._schema, columns)

    def _merge(self, target: Path) -> None:
        files = list(self._parts.glob("*.parquet"))
        whole = target.parent == self.folder
        table = self._table() if whole else read_tables(files, self._schema)
        self._write(table, target)
        # Killed here, the runs are there twice; `read_tables` takes each once.
        for file in files:
            file.unlink(missing_ok=True)

    def _write(self, table: pa.Table, path: Path) -> None:
        import pyarrow.parquet as pq

        with atomic_write(path, force=True) as temporary:
            pq.write_table(table, temporary)

    def _clear(self) -> None:
        shutil.rmtree(self._parts, ignore_errors=True)
        (self.folder / RUNS).unlink(missing_ok=True)

    def _check_same(self, study: Study) -> None:
        path = self.folder / DESCRIPTION
        if not path.is_file():
            raise SettingsError(f"{self.folder}: there is no study to resume; leave --resume out to begin it.")
        there = read_description(self.folder)
        if there.get("digest") == study.digest:
            return
        now = study.description()
        differs = [key for key in now if json.loads(json.dumps(now[key])) != there.get("study", {}).get(key)]
        raise SettingsError(
            f"{self.folder}: holds another study (other {', '.join(differs) or 'content'}); "
            "give the study that began it, or another folder. Nothing was changed."
        )


def schema(vary: Mapping[str, Vary], metrics: Sequence[str]) -> pa.Schema:
    """Return the columns of a study's runs with their types."""
    import pyarrow as pa

    fields = [("run", pa.int64()), ("sample", pa.int64()), ("seed", pa.int64())]
    fields += [(key, _type_of(item)) for key, item in vary.items()]
    fields += [(metric, pa.float64()) for metric in metrics]
    return pa.schema([*fields, ("holds", pa.bool_()), ("error", pa.string()), ("seconds", pa.float64())])


def read_description(folder: Path) -> dict[str, Any]:
    """Return what `study.json` says; raise FileFormatError if it describes no study."""
    path = folder / DESCRIPTION
    try:
        content = json.loads(settings_text(path, MOST_JSON))
    except (OSError, ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: cannot be read ({error}).") from error
    if not isinstance(content, dict) or "study" not in content:
        raise FileFormatError(f"{path}: does not describe a study.")
    return content


def read_runs(folder: str | Path) -> pd.DataFrame:
    """Return the runs of a study's folder that ended so far, finished or not.

    Raises:
        FileFormatError: the folder holds no study.
    """
    import pandas as pd
    import pyarrow as pa
    import pyarrow.parquet as pq

    read_description(Path(folder))
    files = _files(Path(folder))
    if not files:
        return pd.DataFrame({"run": pd.Series(dtype="int64")})
    try:
        columns = pq.read_schema(files[0])
    except (pa.ArrowException, ValueError, OSError) as error:
        raise FileFormatError(f"{files[0]}: cannot be read ({_first_line(error)}).") from error
    if "run" not in columns.names or not pa.types.is_integer(columns.field("run").type):
        raise FileFormatError(f"{files[0]}: does not hold the runs of a study.")
    return _frame(read_tables(files, columns))


def read_tables(files: Sequence[Path], columns: pa.Schema, chosen: list[str] | None = None) -> pa.Table:
    """Return the rows of all files, each run once, by its number."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        empty, parts = columns.empty_table().select(chosen or columns.names), []
        for path in files:
            with pq.ParquetFile(path) as file:
                require_numbers(path, file.metadata.num_rows, file.metadata.num_columns)
                read = file.read(columns=chosen)
                parts.append(read.select(chosen) if chosen else read)  # in the file's order until here
        table = pa.concat_tables([empty, *parts])
        table.validate(full=True)
        if table.column("run").null_count:
            raise ValueError("a run without a number")
    except (pa.ArrowException, KeyError, ValueError, OSError, ArithmeticError, MemoryError) as error:
        said = _first_line(error)
        raise FileFormatError(f"{files[0].parent}: holds runs that cannot be read ({said}).") from error
    first = {}
    for place, run in enumerate(table.column("run").to_pylist()):
        first.setdefault(run, place)
    return table.take(pa.array([first[run] for run in sorted(first)], type=pa.int64()))


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:120]


def _files(folder: Path) -> list[Path]:
    whole = folder / RUNS
    # Temporary names begin with a dot; they are files that nobody finished.
    small = [path for path in (folder / _PARTS).glob("*.parquet") if not path.name.startswith(".")]
    return ([whole] if whole.is_file() else []) + sorted(small)


def _frame(table: pa.Table) -> pd.DataFrame:
    frame = table.to_pandas()
    frame["holds"] = frame["holds"].astype("boolean")
    frame["error"] = frame["error"].fillna("")
    return frame


def _type_of(vary: Vary) -> pa.DataType:
    import pyarrow as pa

    if vary.kind == "seed":
        return pa.int64()
    labels = vary.labels
    if labels and not all(isinstance(label, int | float) and not isinstance(label, bool) for label in labels):
        return pa.string()
    return pa.int64() if labels and all(isinstance(label, int) for label in labels) else pa.float64()


def _description(study: Study) -> dict[str, Any]:
    return {
        "format": 1, "softneck": __version__, "name": study.name, "folder": str(study.folder),
        "objectives": list(study.objectives), "digest": study.digest, "study": study.description(),
    }  # fmt: skip
