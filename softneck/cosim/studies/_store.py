"""The runs of a study on disk, in one table that grows, and their evaluation."""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from softneck import __version__
from softneck.core import (
    MOST_JSON,
    FileFormatError,
    Matrix,
    OutputFileError,
    SettingsError,
    Vector,
    atomic_write,
    error_reason,
    require_table,
    settings_text,
    write_text,
)

from ..loops._loop_parts import OBJECT
from ._study import Study, Vary

if TYPE_CHECKING:
    import pandas as pd

RUNS_FILE, STUDY_FILE = "runs.csv", "study.json"
# Longest text of a run's error [characters].
_MAX_ERROR_LENGTH = 2000


class Store:
    """The folder of a study: `study.json` describes it, and a table has the finished runs.

    A run is finished when its whole line is in the table; `done` are the numbers of finished runs.
    """

    def __init__(self, study: Study, folder: Path, *, force: bool = False) -> None:
        """Start the study in `folder`, or continue the same one there; with `force` replace any study."""
        self.folder, self._study, self._runs = folder, study, folder / RUNS_FILE
        if (folder / STUDY_FILE).is_file() and not force:
            self._check_same(study)
        else:
            self._runs.unlink(missing_ok=True)
            text = json.dumps(_description(study), indent=2) + "\n"
            write_text(folder / STUDY_FILE, text, force=True)
        self.done = set(self.finish()["run"].tolist())

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Write rows of finished runs; they are on the disk when this returns."""
        table = self._frame([{name: _cell(value) for name, value in row.items()} for row in rows])
        try:
            with self._runs.open("a", encoding="utf-8", newline="") as file:
                table.to_csv(file, index=False, header=False, lineterminator="\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputFileError(f"{self._runs}: cannot be written: {error.strerror}.") from error
        self.done.update(row["run"] for row in rows)

    def frame(self) -> pd.DataFrame:
        """Return all finished runs in the order of their numbers."""
        table = self._frame([])
        if not self._runs.is_file():
            return table
        found = _read(self._runs, self._study.vary)
        if not found.columns.equals(table.columns):
            raise FileFormatError(f"{self._runs}: has other columns than this study writes; --force begins it anew.")
        return found

    def finish(self) -> pd.DataFrame:
        """Write the table anew in the order of the runs, without a line that was not finished, and return it."""
        table = self.frame()
        with atomic_write(self._runs, force=True) as temporary:
            # The shortest digits that read back the same.
            table.to_csv(temporary, index=False, encoding="utf-8", lineterminator="\n")
        return table

    def _frame(self, rows: list[dict[str, Any]]) -> pd.DataFrame:
        import pandas as pd

        names = ["run", "sample", "seed", *self._study.vary, *self._study.metrics, "holds", "error", "seconds"]
        return pd.DataFrame(rows, columns=names).astype(column_types(names, self._study.vary))

    def _check_same(self, study: Study) -> None:
        there = read_study_description(self.folder)
        # Runs are numbered in the order of the keys, which no digest knows.
        before, same = there.get("study", {}), there.get("digest") == study.digest
        if same and list(before.get("vary", {})) == list(study.vary):
            return
        now = study.description()
        differs = [key for key in now if json.loads(json.dumps(now[key])) != before.get(key)]
        differs += ["order of vary"] * same
        raise SettingsError(
            f"{self.folder}: holds another study (other {', '.join(differs) or 'content'}); "
            "use the study of this folder, another folder, or --force to replace it. Nothing was changed."
        )


def read_study_description(folder: Path) -> dict[str, Any]:
    """Return the content of `study.json`; raise FileFormatError if it describes no study."""
    path = folder / STUDY_FILE
    try:
        content = json.loads(settings_text(path, MOST_JSON))
    except (OSError, ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: cannot be read ({error}).") from error
    if not isinstance(content, dict) or "study" not in content:
        raise FileFormatError(f"{path}: does not describe a study.")
    return content


def read_runs(folder: str | Path) -> pd.DataFrame:
    """Return the finished runs in a study's folder, also of a study that is not finished.

    Raises:
        FileFormatError: the folder has no study.
    """
    import pandas as pd

    study = read_study_description(Path(folder))["study"]
    varied = study.get("vary") if isinstance(study, dict) else None
    kinds = {}
    for key, item in varied.items() if isinstance(varied, dict) else ():
        labels = item.get("labels") if isinstance(item, dict) else None
        kinds[key] = Vary(item.get("kind", ""), labels=tuple(labels)) if isinstance(labels, list) else Vary("")
    file = Path(folder) / RUNS_FILE
    return _read(file, kinds) if file.is_file() else pd.DataFrame({"run": pd.Series(dtype="int64")})


def _read(path: Path, vary: Mapping[str, Vary]) -> pd.DataFrame:
    """Return the whole lines of a table of runs, in the order of their numbers."""
    import pandas as pd

    require_table(path)
    try:
        lines = path.read_bytes()
        lines = lines[: lines.rfind(b"\n") + 1]
        names = [str(name) for name in pd.read_csv(BytesIO(lines), nrows=0).columns]
        for name in ("run", "holds", "error"):
            if name not in names:
                raise ValueError(f"no column `{name}`")
        types: Any = column_types(names, vary)
        with warnings.catch_warnings():
            # pandas only warns about rows that are longer than the header.
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                BytesIO(lines), dtype=types, index_col=False, keep_default_na=False,
                na_values={name: [""] for name, kind in types.items() if kind in ("float64", "boolean")},
            )  # fmt: skip
            return table.sort_values("run", kind="stable", ignore_index=True)
    except (ValueError, OSError, ArithmeticError, MemoryError, pd.errors.ParserWarning) as error:
        raise FileFormatError(f"{path}: holds runs that cannot be read ({error_reason(error)}).") from error


def column_types(names: Iterable[str], vary: Mapping[str, Vary]) -> dict[str, Any]:
    """Return the type of each column of a study's runs; metrics are floats."""
    known = {"run": "int64", "sample": "int64", "seed": "int64", "holds": "boolean", "error": "str"}
    known |= {key: _column_type(item) for key, item in vary.items()}
    return {name: known.get(name, "float64") for name in names}


