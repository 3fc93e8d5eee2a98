"""The page of a study: ranking, Pareto front, distributions of metrics, and influences on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.cosim import group_runs, held_runs, pareto_front, rank, worst_runs
from softneck.plots import Chart, Section, Table, cell, distribution_chart, influence_chart, page, pareto_chart

if TYPE_CHECKING:
    import pandas as pd


# Panels for numbers that varied: those with the largest influence.
_MAX_PANELS = 6
_MAX_ROWS = 10
# The metric ends in the unit of the output.
_KEY_METRICS = ("rise_s", "settling_s", "overshoot_pct", "rms_error_")


def study_page(description: Mapping[str, Any], runs: pd.DataFrame) -> str:
    """Return the HTML page of a study from its folder's `study.json` and its table of runs."""
    name = description["name"]
    return page(
        "Study" if name == "study" else f"Study {name}", study_sections(description, runs),
        verdict=study_verdict(description, runs), footer="Written by softneck study.",
    )  # fmt: skip


def study_sections(description: Mapping[str, Any], runs: pd.DataFrame) -> list[Section]:
    """Return the sections of a study's page; few if no run succeeded."""
    failed = failures(runs)
    objectives = list(description["objectives"])
    vary = description["study"]["vary"]
    sections: list[Section] = []
    if not all(failed):
        sections = [_spread(runs, vary, objectives), _ranking(runs, list(vary), objectives)]
        sections.append(_trade(runs, vary, objectives))
        if inputs := _numbers(runs, vary):
            sections.append(_influence(runs, inputs, objectives[0]))
    if any(failed):
        lost = [[str(row["run"]), str(row["error"])[:300]] for row in runs.to_dict("records") if row["error"]]
        table = Table(f"{len(lost)} runs failed", ["run", "error"], lost[:20], text=2)
        sections.append(Section("Failed runs", tables=[table]))
    return [*sections, _overview(description, runs, objectives)]


def study_verdict(description: Mapping[str, Any], runs: pd.DataFrame) -> str:
    """Return a sentence on the runs within their limits and on the best run."""
    failed, objectives = sum(failures(runs)), list(description["objectives"])
    said = kept_runs(runs)
    if failed < len(runs):
        best = rank(runs, objectives).iloc[0]
        said += f"; the best, run {best['run']}, has {objectives[0]} {cell(best[objectives[0]])}"
    return said + (f"; {failed} failed with an error." if failed else ".")


def kept_runs(runs: pd.DataFrame) -> str:
    """Return how many runs keep all limits, in words."""
    held = held_runs(runs).dropna().tolist()
    return f"{sum(map(bool, held))} of {len(held)} runs keep all limits" if held else f"{len(runs)} runs, no limits"


def study_rows(runs: pd.DataFrame, keys: Sequence[str], objectives: Sequence[str]) -> list[list[str]]:
    """Return the best runs as rows of text: number, varied values, objectives, verdict."""
    return [_row(row, keys, objectives) for row in rank(runs, objectives).head(_MAX_ROWS).to_dict("records")]


def study_head(keys: Sequence[str], objectives: Sequence[str]) -> list[str]:
    """Return the titles of `study_rows`."""
    return ["run", *map(short_key, keys), *objectives, "limits"]


def failures(runs: pd.DataFrame) -> list[bool]:
    """Return for each run whether it ended with an error."""
    return [bool(error) for error in runs["error"].tolist()]


def short_key(key: str) -> str:
    """Return a key without `parameters`, which most keys contain."""
    return key.replace(".parameters.", ".")


def _overview(description: Mapping[str, Any], runs: pd.DataFrame, objectives: list[str]) -> Section:
    study = description["study"]
    failed, held = sum(failures(runs)), held_runs(runs).dropna().tolist()
    text = [f"{len(runs)} of {study['runs']} runs, seed {study['seed']}."]
    if held:
        text.append(f"{100.0 * sum(held) / len(held):.1f} % keep all limits.")
    if failed:
        text.append(f"{failed} failed with an error.")
    rows = [[short_key(key), item["kind"], _range(item)] for key, item in study["vary"].items()]
    tables = [Table("What varied", ["key", "kind", "values"], rows, text=3)]
    by = _groups(study["vary"])
    if by:
        table = group_runs(runs, by, objectives)
        tables.append(
            Table("By group", list(table.columns), [[cell(v) for v in row] for row in table.to_numpy()], len(by))
        )
    return Section("Settings of the study", text=text, tables=tables)


