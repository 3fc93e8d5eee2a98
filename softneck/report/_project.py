"""The report of a project folder: all files that softneck can read, and one page on them that opens offline."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
from markupsafe import Markup

from softneck.core import (
    KINDS,
    MOST_JSON,
    FileFormatError,
    Progress,
    SettingsError,
    SoftneckError,
    certifies,
    file_hash,
    load,
    open_zip,
    read_archive,
    read_toml,
    required_rows,
    settings_text,
    silent,
)
from softneck.cosim import Result, find_python, is_loop_file, load_loop, read_runs, read_study_description, simulate
from softneck.identification import INFINITE, Rules, bandwidth_of, judge, judged_parts
from softneck.plots import Section, Table, cell, loop_chart, page, recording_chart, validation_chart
from softneck.robot import ROBOT_FILE
from softneck.signals import Recording, assess_quality, doubts_in, import_log, read_layout, read_recording
from softneck.verification import certificate_values, metric_words

from ._decisions import model_values, project_decision
from ._study_page import kept_runs, study_sections
from ._validation_page import drawable

# Folders that do not belong to a project, like those whose name begins with a dot.
_SKIPPED_FOLDERS = ("__pycache__", "node_modules", "site-packages", "worst")
# Ending of the layouts that an import proposes.
_LAYOUT_ENDING = ".layout.toml"
# [bytes] Larger logs are not drawn, so that the page remains small enough for mail.
_MAX_LOG_BYTES = 200_000_000


@dataclass(slots=True, eq=False)
class Project:
    """Contents of a project, by path relative to its folder.

    `recordings`: path -> (recording, its quality). `models`, `observers`, `controllers`, `families`: path -> what
    `load` returns. `fmus`: path -> fmpy's description. `loops`: path -> result of its simulation. `studies`: path of
    the folder -> (description, runs). `doubts`: path of a layout or robot file -> its uncertain decisions. `problems`:
    path -> reason why it could not be read or run.
    """

    folder: Path
    recordings: dict[str, Any] = field(default_factory=dict)
    models: dict[str, Any] = field(default_factory=dict)
    observers: dict[str, Any] = field(default_factory=dict)
    controllers: dict[str, Any] = field(default_factory=dict)
    families: dict[str, Any] = field(default_factory=dict)
    fmus: dict[str, Any] = field(default_factory=dict)
    certificates: dict[str, Any] = field(default_factory=dict)
    loops: dict[str, Any] = field(default_factory=dict)
    studies: dict[str, Any] = field(default_factory=dict)
    doubts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether the folder has no softneck file."""
        found = (self.recordings, self.models, self.observers, self.controllers, self.families, self.fmus)
        return not any((*found, self.certificates, self.loops, self.studies, self.problems))


def read_project(folder: str | Path, *, progress: Progress = silent) -> Project:
    """Read all files of a project; loops are simulated, except those that name Python code.

    Raises:
        FileFormatError: no such folder, or no softneck file in it.
    """
    root = Path(folder)
    if not root.is_dir():
        raise FileFormatError(f"{root}: is not a folder; name that of a project.")
    project = Project(root)
    files = list(_files(root))
    for number, path in enumerate(files):
        name = path.relative_to(root).as_posix()
        progress(number / len(files), name)
        try:
            if path.name.endswith(_LAYOUT_ENDING) or path.name == ROBOT_FILE:
                if found := doubts_in(path):
                    project.doubts[name] = found
            else:
                _READERS[path.suffix.lower()](project, path, name)
        except SoftneckError as error:
            project.problems[name] = str(error).removeprefix(f"{path}: ")
    # A simulated loop is no data: its model would be judged on its own output.
    for name, (recording, _) in list(project.recordings.items()):
        if any(_is_run_of(result, recording) for result in project.loops.values()):
            del project.recordings[name]
    if project.is_empty:
        raise FileFormatError(f"{root}: holds no softneck files; `softneck new {root}` begins a project.")
    return project


def _is_run_of(result: Result, recording: Recording) -> bool:
    """Return whether a recording is the result of a loop, written by `softneck simulate -o`."""
    signals = result.signals.signals
    return all(
        name in signals
        and len(signals[name]) == len(recording)
        and np.allclose(signals[name], recording.channels[name], rtol=0.0, atol=1e-6)
        for name in recording.robot.set_points
    )


