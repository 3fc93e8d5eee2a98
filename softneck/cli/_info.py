"""softneck info: type and content of a file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck import cosim, drives, identification, loop, plant, signals
from softneck.core import (
    CERTIFICATE_KINDS,
    KINDS,
    MOST_JSON,
    DataError,
    FileFormatError,
    SettingsError,
    file_hash,
    fitting,
    is_archive,
    load,
    open_zip,
    read_archive,
    read_certificate,
    read_toml,
    refuse_existing,
    require_file,
    settings_text,
)

from .shared._console import print_json, progress
from .shared._options import common_options

if TYPE_CHECKING:
    from softneck.drives.master import Frame


def describe_log(file: Path) -> dict[str, Any]:
    """Return the content of a drives log: cycles, frames, duration, nodes, first error, and its cut."""
    log = drives.read_run_log(file)
    cycles, frames = log.cycles, log.frames()
    begin = cycles[0].time if cycles else 0.0
    settings, files = log.settings(), log.facts.get("files", {})
    fault = next((f"t = {time - begin:.3f} s: {text}" for time, name, text in log.events if _stops(name)), "")
    return {
        "type": "log of a run on drives" + (" (simulated)" if log.facts.get("simulated") else ""),
        "cycles": len(cycles),
        "cycle_s": settings.bus.cycle,
        "frames": len(frames),
        "duration_s": round(frames[-1][0] - frames[0][0], 6) if frames else 0.0,
        "nodes": ", ".join(str(node) for node in settings.bus.nodes),
        "samples": len(log.rows),
        "phase": cycles[-1].phase if cycles else "none",
        "first_error": fault or _first_error(frames) or "none",
        "files": ", ".join(f"{role} {entry.get('path')}" for role, entry in files.items()) or "none",
        "cut": log.cut or "no",
        "replay": f"softneck simulate {file}",
        "import": f"softneck import {file} -o {file.stem}.csv",
    }


def _stops(name: str) -> bool:
    rule = drives.RULES.get(name)
    return rule is not None and rule.reaction in (drives.Reaction.STOP, drives.Reaction.RETREAT)


def _first_error(frames: Sequence[tuple[float, bool, Frame]]) -> str:
    from softneck.drives import meaning

    for time, _, frame in frames:
        emergency = frame.identifier & 0x780 == 0x80 and frame.identifier != 0x80 and any(frame.data[:2])
        if frame.error or emergency:
            return f"t = {time - frames[0][0]:.3f} s: {meaning(frame)}"
    return ""


_RECORDING_SUFFIXES = (".csv", ".parquet")
# Reading and checking a smaller file takes under 2 s; 9 MB, 300,000 rows of one motor, take 15 s.
_LARGE_FILE_BYTES = 1_000_000


@click.command("info", epilog="Example: softneck info eq22.csv --html quality.html")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--html", type=click.Path(path_type=Path), metavar="FILE", help="Page on a recording's quality.")
@common_options("force")
def command(file: Path, html: Path | None, force: bool, as_json: bool) -> None:
    """Show the type and content of FILE: a recording, model, observer, controller, FMU, SSP, loop, layout, robot, neck,
    study, certificate or log (tables, and those of `softneck drives run --log`).

    For a recording it also reports the quality: faults of its channels, and whether its inputs excite the robot
    enough. For a log it reports the channel that `softneck import --guess` would take each column for.
    """
    require_file(file)
    if html is not None:
        if file.suffix.lower() not in _RECORDING_SUFFIXES:
            raise SettingsError(f"{file}: `--html` shows the quality of a recording (`.csv`, `.parquet`) only.")
        refuse_existing(html, force=force)
    described = _describe(file, html, force=force, quiet=as_json)
    found = described.pop("quality", None)
    facts = {"file": str(file), **described, "sha256": file_hash(file)}
    if as_json:
        print_json(facts if found is None else {**facts, "quality": found.as_dict()})
        return
    for key, value in facts.items():
        lines = value.splitlines() if isinstance(value, str) else value
        text = "\n  ".join(lines) if isinstance(lines, list) else value
        click.echo(f"{key}: {text}")
    if found is not None:
        click.echo("\nquality:")
        for line in found.lines():
            click.echo(f"  {line}" if line else "")


def _describe(file: Path, html: Path | None, *, force: bool, quiet: bool) -> dict[str, Any]:
    match file.suffix.lower():
        case ".csv" | ".parquet":
            from softneck.signals import robot_in_file

            try:
                return _recording(file, html, force=force, quiet=quiet)
            except (DataError, FileFormatError) as error:
                # What says whose recording it is cannot be a logger's table.
                if robot_in_file(file, file.suffix.lower()) is not None:
                    raise
                return _log(file, html, error)
        case ".npz" if is_archive(file):
            header, _ = read_archive(file)
            thing = load(file)
            with fitting(file):
                summary = thing.summary()
            kind = header["kind"]
            return {"type": KINDS[kind].role if kind in KINDS else kind, "kind": kind, "summary": summary}
        case ".fmu":
            return _fmu(file)
        case ".ssp":
            return _ssp(file)
        case ".toml":
            return _toml(file)
        case ".json":
            return _certificate(file)
        case ".mcap":
            from softneck.signals import is_run_log

            return describe_log(file) if is_run_log(file) else _log(file, html, None)
        case _:
            return _log(file, html, None)


def _recording(file: Path, html: Path | None, *, force: bool, quiet: bool) -> dict[str, Any]:
    """Return the content and quality of a recording, and write the page."""
    quick = html is None and file.stat().st_size < _LARGE_FILE_BYTES
    with progress("info", quiet=quiet or quick) as report:
        report(0.0, "reading")
        recording = signals.read_recording(file)
        report(0.6, "checking")
        found = signals.assess_quality(recording, bandwidth=identification.bandwidth_of(recording))
        if html is not None:
            from softneck.plots import quality_page, write_page  # matplotlib takes a while to import

            report(0.8, "drawing")
            write_page(html, quality_page(recording, found, f"Quality of {file.name}"), force=force)
    return {
        "type": "recording",
        "rows": len(recording),
        "runs": len(recording.runs()),
        "duration_s": len(recording) * recording.sample_time,
        "sample_time_s": recording.sample_time,
        "channels": ", ".join(recording.channels),
        **({} if html is None else {"html": str(html)}),
        **({"robot": recording.robot.label()} if recording.robot.in_header() else {}),
        "quality": found,
    }


def _log(file: Path, html: Path | None, error: DataError | FileFormatError | None) -> dict[str, Any]:
    """Return the guessed content of a log; `error` is the reason that it is no recording."""
    try:
        other = signals.is_of_another_robot(file)
        guess = signals.guess_robot(file) if other else signals.guess_layout(file)
    except (DataError, FileFormatError) as reason:
        if error is not None:
            foreign = isinstance(error.__cause__, signals.ForeignColumnError)
            raise (reason if foreign else error) from None
        raise FileFormatError(
            f"{file}: by its ending not a file of softneck, nor is it a log ({str(reason).removeprefix(f'{file}: ')})"
        ) from reason
    missing = guess.missing if isinstance(guess, signals.Guess) else ()
    if error is not None and isinstance(guess, signals.Guess) and _is_titled(guess):
        raise error
    if html is not None:
        raise SettingsError(f"{file}: `--html` shows the quality of a recording, and this is a log; import it first.")
    return {
        "type": "log",
        "columns": list(guess.lines),
        "missing": list(missing) or "nothing that a recording needs",
        "import": f"softneck import {file} --guess -o {file.stem}.recording.csv",
    }


def _is_titled(guess: signals.Guess) -> bool:
    """Whether a table has the form and the titles of a recording: a fault in it is for its user to fix."""
    titled = [line for line in guess.lines if "titled as in a recording" in line]
    return guess.layout.form == signals.Layout(channels={}).form and len(titled) > 0


def _fmu(file: Path) -> dict[str, Any]:
    import fmpy

    try:
        open_zip(file).close()
        description = fmpy.read_model_description(str(file), validate=False)
    except FileFormatError:
        raise
    except Exception as error:  # fmpy raises bare Exception
        raise FileFormatError(
            f"{file}: is not an FMU ({str(error).splitlines()[0] if str(error) else error!r})."
        ) from error
    by_causality = {
        f"{causality}s": ", ".join(cosim.shown_name(v) for v in description.modelVariables if v.causality == causality)
        for causality in ("input", "output", "parameter")
    }
    return {
        "type": "FMU",
        "model": description.modelName,
        "fmi_version": description.fmiVersion,
        "interfaces": ", ".join(cosim.interfaces_of(description)),
        "description": description.description or "",
        "tool": description.generationTool or "",
        **by_causality,
    }


def _toml(file: Path) -> dict[str, Any]:
    """Describe a TOML file by its keys: robot, loop, study, layout, otherwise a neck."""
    from softneck.robot import Robot

    table = read_toml(file)
    if table.keys() & {"motors", "outputs", "directions", "extends"}:
        robot = Robot.read(file)
        return {"type": "robot", "robot": robot.name, "hash": robot.hash, "summary": robot.summary()}
    if "plant" in table:
        if not next(cosim.find_python(table), ""):  # nothing of a file that is only asked about is run
            cosim.load_loop(file)
        return {"type": "loop", "parts": ", ".join(name for name in table if isinstance(table[name], dict))}
    if "vary" in table:
        study = cosim.load_study(file)
        return {"type": "study", "runs": len(study.points), "varies": ", ".join(study.vary)}
    if "channels" in table:
        layout = signals.read_layout(file)
        tilt = ["pitch, roll (from the tilt)"] if layout.inclination else []
        return {"type": "layout", "channels": ", ".join([*layout.channels, *tilt])}
    neck = plant.NeckParameters.from_toml(file)
    return {"type": "neck", "summary": plant.VirtualNeck(neck).summary()}


def _certificate(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(settings_text(file, MOST_JSON))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{file}: is not a JSON file ({error}).") from error
    if not isinstance(content, dict):
        raise FileFormatError(f"{file}: holds no JSON object, so it is not a softneck file.")
    if content.get("certificate") not in CERTIFICATE_KINDS:
        return {"type": "JSON", "keys": ", ".join(content)}
    said = {"type": "certificate", "of": f"softneck {content['certificate']}"}
    try:
        certificate = read_certificate(file)
    except FileFormatError as error:
        return {**said, "seal": f"not genuine: {str(error).removeprefix(f'{file}: ')}"}
    return {
        **said,
        "seal": "genuine",
        "holds": certificate.holds,
        "requirements": [
            f"{row.get('metric')}: {row.get('value')}, limit {row.get('limit')}"
            + ("" if row.get("holds") else ", does not hold")
            for row in certificate.rows
        ],
        "files": [f"{role}: {path}" for role, (path, _) in certificate.files.items()],
    }


def _ssp(file: Path) -> dict[str, Any]:
    """Return the parts of an SSP archive; raise the error of `simulate` if it cannot run."""
    read = cosim.load_ssp(file)
    if isinstance(read, loop.System):
        return {"type": "SSP", "system": "no closed loop", "parts": ", ".join(read.parts)}
    return {"type": "SSP", "system": "closed loop", "robot": read.loop.robot.label()}