def _column_type(vary: Vary) -> str:
    if vary.kind == "seed":
        return "int64"
    labels = vary.labels
    if labels and not all(isinstance(label, int | float) and not isinstance(label, bool) for label in labels):
        return "str"
    return "int64" if labels and all(isinstance(label, int) for label in labels) else "float64"


def _cell(value: Any) -> Any:
    """Return a text as one line without characters that readers of tables refuse."""
    if not isinstance(value, str):
        return value
    line = " ".join(value.split()).replace("\0", "?")[:_MAX_ERROR_LENGTH]
    return line.encode("utf-8", "backslashreplace").decode()


def _description(study: Study) -> dict[str, Any]:
    return {
        "format": 1, "softneck": __version__, "name": study.name, "folder": str(study.folder),
        "objectives": list(study.objectives), "digest": study.digest, "study": study.description(),
    }  # fmt: skip


def rank(runs: pd.DataFrame, objectives: Sequence[str]) -> pd.DataFrame:
    """Return the runs, best first: those that keep limits by their objectives, then others, then failed ones."""
    import pandas as pd

    _check(runs, objectives)
    keys = pd.DataFrame({"failed": runs["error"] != "", "broken": ~runs["holds"].fillna(True).astype(bool)})
    for metric in objectives:
        keys[metric] = runs[metric].fillna(np.inf)
    order = keys.sort_values([*keys.columns], kind="stable").index
    return runs.loc[order]


def pareto_front(runs: pd.DataFrame, objectives: Sequence[str]) -> pd.DataFrame:
    """Return the runs that no other run dominates, sorted by the first objective.

    Failed runs and those without a finite objective are left out.
    """
    _check(runs, objectives)
    finite = np.isfinite(runs[list(objectives)].to_numpy(float)).all(axis=1)
    good = runs.loc[finite & np.array([not error for error in runs["error"].tolist()], dtype=bool)]
    values = good[list(objectives)].to_numpy(float)
    return good.loc[pareto_rows(values)].sort_values(list(objectives), kind="stable")