def _is_worst(entry: Path) -> bool:
    """Return whether a folder holds the worst plants of a certificate, which has their results."""
    stem = entry.name.removesuffix("_worst")
    return stem != entry.name and entry.with_name(f"{stem}.certificate.json").is_file()


def _files(root: Path) -> Iterator[Path]:
    """Yield files sorted by name; of a study's folder only `study.json`."""
    entries = sorted(root.iterdir())
    if "study" in _content(root / "study.json"):
        yield root / "study.json"
        entries = [entry for entry in entries if entry.is_dir()]
    for entry in entries:
        if entry.name.startswith(".") or entry.name in _SKIPPED_FOLDERS or entry.is_symlink() or _is_worst(entry):
            continue
        if entry.is_dir():
            yield from _files(entry)
        # The front of `softneck tune` is in its folder as JSON too.
        elif entry.suffix.lower() in _READERS and (entry.name != "pareto.csv" or not (root / "pareto.json").is_file()):
            yield entry


def _read_loop(project: Project, path: Path, name: str) -> None:
    if is_loop_file(path):
        # A report on a received folder must not run code in it.
        named = next(find_python(read_toml(path)), "")
        if named:
            raise SettingsError(f"names Python (`{named}`), which a report never runs; `softneck simulate` does.")
        project.loops[name] = simulate(load_loop(path), report=lambda _: None, compiled=True)


def _read_recording(project: Project, path: Path, name: str) -> None:
    if path.stat().st_size > _MAX_LOG_BYTES:
        project.problems[name] = f"larger than {_MAX_LOG_BYTES / 1e6:.0f} MB: left out"
        return
    try:
        recording = read_recording(path)
    except SoftneckError:
        if _is_raw_log(path):
            return
        raise
    project.recordings[name] = (recording, assess_quality(recording, bandwidth=bandwidth_of(recording)))


def _is_raw_log(path: Path) -> bool:
    """Return whether a table is a raw log: a layout beside it reads it, and the project has the recording."""
    for layout in sorted(path.parent.glob(f"*{_LAYOUT_ENDING}")):
        with contextlib.suppress(SoftneckError):
            import_log(path, read_layout(layout))
            return True
    return False


def _read_archive(project: Project, path: Path, name: str) -> None:
    header, _ = read_archive(path)
    role = {"family": project.families, "observer": project.observers, "controller": project.controllers}
    thing = load(path)
    if hasattr(thing, "summary"):
        kind = str(header.get("kind"))
        role.get(KINDS[kind].role if kind in KINDS else "", project.models)[name] = thing


def _read_fmu(project: Project, path: Path, name: str) -> None:
    import fmpy

    try:
        open_zip(path).close()
        project.fmus[name] = fmpy.read_model_description(str(path), validate=False)
    except Exception as error:  # fmpy raises bare Exception
        raise FileFormatError(f"{path}: is not an FMU ({' '.join(str(error).split())}).") from error


def _read_json(project: Project, path: Path, name: str) -> None:
    if path.name == "study.json" and "study" in _content(path):
        description, runs = read_study_description(path.parent), read_runs(path.parent)
        project.studies[Path(name).parent.as_posix()] = (description, runs)
        return
    content = _content(path)
    if content.get("certificate"):
        project.certificates[name] = content


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(settings_text(path, MOST_JSON))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


_READERS: dict[str, Callable[[Project, Path, str], None]] = {
    ".csv": _read_recording, ".parquet": _read_recording, ".npz": _read_archive, ".fmu": _read_fmu, ".json": _read_json,
    ".toml": _read_loop,
}  # fmt: skip


# Charts of one sort, so that the page remains small enough for mail; tables are complete.
_MAX_CHARTS = 4
# Recordings for the validation of each model.
_MAX_RECORDINGS = 6
_HORIZONS: tuple[int | str, ...] = (1, 25, INFINITE)
_RULES = Rules(horizons=_HORIZONS)


