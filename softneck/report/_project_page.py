"""The report of a whole project: one page that opens offline, for a colleague."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from softneck.core import Progress, SoftneckError, file_hash, required_rows, silent
from softneck.cosim import Result
from softneck.identification import INFINITE, Rules, judge, judged_parts
from softneck.plots import Chart, Section, Table, loop_chart, page, recording_chart, validation_chart
from softneck.robot import FILE

from ._project import Project
from ._study_page import study_sections
from ._validation_page import drawable

# Charts of one sort at most, so that the page stays small enough for mail; tables hold everything.
_MOST_CHARTS = 4
# Recordings on which each model is judged.
_MOST_DATA = 6
_HORIZONS: tuple[int | str, ...] = (1, 25, INFINITE)
_RULES = Rules(horizons=_HORIZONS)


def project_page(project: Project, *, progress: Progress = silent) -> str:
    """Return the HTML page of a project: what it holds, what that is worth, what held and what failed."""
    title = f"Project {project.folder.resolve().name}"
    sections = [_loops(project), _certificates(project), _data(project), _models(project, progress)]
    designs = _summaries("Observers and controllers", {**project.observers, **project.controllers})
    sections += [
        _summaries("Uncertain plant", project.families),
        designs,
        _fmus(project),
        *_studies(project),
        _problems(project),
    ]
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    kept = [section for section in sections if section is not None]
    sentence, holds = _sentence(project)
    return page(
        title, kept, verdict=sentence, holds=holds,
        footer=f"softneck report, {now}. All plots and tables are in this file.",
    )  # fmt: skip


def _sentence(project: Project) -> tuple[str, bool | None]:
    """Return what holds and what does not, and whether all does; None: nothing was asked of anything."""
    loops = [result for result in project.loops.values() if result.limits]
    held = sum(result.holds for result in loops)
    certified = sum(_certifies(content) for content in project.certificates.values())
    parts = [f"{held} of {len(loops)} loops keep their limits"] if loops else []
    if project.certificates:
        parts.append(f"{certified} of {len(project.certificates)} certificates hold")
    if project.problems:
        parts.append(f"{len(project.problems)} file(s) could not be read or run")
    unsure = "".join(f" Not sure of {what}: {_shortly(doubts)}." for what, doubts in _doubts(project).items())
    if not parts:
        return f"Nothing in this project states a limit, so nothing was judged.{unsure}", None
    good = held == len(loops) and certified == len(project.certificates) and not project.problems
    return f"{'; '.join(parts)}.".capitalize() + unsure, good


def _doubts(project: Project) -> dict[str, list[str]]:
    """Return what is not sure: of the logs, and of the robots."""
    found: dict[str, list[str]] = {}
    for name, doubts in project.doubts.items():
        found.setdefault("the robot" if Path(name).name == FILE else "the log", []).extend(doubts)
    return found


def _shortly(doubts: Sequence[str]) -> str:
    """Return the first doubt without its reason, and how many more there are."""
    more = f" and {len(doubts) - 1} more" if doubts[1:] else ""
    return f"{doubts[0].partition(' sure): ')[0]} sure){more}"


def _data(project: Project) -> Section | None:
    if not project.recordings:
        return None
    rows, findings, charts = [], [], []
    for name, (recording, found) in project.recordings.items():
        seconds = len(recording) * recording.sample_time
        rows.append([
            name, str(len(recording)), str(len(recording.runs())), f"{seconds:.1f}",
            f"{1e3 * recording.sample_time:g}", found.severity,
        ])  # fmt: skip
        findings += [[name, str(finding)] for finding in found.findings if finding.severity != "ok"]
        if len(charts) < _MOST_CHARTS:
            charts.append(recording_chart(recording, name))
    head = ["recording", "rows", "runs", "length [s]", "sample time [ms]", "worst finding"]
    tables = [Table("Recordings", head, rows)]
    if findings:
        tables.append(Table("What was found in them", ["recording", "finding"], findings, text=2))
    unsure = [[name, doubt] for name, found in project.doubts.items() for doubt in found]
    if unsure:
        tables.insert(0, Table("What is not sure", ["file", "taken"], unsure, text=2))
    return Section("Data", tables=tables, charts=charts)


def _models(project: Project, progress: Progress) -> Section | None:
    if not project.models:
        return None
    rows, charts, texts = [], [], []
    judged_on = list(project.recordings.items())[:_MOST_DATA]
    # What stands beside a model is the same for all that have seen the same rows: it takes longer than to judge one.
    baselines: dict[str, dict[bytes, Any]] = {data: {} for data, _ in judged_on}
    for number, (name, model) in enumerate(project.models.items()):
        texts.append([name, getattr(model, "kind", type(model).__name__), *_first_lines(model)])
        for count, (data, (recording, _)) in enumerate(judged_on):
            progress((number + count / len(judged_on)) / len(project.models), f"{name} on {data}")
            try:
                parts = judged_parts(model, recording, _RULES, baselines[data])
                result = judge(model, parts, _RULES, names=(name, data))
            except (SoftneckError, AttributeError):
                # Another sample time, or nothing left that the model was not trained on.
                continue
            rows.append([f"{name} on {data}", str(result.rows_scored), *_fits(result)])
            if len(charts) < _MOST_CHARTS:
                charts.append(_judged(result, f"{name} on {data}: free run"))
    tables = [Table("Models", ["model", "kind", "summary"], texts, text=3)]
    if rows:
        outputs = judged_on[0][1][0].robot.outputs  # a project is of one robot
        head = ["model on data", "rows judged", "one step", "25 steps", "free run",
                f"rms free [{outputs.display_unit}]", "persistence, one step"]  # fmt: skip
        title = f"Fits in %, {'/'.join(outputs.names)}, on rows that the model was not trained on"
        tables.append(Table(title, head, rows))
    words = [] if rows else ["No recording of this project has rows on which a model can be judged."]
    if len(project.recordings) > _MOST_DATA:
        words.append(f"Judged on the first {_MOST_DATA} of {len(project.recordings)} recordings.")
    return Section("Models", text=words, tables=tables, charts=charts)


def _fits(result: Any) -> list[str]:
    cells = [_pair(result.fits[str(h)], 1) for h in _HORIZONS]
    return [*cells, _pair(result.rmse_deg[INFINITE], 2), _pair(result.persistence["1"], 1)]


def _judged(result: Any, title: str) -> Chart:
    return validation_chart(
        result.time, result.measured, {"free run": drawable(result, result.free_run)}, title, run=result.run,
        robot=result.robot,
    )  # fmt: skip


def _summaries(title: str, things: Mapping[str, Any]) -> Section | None:
    if not things:
        return None
    rows = [[name if not i else "", line] for name, thing in things.items() for i, line in enumerate(_lines(thing))]
    return Section(title, tables=[Table(title, ["file", "summary"], rows, text=2)])


def _lines(thing: Any) -> list[str]:
    return [line for line in str(thing.summary()).splitlines() if line.strip()] or ["-"]


def _first_lines(thing: Any) -> list[str]:
    return ["; ".join(_lines(thing)[:2])[:200]]


def _certificates(project: Project) -> Section | None:
    if not project.certificates:
        return None
    rows, details = [], []
    for name, content in project.certificates.items():
        stale = _changed(project.folder, name, content)
        asked = required_rows(content)
        verdict = "holds" if _certifies(content) else "fails"
        rows.append([name, str(content["certificate"]), str(len(asked)), ", ".join(stale) or "none", verdict])
        details += [_requirement(name, row) for row in asked]
    head = ["certificate", "of", "requirements", "files changed since", "verdict"]
    tables = [Table("Certificates", head, rows, text=2)]
    if details:
        tables.append(
            Table("What was required", ["certificate", "metric", "value", "limit", "verdict"], details, text=2)
        )
    return Section("Verification", tables=tables)


def _certifies(content: Mapping[str, Any]) -> bool:
    """Return whether a certificate asks for something and says that all of it held."""
    return bool(content.get("holds")) and bool(required_rows(content))


def _requirement(name: str, row: Mapping[str, Any]) -> list[str]:
    held = row.get("holds", False)
    verdict = "holds" if held else "not computed" if held is None else "fails"
    return [name, str(row.get("metric", "")), _cell(row.get("value")), _cell(row.get("limit")), verdict]


def _changed(folder: Path, name: str, content: Mapping[str, Any]) -> list[str]:
    """Return the files of a certificate that are there and are no longer what they were."""
    changed = []
    for entry in content.get("files", {}).values():
        path = Path(str(entry.get("path", "")))
        places = [path, folder / path, (folder / name).parent / path]
        there = next((place for place in places if place.is_file()), None)
        if there is not None and file_hash(there) != entry.get("sha256"):
            changed.append(path.name)
    return changed


def _fmus(project: Project) -> Section | None:
    if not project.fmus:
        return None
    rows = []
    for name, model in project.fmus.items():
        counts = [str(sum(v.causality == c for v in model.modelVariables)) for c in ("input", "output", "parameter")]
        rows.append([name, f"FMI {model.fmiVersion}", " ".join((model.description or "").split())[:120], *counts])
    head = ["FMU", "version", "what it is", "inputs", "outputs", "parameters"]
    return Section("FMUs", tables=[Table("FMUs", head, rows, text=3)])


def _loops(project: Project) -> Section | None:
    if not project.loops:
        return None
    metrics, limits, charts = [], [], []
    for name, result in project.loops.items():
        metrics.append([name, *_metrics(result)])
        for row in result.limits:
            verdict = "holds" if row["holds"] else "fails"
            limits.append([name, row["metric"], _cell(row["value"]), _cell(row["limit"]), verdict])
        if len(charts) < _MOST_CHARTS:
            signals = result.signals
            charts.append(loop_chart(signals.time, signals.signals, name, limits=result.bounds, robot=result.robot))
    robot = next(iter(project.loops.values())).robot  # a project is of one
    head = ["loop", "overshoot [%]", "settling [s]", f"rms error [{robot.outputs.display_unit}]",
            f"largest set-point [{robot.motors.unit}]"]  # fmt: skip
    tables = [Table(f"Loops, {'/'.join(robot.outputs.names)}", head, metrics)]
    if limits:
        tables.append(Table("Limits", ["loop", "metric", "value", "limit", "verdict"], limits, text=2))
    return Section("Loops", tables=tables, charts=charts, method=["Run anew for this page."])


def _metrics(result: Result) -> list[str]:
    """Return what the head of `_loops` says; names of metrics end in the robot's units."""
    axes = [result.metrics[axis] for axis in result.robot.outputs.names]
    cells = [
        _pair(dict(enumerate(value for table in axes for name, value in table.items() if name.startswith(start))), 2)
        for start in ("overshoot_pct", "settling_s", "rms_error_")
    ]
    return [*cells, _cell(next(v for name, v in result.metrics["motors"].items() if name.startswith("max_")))]


def _studies(project: Project) -> list[Section]:
    sections = []
    for name, (description, runs) in project.studies.items():
        for part in study_sections(description, runs) if len(runs) else []:
            sections.append(replace(part, title=f"Study {name}: {part.title}"))
    return sections


def _problems(project: Project) -> Section | None:
    if not project.problems:
        return None
    rows = [[name, " ".join(text.split())[:300]] for name, text in project.problems.items()]
    table = Table("Files that could not be read or run", ["file", "why"], rows, text=2)
    return Section("Problems", tables=[table])


def _pair(values: Mapping[Any, float | None], digits: int) -> str:
    return "/".join("-" if value is None else f"{value:.{digits}f}" for value in values.values())


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