def pareto_rows(values: Matrix) -> np.ndarray:
    """Return whether each row of (n, m) is dominated by no other; in lexical order only the front can dominate."""
    keep = np.zeros(len(values), dtype=bool)
    front = np.empty((0, values.shape[1]))
    for i in np.lexsort(values.T):
        beaten = (front <= values[i]).all(axis=1) & (front < values[i]).any(axis=1)
        if not beaten.any():
            keep[i] = True
            front = np.vstack([front, values[i]])
    return keep


def group_runs(runs: pd.DataFrame, by: Sequence[str], metrics: Sequence[str]) -> pd.DataFrame:
    """Return for each combination of values of `by`: runs, failed runs, share that holds, spread of the metrics."""
    import pandas as pd

    rows = []
    for values, part in runs.assign(holds=held_runs(runs)).groupby(list(by), sort=False, dropna=False):
        row: dict[str, Any] = dict(zip(by, values if isinstance(values, tuple) else (values,), strict=True))
        # No metric of a failed run is known.
        failed, held = part["error"].to_numpy() != "", part["holds"].dropna().tolist()
        row |= {"runs": len(part), "failed": int(failed.sum())}
        row["holds [%]"] = 100.0 * sum(held) / len(held) if held else math.nan
        for metric in metrics:
            y = np.where(failed, np.inf, part[metric].to_numpy(float))
            row |= {f"{metric} {name}": value for name, value in _spread(y).items()}
        rows.append(row)
    return pd.DataFrame(rows)


def held_runs(runs: pd.DataFrame) -> pd.Series:
    """Return whether each run keeps its limits: one that failed does not; NA where no run has any."""
    import pandas as pd

    kept, errors = runs["holds"].tolist(), runs["error"].tolist()
    limited = not all(map(pd.isna, kept))
    held = [False if limited and error else one for one, error in zip(kept, errors, strict=True)]
    return pd.Series(held, index=runs.index, dtype="boolean")


def _spread(y: Vector) -> dict[str, float]:
    """Return median, 95 % quantile and worst value; a metric that is not reached counts as infinity."""
    y = np.where(np.isfinite(y), y, np.inf)
    if not y.size:
        return dict.fromkeys(("median", "95 %", "worst"), math.nan)
    # An observed value: interpolation with infinity has no meaning.
    quantiles = np.quantile(y, [0.5, 0.95], method="inverted_cdf")
    return {"median": float(quantiles[0]), "95 %": float(quantiles[1]), "worst": float(y.max())}


def worst_runs(runs: pd.DataFrame, objectives: Sequence[str], count: int = 3) -> pd.DataFrame:
    """Return the last `count` runs of the ranking, worst first: failed runs, then runs that break limits."""
    return rank(runs, objectives).iloc[::-1].head(count)


def write_worst(study: Study, runs: pd.DataFrame, folder: str | Path, *, count: int = 3) -> list[Path]:
    """Write the worst runs as loop files `run_NUMBER.toml`, which `softneck simulate` runs; return their paths.

    Their key `folder` makes relative paths start where those of the study's loop do. Raises SettingsError: the loop
    holds parts that are not files; `Study.setup(run)` returns its loops.
    """
    target = Path(folder)
    paths = []
    for number, error in worst_runs(runs, study.objectives, count)[["run", "error"]].itertuples(index=False):
        table = study.table(int(number))
        if has_objects(table):
            raise SettingsError("the loop holds parts that are not files; use `Study.setup(run)` for its worst runs.")
        start = os.path.relpath(study.folder / str(table.pop("folder", "")), target.resolve())
        remark = f"# Run {number} of study {study.name}" + (f"; it failed: {error}" if error else ".")
        text = f"{remark}\n" + tomli_w.dumps({"folder": Path(start).as_posix(), **table})
        path = target / f"run_{number:05d}.toml"
        write_text(path, text, force=True)
        paths.append(path)
    return paths


def has_objects(table: Any) -> bool:
    """Return whether a loop's table holds parts as objects."""
    if isinstance(table, Mapping):
        return OBJECT in table or any(has_objects(value) for value in table.values())
    return isinstance(table, list) and any(has_objects(item) for item in table)


def _check(runs: pd.DataFrame, objectives: Sequence[str]) -> None:
    for metric in objectives:
        if metric not in runs:
            raise SettingsError(f"`{metric}` is not a column of the runs; they have {', '.join(runs.columns)}.")