def project_page(project: Project, *, place: Path | None = None, progress: Progress = silent) -> str:
    """Return the HTML page of a project: results of loops and certificates, data, models, and problems.

    `place`: folder of the page, from which it links the other pages of the project; None: no links.
    """
    designs = {**project.observers, **project.controllers}
    parts = (
        (project.loops, lambda: _loops(project)),
        (project.certificates, lambda: _certificates(project)),
        (project.recordings, lambda: _data(project)),
        (project.models, lambda: _models(project, progress)),
        (project.families, lambda: _summaries("Uncertain plant", project.families)),
        (designs, lambda: _summaries("Observers and controllers", designs)),
        (project.fmus, lambda: _fmus(project)),
    )
    sections = [*(make() for content, make in parts if content), *_studies(project)]
    if place is not None and sections and (links := _links(project.folder, place)):
        sections[0] = replace(sections[0], html=links)
    if project.problems:
        rows = [[name, shorten(text, 300, placeholder=" ...")] for name, text in project.problems.items()]
        table = Table("Files that could not be read or run", ["file", "why"], rows, text=2)
        sections.append(Section("Problems", tables=[table]))
    now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    sentence, holds = project_verdict(project)
    footer = f"softneck report, {now}. All plots and tables are in this file."
    title = f"Project {project.folder.resolve().name}"
    return page(title, sections, verdict=sentence, holds=holds, footer=footer)


_TUNER = "tuner.html"


def _pages(folder: Path) -> list[Path]:
    """Return the other pages of a project, `tuner.html` first."""
    found = [
        path
        for path in sorted(folder.rglob("*.html"))
        if not any(part in _SKIPPED_FOLDERS or part.startswith(".") for part in path.relative_to(folder).parts)
    ]
    return sorted(found, key=lambda path: path.name != _TUNER)


def _links(folder: Path, place: Path) -> Markup:
    """Return a line of links to the other pages of a project."""
    link = Markup('<a href="{}">{}</a>')
    pages = [path for path in _pages(folder) if path.resolve() != (place / "report.html").resolve()]
    each = [
        link.format(Path(os.path.relpath(path, place)).as_posix(), path.relative_to(folder).as_posix())
        for path in pages
    ]
    return Markup("<p>Pages: {}</p>").format(Markup(", ").join(each)) if each else Markup("")


def decision_values(project: Project) -> dict[str, Any]:
    """Return the JSON values from which a project's page decides, and the decision."""
    models = [model_values(name, model) for name, model in project.models.items()]
    certificates = [certificate_values(name, content) for name, content in project.certificates.items()]
    pages = [path.relative_to(project.folder).as_posix() for path in _pages(project.folder)]
    tuner = pages[0] if pages and Path(pages[0]).name == _TUNER else None
    return {"judged_models": models, "verified": certificates, "tuner": tuner,
            "decision": project_decision(models, certificates, tuner=tuner)}  # fmt: skip


def project_verdict(project: Project) -> tuple[str, bool | None]:
    """Return the decision, sentences on limits and certificates, and whether all hold; None without any."""
    decision = decision_values(project)["decision"]
    loops = [result for result in project.loops.values() if result.limits]
    held = sum(result.holds for result in loops)
    certified = sum(certifies(content) for content in project.certificates.values())
    parts = [f"{held} of {len(loops)} loops keep their limits"] if loops else []
    if project.certificates:
        parts.append(f"{certified} of {len(project.certificates)} certificates hold")
    parts += [f"study {name}: {kept_runs(runs)}" for name, (_, runs) in project.studies.items() if len(runs)]
    if project.problems:
        parts.append(f"{len(project.problems)} file(s) could not be read or run")
    unsure = "".join(f" Not sure of {what}: {_shorten(doubts)}." for what, doubts in _doubts(project).items())
    if not parts:
        return f"{decision} No file of this project states a limit, so there is no verdict.{unsure}".lstrip(), None
    # A log that needs a layout stops nobody; a certificate, model or loop that cannot be read may be one that fails.
    damaged = [name for name in project.problems if _READERS[Path(name).suffix.lower()] is not _read_recording]
    good = held == len(loops) and certified == len(project.certificates) and not damaged
    said = f"{'; '.join(parts)}."
    return f"{decision} {said[0].upper()}{said[1:]}{unsure}".lstrip(), good if loops or project.certificates else None