def _ranking(runs: pd.DataFrame, keys: list[str], objectives: list[str]) -> Section:
    worst = [_row(row, keys, objectives) for row in worst_runs(runs, objectives, 5).to_dict("records")]
    head = study_head(keys, objectives)
    tables = [Table("Best runs", head, study_rows(runs, keys, objectives)), Table("Worst runs", head, worst)]
    words = f"Ranked by limits kept, then {objectives[0]}. Loop files of the worst runs are in the folder `worst`."
    return Section("Ranking", text=[words], tables=tables)


def _trade(runs: pd.DataFrame, vary: Mapping[str, Any], objectives: list[str]) -> Section:
    moved = next(name for name in runs.columns if name.startswith("motors.total_variation_"))
    pair = (objectives[0], objectives[1] if len(objectives) > 1 else moved)
    front = pareto_front(runs, pair)
    charts: list[Chart] = []
    if len(front):
        groups = {
            name: (part[pair[0]].to_numpy(float), part[pair[1]].to_numpy(float)) for name, part in _split(runs, vary)
        }
        edge = (front[pair[0]].to_numpy(float), front[pair[1]].to_numpy(float))
        caption = f"{len(front)} runs that no other beats in both."
        charts.append(pareto_chart(groups, edge, pair, "Pareto front", caption=caption))
    rows = [_row(row, list(vary), pair) for row in front.head(_MAX_ROWS).to_dict("records")]
    return Section("Pareto front", tables=[Table("On the front", study_head(list(vary), pair), rows)], charts=charts)


def _spread(runs: pd.DataFrame, vary: Mapping[str, Any], objectives: list[str]) -> Section:
    axis = objectives[0].partition(".")[0]
    keys = tuple(f"{axis}.{name}" for name in _KEY_METRICS)
    wanted = [*objectives, *(name for name in runs.columns if name.startswith(keys))]
    metrics = [name for name in dict.fromkeys(wanted) if np.isfinite(runs[name].to_numpy(float)).any()]
    values = {metric: {name: part[metric].to_numpy(float) for name, part in _split(runs, vary)} for metric in metrics}
    return Section("Distributions", charts=[distribution_chart(values, "Distributions of the metrics")])


def _influence(runs: pd.DataFrame, inputs: dict[str, np.ndarray], metric: str) -> Section:
    import pandas as pd

    y = runs[metric].to_numpy(float)
    # Spearman's rank correlation; NaN for a constant.
    ranked = pd.DataFrame({**inputs, metric: y}).corr(method="spearman", min_periods=3)[metric]
    found = dict(zip(inputs, np.asarray(ranked, dtype=np.float64).tolist(), strict=False))
    order = sorted(found, key=lambda key: -abs(np.nan_to_num(found[key])))
    rows = [[short_key(key), cell(found[key])] for key in order]
    broken = np.array(failures(runs)) | np.array([value is False for value in runs["holds"].tolist()])
    shown = {short_key(key): inputs[key] for key in order[:_MAX_PANELS]}
    chart = influence_chart(shown, (metric, y), broken, f"Influences on {metric}")
    table = Table(f"Rank correlation with {metric} (Spearman)", ["key", "correlation"], rows)
    return Section("Influence", tables=[table], charts=[chart])


def _split(runs: pd.DataFrame, vary: Mapping[str, Any]) -> list[tuple[str, pd.DataFrame]]:
    """Return the runs group_runs by the first key with names as values; else all together."""
    by = _groups(vary)
    if not by:
        return [("runs", runs)]
    return [(str(name), part) for name, part in runs.groupby(by[0], sort=False)]


def _groups(vary: Mapping[str, Any]) -> list[str]:
    """Return the keys whose values are a few names, such as controllers."""
    named = [key for key, item in vary.items() if item["labels"] and any(isinstance(x, str) for x in item["labels"])]
    return [key for key in named if len(vary[key]["labels"]) <= 12]


def _numbers(runs: pd.DataFrame, vary: Mapping[str, Any]) -> dict[str, np.ndarray]:
    numeric = [key for key, item in vary.items() if item["kind"] != "seed" and runs[key].dtype.kind in "biufc"]
    return {key: runs[key].to_numpy(float) for key in numeric}


def _row(row: Mapping[Any, Any], keys: Sequence[str], objectives: Sequence[str]) -> list[str]:
    import pandas as pd

    verdict = "fails" if row["error"] else "-" if pd.isna(row["holds"]) else "holds" if row["holds"] else "fails"
    return [str(row["run"]), *(cell(row[key]) for key in keys), *(cell(row[name]) for name in objectives), verdict]


def _range(item: Mapping[str, Any]) -> str:
    values = item["labels"] or item["values"]
    return ", ".join(cell(value) for value in values)
