"""What a project folder holds: every file that softneck knows, sorted; what cannot be read is said."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    KINDS,
    MOST_JSON,
    FileFormatError,
    Progress,
    SettingsError,
    SoftneckError,
    load,
    open_zip,
    read_archive,
    settings_text,
    silent,
)
from softneck.cosim import Result, is_loop_file, load_loop, python_of, read_description, read_runs, read_toml, simulate
from softneck.identification import bandwidth_of
from softneck.robot import FILE
from softneck.signals import Recording, assess_quality, doubts_in, import_log, read_layout, read_recording

# Folders that are no part of a project, beside those whose name begins with a dot.
_SKIPPED = ("__pycache__", "node_modules", "site-packages", "worst", "runs.parts")
# As an import names the layouts that it proposes.
_LAYOUT = ".layout.toml"
# Larger logs are no recordings to draw in a page that goes by mail.
_LARGEST = 200_000_000


@dataclass(slots=True, eq=False)
class Project:
    """The things of a project, by their path relative to its folder.

    Attributes:
        folder: of the project.
        recordings: path -> (recording, its quality).
        models, observers, controllers, families: path -> what `load` returns.
        fmus: path -> fmpy's description.
        certificates: path -> content.
        loops: path -> result of its run.
        studies: path of the folder -> (description, runs).
        doubts: path of a layout or robot file -> what was taken there without being sure.
        problems: path -> why it could not be read or run.
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
        """Whether nothing of ours was found."""
        found = (self.recordings, self.models, self.observers, self.controllers, self.families, self.fmus)
        return not any((*found, self.certificates, self.loops, self.studies, self.problems))


def read_project(folder: str | Path, *, progress: Progress = silent) -> Project:
    """Read all files of a project; loops are simulated unless they name Python, studies are taken as they stand.

    Args:
        folder: of the project.
        progress: called with the part done and a word.

    Raises:
        FileFormatError: no such folder, or nothing in it that softneck knows.
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
            if path.name.endswith(_LAYOUT) or path.name == FILE:
                if found := doubts_in(path):
                    project.doubts[name] = found
            else:
                _READERS[path.suffix.lower()](project, path, name)
        except SoftneckError as error:
            project.problems[name] = str(error).removeprefix(f"{path}: ")
    # What a loop of the project did in a simulation is no data: models would be judged on what they said themselves.
    for name, (recording, _) in list(project.recordings.items()):
        if any(_is_run_of(result, recording) for result in project.loops.values()):
            del project.recordings[name]
    if project.is_empty:
        raise FileFormatError(f"{root}: holds no softneck files; `softneck new {root}` begins a project.")
    return project


def _is_run_of(result: Result, recording: Recording) -> bool:
    """Return whether a recording is what `softneck simulate -o` wrote of a loop's run."""
    signals = result.signals.signals
    return all(
        name in signals
        and len(signals[name]) == len(recording)
        and np.allclose(signals[name], recording.channels[name], rtol=0.0, atol=1e-6)
        for name in recording.robot.set_points
    )


def _is_worst(entry: Path) -> bool:
    """Return whether a folder holds the worst plants of a certificate beside it, which says what was found on them."""
    stem = entry.name.removesuffix("_worst")
    return stem != entry.name and entry.with_name(f"{stem}.certificate.json").is_file()


def _is_front(entry: Path) -> bool:
    """Return whether a table is that of a search by `softneck tune`, whose folder says the same as JSON."""
    return entry.name == "pareto.csv" and entry.with_name("pareto.json").is_file()


def _files(root: Path) -> Iterator[Path]:
    """Yield files in the order of their names; a study's folder as its `study.json` alone."""
    entries = sorted(root.iterdir())
    if (root / "study.json").is_file() and _is_study(root / "study.json"):
        yield root / "study.json"
        entries = [entry for entry in entries if entry.is_dir()]
    for entry in entries:
        if entry.name.startswith(".") or entry.name in _SKIPPED or entry.is_symlink() or _is_worst(entry):
            continue
        if entry.is_dir():
            yield from _files(entry)
        elif entry.suffix.lower() in _READERS and not _is_front(entry):
            yield entry


def _loop(project: Project, path: Path, name: str) -> None:
    if is_loop_file(path):
        # Whoever asks for a page on a folder that somebody sent does not ask for what stands in it to run.
        named = next(python_of(read_toml(path)), "")
        if named:
            raise SettingsError(f"names Python (`{named}`), which a report never runs; `softneck simulate` does.")
        project.loops[name] = simulate(load_loop(path), report=lambda _: None, compiled=True)


def _recording(project: Project, path: Path, name: str) -> None:
    if path.stat().st_size > _LARGEST:
        project.problems[name] = f"larger than {_LARGEST / 1e6:.0f} MB: left out"
        return
    try:
        recording = read_recording(path)
    except SoftneckError:
        if _is_raw_log(path):
            return
        raise
    project.recordings[name] = (recording, assess_quality(recording, bandwidth=bandwidth_of(recording)))


def _is_raw_log(path: Path) -> bool:
    """Return whether a layout beside a table reads it: a logger's own, of which the project has the recording."""
    for layout in sorted(path.parent.glob(f"*{_LAYOUT}")):
        with contextlib.suppress(SoftneckError):
            import_log(path, read_layout(layout))
            return True
    return False


def _archive(project: Project, path: Path, name: str) -> None:
    header, _ = read_archive(path)
    role = {"family": project.families, "observer": project.observers, "controller": project.controllers}
    thing = load(path)
    if header.get("kind") != "loop_state" and hasattr(thing, "summary"):
        role.get(_role(str(header.get("kind"))), project.models)[name] = thing


def _role(kind: str) -> str:
    return KINDS[kind].role if kind in KINDS else ""


def _fmu(project: Project, path: Path, name: str) -> None:
    import fmpy

    try:
        open_zip(path).close()
        project.fmus[name] = fmpy.read_model_description(str(path), validate=False)
    except Exception as error:  # fmpy raises bare Exception
        raise FileFormatError(f"{path}: is not an FMU ({' '.join(str(error).split())}).") from error


def _json(project: Project, path: Path, name: str) -> None:
    if path.name == "study.json" and _is_study(path):
        description, runs = read_description(path.parent), read_runs(path.parent)
        project.studies[Path(name).parent.as_posix()] = (description, runs)
        return
    content = _content(path)
    if content.get("certificate"):
        project.certificates[name] = content


def _is_study(path: Path) -> bool:
    return "study" in _content(path)


def _content(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(settings_text(path, MOST_JSON))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


_READERS: dict[str, Callable[[Project, Path, str], None]] = {
    ".csv": _recording, ".parquet": _recording, ".npz": _archive, ".fmu": _fmu, ".json": _json,
    ".toml": _loop,
}  # fmt: skip