def _doubts(project: Project) -> dict[str, list[str]]:
    """Return the doubts about the logs and the robots."""
    found: dict[str, list[str]] = {}
    for name, doubts in project.doubts.items():
        found.setdefault("the robot" if Path(name).name == ROBOT_FILE else "the log", []).extend(doubts)
    return found


def _shorten(doubts: Sequence[str]) -> str:
    """Return the first doubt without its reason, and the number of others."""
    more = f" and {len(doubts) - 1} more" if doubts[1:] else ""
    return f"{doubts[0].partition(' sure): ')[0]} sure){more}"


def _data(project: Project) -> Section:
    rows, findings, charts = [], [], []
    for name, (recording, found) in project.recordings.items():
        seconds = len(recording) * recording.sample_time
        rows.append([
            name, str(len(recording)), str(len(recording.runs())), f"{seconds:.1f}",
            f"{1e3 * recording.sample_time:g}", found.severity,
        ])  # fmt: skip
        findings += [[name, str(finding)] for finding in found.findings if finding.severity != "ok"]
        if len(charts) < _MAX_CHARTS:
            charts.append(recording_chart(recording, name))
    head = ["recording", "rows", "runs", "length [s]", "sample time [ms]", "worst finding"]
    tables = [Table("Recordings", head, rows)]
    if findings:
        tables.append(Table("Findings", ["recording", "finding"], findings, text=2))
    unsure = [[name, doubt] for name, found in project.doubts.items() for doubt in found]
    if unsure:
        tables.insert(0, Table("Uncertain decisions", ["file", "decision"], unsure, text=2))
    return Section("Data", tables=tables, charts=charts)


def _models(project: Project, progress: Progress) -> Section:
    rows, charts, texts = [], [], []
    judged_on = list(project.recordings.items())[:_MAX_RECORDINGS]
    # Baselines depend only on the judged rows and take longer than a model, so models with the same rows share them.
    baselines: dict[str, dict[bytes, Any]] = {data: {} for data, _ in judged_on}
    for number, (name, model) in enumerate(project.models.items()):
        summary = shorten("; ".join(_lines(model)[:2]), 200, placeholder=" ...")
        texts.append([name, getattr(model, "kind", type(model).__name__), summary])
        for count, (data, (recording, _)) in enumerate(judged_on):
            progress((number + count / len(judged_on)) / len(project.models), f"{name} on {data}")
            try:
                parts = judged_parts(model, recording, _RULES, baselines[data])
                result = judge(model, parts, _RULES, names=(name, data))
            except (SoftneckError, AttributeError):
                # Another sample time, or only rows that the model was trained on.
                continue
            fits = [cell(result.fits[str(h)], ".1f") for h in _HORIZONS]
            fits += [cell(result.rmse_deg[INFINITE], ".2f"), cell(result.persistence["1"], ".1f")]
            rows.append([f"{name} on {data}", str(result.rows_scored), *fits])
            if len(charts) < _MAX_CHARTS:
                free_run = {"simulation": drawable(result, result.free_run)}
                charts.append(validation_chart(
                    result.time, result.measured, free_run, f"{name} on {data}: simulation", run=result.run,
                    robot=result.robot,
                ))  # fmt: skip
    tables = [Table("Models", ["model", "kind", "summary"], texts, text=3)]
    if rows:
        outputs = judged_on[0][1][0].robot.outputs  # a project has one robot
        head = ["model on data", "rows judged", "one step", "25 steps", "simulation",
                f"rms simulation [{outputs.display_unit}]", "persistence, one step"]  # fmt: skip
        title = f"Fits in %, {'/'.join(outputs.names)}, on rows that the model was not trained on"
        tables.append(Table(title, head, rows))
    words = [] if rows else ["No recording of this project has rows on which a model can be judged."]
    if len(project.recordings) > _MAX_RECORDINGS:
        words.append(f"Judged on the first {_MAX_RECORDINGS} of {len(project.recordings)} recordings.")
    return Section("Models", text=words, tables=tables, charts=charts)


def _summaries(title: str, things: Mapping[str, Any]) -> Section:
    rows = [[name if not i else "", line] for name, thing in things.items() for i, line in enumerate(_lines(thing))]
    return Section(title, tables=[Table(title, ["file", "summary"], rows, text=2)])


