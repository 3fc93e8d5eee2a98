"""What a study's runs say: ranking, Pareto front, groups, worst cases as loop files."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from softneck.core import Matrix, SettingsError, Vector, atomic_write

from ..loops._loop_parts import OBJECT
from ._study import Study

if TYPE_CHECKING:
    import pandas as pd


WORST = "worst"


def rank(runs: pd.DataFrame, objectives: Sequence[str]) -> pd.DataFrame:
    """Return the runs, best first: those that keep limits by the objectives in turn, then others, then failed."""
    import pandas as pd

    _check(runs, objectives)
    keys = pd.DataFrame({"failed": runs["error"] != "", "broken": ~runs["holds"].fillna(True).astype(bool)})
    for metric in objectives:
        keys[metric] = runs[metric].fillna(np.inf)
    order = keys.sort_values([*keys.columns], kind="stable").index
    return runs.loc[order]


def pareto_front(runs: pd.DataFrame, objectives: Sequence[str]) -> pd.DataFrame:
    """Return the runs that no other run beats in one objective without losing in another, by the first objective.

    Failed runs and those that never reach an objective are left out.
    """
    _check(runs, objectives)
    finite = np.isfinite(runs[list(objectives)].to_numpy(float)).all(axis=1)
    good = runs.loc[finite & np.array([not error for error in runs["error"].tolist()], dtype=bool)]
    values = good[list(objectives)].to_numpy(float)
    return good.loc[pareto_rows(values)].sort_values(list(objectives), kind="stable")


def pareto_rows(values: Matrix) -> np.ndarray:
    """Return which rows of (n, m) no other row dominates; in lexical order only rows of the front can dominate."""
    keep = np.zeros(len(values), dtype=bool)
    front = np.empty((0, values.shape[1]))
    for i in np.lexsort(values.T[::-1]):
        beaten = (front <= values[i]).all(axis=1) & (front < values[i]).any(axis=1)
        if not beaten.any():
            keep[i] = True
            front = np.vstack([front, values[i]])
    return keep


def grouped(runs: pd.DataFrame, by: Sequence[str], metrics: Sequence[str]) -> pd.DataFrame:
    """Return for each combination of values of `by`: runs, failed ones, share that holds, spread of the metrics."""
    import pandas as pd

    rows = []
    for values, part in runs.groupby(list(by), sort=False):
        row: dict[str, Any] = dict(zip(by, values if isinstance(values, tuple) else (values,), strict=True))
        failed = np.array([bool(error) for error in part["error"].tolist()])
        held = part["holds"].dropna().tolist()
        row |= {"runs": len(part), "failed": int(failed.sum())}
        row["holds [%]"] = 100.0 * sum(held) / len(held) if held else math.nan
        for metric in metrics:
            y = part[metric].to_numpy(float)[~failed]
            row |= {f"{metric} {name}": value for name, value in _spread(y).items()}
        rows.append(row)
    return pd.DataFrame(rows)


def _spread(y: Vector) -> dict[str, float]:
    """Return median, 95 % quantile and worst; runs that never reach the metric count as infinitely bad."""
    y = np.where(np.isfinite(y), y, np.inf)
    if not y.size:
        return dict.fromkeys(("median", "95 %", "worst"), math.nan)
    # Of an observed value, not between two: infinity has no neighbours to mix with.
    quantiles = np.quantile(y, [0.5, 0.95], method="inverted_cdf")
    return {"median": float(quantiles[0]), "95 %": float(quantiles[1]), "worst": float(y.max())}


def worst_runs(runs: pd.DataFrame, objectives: Sequence[str], count: int = 3) -> pd.DataFrame:
    """Return the last `count` of the ranking, worst first: failed runs, then runs that break limits."""
    return rank(runs, objectives).iloc[::-1].head(count)


def write_worst(study: Study, runs: pd.DataFrame, folder: str | Path, *, count: int = 3) -> list[Path]:
    """Write the worst runs as loop files `run_NUMBER.toml`, which `softneck simulate` runs; return their paths.

    Their relative paths start where those of the study's loop do, by the key `folder`.

    Raises:
        SettingsError: the loop holds parts that are not files; `Study.setup(run)` gives such a loop.
    """
    target = Path(folder)
    paths = []
    for number, error in worst_runs(runs, study.objectives, count)[["run", "error"]].itertuples(index=False):
        table = study.table(int(number))
        if has_objects(table):
            raise SettingsError("the loop holds parts that are not files; take its worst runs by `Study.setup(run)`.")
        start = os.path.relpath(study.folder / str(table.pop("folder", "")), target.resolve())
        remark = f"# Run {number} of study {study.name}" + (f"; it failed: {error}" if error else ".")
        text = f"{remark}\n" + tomli_w.dumps({"folder": Path(start).as_posix(), **table})
        path = target / f"run_{number:05d}.toml"
        with atomic_write(path, force=True) as temporary:
            temporary.write_text(text, encoding="utf-8")
        paths.append(path)
    return paths


def has_objects(table: Any) -> bool:
    """Return whether parts stand in a loop's table themselves."""
    if isinstance(table, Mapping):
        return OBJECT in table or any(has_objects(value) for value in table.values())
    return isinstance(table, list) and any(has_objects(item) for item in table)


def _check(runs: pd.DataFrame, objectives: Sequence[str]) -> None:
    for metric in objectives:
        if metric not in runs:
            raise SettingsError(f"`{metric}` is not a column of the runs; they have {', '.join(runs.columns)}.")