def _lines(thing: Any) -> list[str]:
    return [line for line in str(thing.summary()).splitlines() if line.strip()] or ["-"]


def _certificates(project: Project) -> Section:
    rows, details = [], []
    for name, content in project.certificates.items():
        stale = _changed_files(project.folder, name, content)
        asked = required_rows(content)
        verdict = "holds" if certifies(content) else "fails"
        rows.append([name, str(content["certificate"]), str(len(asked)), ", ".join(stale) or "none", verdict])
        details += [_requirement(name, row) for row in asked]
    head = ["certificate", "of", "requirements", "files changed since", "verdict"]
    tables = [Table("Certificates", head, rows, text=2)]
    if details:
        of = "verify: the worst of all its plants, steps and directions; simulate: its one loop"
        tables.append(
            Table(f"Requirements ({of})", ["certificate", "metric", "value", "limit", "verdict"], details, text=2)
        )
    return Section("Verification", tables=tables)


def _requirement(name: str, row: Mapping[str, Any]) -> list[str]:
    held = row.get("holds", False)
    unknown = "not computed" if row.get("value") is None else "does not decide"
    verdict = "holds" if held else unknown if held is None else "fails"
    return [name, metric_words(str(row.get("metric", ""))), cell(row.get("value")), cell(row.get("limit")), verdict]


def _changed_files(folder: Path, name: str, content: Mapping[str, Any]) -> list[str]:
    """Return the files of a certificate that have changed since."""
    changed = []
    for entry in content.get("files", {}).values():
        path = Path(str(entry.get("path", "")))
        places = [path, folder / path, (folder / name).parent / path]
        there = next((place for place in places if place.is_file()), None)
        if there is not None and file_hash(there) != entry.get("sha256"):
            changed.append(path.name)
    return changed


def _fmus(project: Project) -> Section:
    rows = []
    for name, model in project.fmus.items():
        counts = [str(sum(v.causality == c for v in model.modelVariables)) for c in ("input", "output", "parameter")]
        rows.append(
            [name, f"FMI {model.fmiVersion}", shorten(model.description or "", 120, placeholder=" ..."), *counts]
        )
    head = ["FMU", "version", "description", "inputs", "outputs", "parameters"]
    return Section("FMUs", tables=[Table("FMUs", head, rows, text=3)])


def _loops(project: Project) -> Section:
    metrics, limits, charts = [], [], []
    for name, result in project.loops.items():
        metrics.append([name, *_metrics(result)])
        for row in result.limits:
            verdict = "holds" if row["holds"] else "fails"
            limits.append([name, metric_words(row["metric"]), cell(row["value"]), cell(row["limit"]), verdict])
        if len(charts) < _MAX_CHARTS:
            signals = result.signals
            charts.append(loop_chart(signals.time, signals.signals, name, limits=result.bounds, robot=result.robot))
    robot = next(iter(project.loops.values())).robot  # a project has one robot
    head = ["loop", "overshoot [%]", "settling [s]", f"rms error [{robot.outputs.display_unit}]",
            f"largest set-point [{robot.motors.unit}]"]  # fmt: skip
    tables = [Table(f"Loops, {'/'.join(robot.outputs.names)}", head, metrics)]
    if limits:
        tables.append(
            Table(
                "Limits, each of the one plant and reference of its loop",
                ["loop", "metric", "value", "limit", "verdict"],
                limits,
                text=2,
            )
        )
    return Section("Loops", tables=tables, charts=charts, method=["Simulated for this page."])


def _metrics(result: Result) -> list[str]:
    """Return the cells under the head of `_loops`; names of metrics end in the robot's units."""
    axes = [result.metrics[axis] for axis in result.robot.outputs.names]
    cells = [
        cell(dict(enumerate(v for table in axes for name, v in table.items() if name.startswith(start))), ".2f")
        for start in ("overshoot_pct", "settling_s", "rms_error_")
    ]
    return [*cells, cell(next(v for name, v in result.metrics["motors"].items() if name.startswith("max_")))]


def _studies(project: Project) -> list[Section]:
    sections = []
    for name, (description, runs) in project.studies.items():
        for part in study_sections(description, runs) if len(runs) else []:
            sections.append(replace(part, title=f"Study {name}: {part.title}"))
    return sections
