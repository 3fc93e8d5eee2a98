"""softneck import: a foreign log becomes a recording."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import DataError, SettingsError, atomic_write, refuse_existing

from .shared._console import note, print_json
from .shared._options import force_option, json_option, output_option, target

if TYPE_CHECKING:
    from softneck.robot import Robot
    from softneck.signals.importing._log import ImportResult


@click.command(
    "import",
    epilog="Example: softneck import log.csv --guess -o neck.csv, then edit neck.layout.toml and go on with "
    "softneck import log.csv --layout neck.layout.toml -o neck.csv --force",
)
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--layout", "layout_file", type=click.Path(path_type=Path), help="How to read the log.")
@click.option(
    "--robot",
    metavar="ROBOT",
    help="Whose log it is: a preset or a robot file.  [default: robot.toml beside the log or above it, else the neck]",
)
@click.option(
    "--robot-out",
    type=click.Path(path_type=Path),
    metavar="ROBOT.toml",
    help="Propose a robot by the log's titles, write it here, and import the log as its recording.",
)
@click.option("--guess", is_flag=True, help="Propose a layout, say why, and write it beside the recording.")
@output_option("recording", "REC")
@force_option
@json_option
def command(
    log: Path,
    layout_file: Path | None,
    robot: str | None,
    robot_out: Path | None,
    guess: bool,
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Turn any logger's table LOG into a recording, by a layout file or by a guess at one.

    The .mcap log of `softneck drives run --log` needs neither.
    """
    from softneck.robot import find_robot
    from softneck.signals import import_log, read_layout, write_recording
    from softneck.signals.recording._files import recording_suffix, said_robot

    if log.suffix.lower() == ".mcap":
        _run_log(log, output, force=force, as_json=as_json, layout=guess or layout_file is not None)
        return
    if log.suffix.lower() == ".blf":
        raise SettingsError(f"{log}: holds CAN frames only; import the `.mcap` log of the same run.")
    if robot_out is not None:
        if guess or layout_file is not None or robot is not None:
            raise SettingsError("--robot-out guesses robot and layout; leave out --guess, --layout and --robot.")
        if robot_out.suffix.lower() != ".toml":
            raise SettingsError(f"{robot_out}: must end in `.toml`, by which softneck recognises the file.")
        if (said := said_robot(log, log.suffix.lower())) is not None:
            raise SettingsError(f"{log}: is a recording of robot {said.label()} already, which commands take as it is.")
        guess = True
    if guess == (layout_file is not None):
        what = "both were given" if guess else "neither was given"
        raise SettingsError(f"import needs either --layout LAYOUT.toml or --guess; {what}.")
    path, replace = target(output, f"recordings/{log.stem}.csv", force=force)
    recording_suffix(path)
    refuse_existing(path, force=replace)
    facts: dict[str, Any] = {}
    whose = find_robot(robot, beside=log)
    if robot_out is not None or (layout_file is None and not whose.is_neck):
        imported, facts = _of_robot(log, path, whose, robot_out, (replace, force))
    elif layout_file is None:
        imported, facts = _by_guess(log, path, replace)
    else:
        imported = import_log(log, read_layout(layout_file, robot=whose))
    write_recording(path, imported.recording, force=replace)
    _tell(path, imported, facts, as_json)


def _run_log(log: Path, output: Path | None, *, force: bool, as_json: bool, layout: bool) -> None:
    """Import the log of a run on drives."""
    from softneck.drives import read_run_log  # the drives take a while to import
    from softneck.signals import write_recording
    from softneck.signals.importing._log import ImportResult
    from softneck.signals.recording._files import recording_suffix

    if layout:
        raise SettingsError(f"{log}: is a log of softneck, whose columns are known; leave out --layout and --guess.")
    path, replace = target(output, f"recordings/{log.stem}.csv", force=force)
    recording_suffix(path)
    refuse_existing(path, force=replace)
    run = read_run_log(log)
    recording = run.recording()
    notes = (f"{log}: {run.cut}: imported up to the cut",) if run.cut else ()
    write_recording(path, recording, force=replace)
    _tell(path, ImportResult(recording, notes), {}, as_json)


def _by_guess(log: Path, path: Path, replace: bool) -> tuple[ImportResult, dict[str, Any]]:
    """Guess a layout, write it beside the recording, and import by it.

    Raises:
        DataError: what a recording needs was not found; the proposal is written as far as it goes.
    """
    from softneck.signals import guess_layout, import_log

    proposal = path.with_suffix(".layout.toml")
    refuse_existing(proposal, force=replace)
    guess = guess_layout(log)
    for line in guess.lines:
        note(line)
    with atomic_write(proposal, force=replace) as temporary:
        temporary.write_text(guess.text, encoding="utf-8")
    if guess.missing:
        raise DataError(
            f"{log}: not found: {'; '.join(guess.missing)}. Fill it into {proposal}, then use --layout {proposal}."
        )
    try:
        imported = import_log(log, guess.layout)
    except DataError as error:
        raise DataError(f"{error} (The proposed layout is in {proposal}.)") from error
    facts = {"layout_file": str(proposal), "layout": tomllib.loads(guess.text), "reasons": list(guess.lines)}
    return imported, facts


def _of_robot(
    log: Path, path: Path, robot: Robot, robot_out: Path | None, replace: tuple[bool, bool]
) -> tuple[ImportResult, dict[str, Any]]:
    """Import by titles a log of `robot`, or of the one that they speak of; write that robot and the layout.

    Args:
        log: to import.
        path: of the recording.
        robot: whose it is, if none is proposed.
        robot_out: where to write a proposed robot.
        replace: whether files beside the recording, and the robot, may be replaced.
    """
    import tomli_w

    from softneck.signals import import_log, layout_toml
    from softneck.signals.importing._robot_guess import guess_robot, layout_for

    proposal = path.with_suffix(".layout.toml")
    refuse_existing(proposal, force=replace[0])
    facts: dict[str, Any] = {"layout_file": str(proposal)}
    texts: list[tuple[Path, str, bool]] = []
    if robot_out is not None:
        refuse_existing(robot_out, force=replace[1])
        found = guess_robot(log)
        layout, text = found.layout, f"# Proposed by softneck import for {log.name!r}; edit it.\n"
        texts.append((robot_out, text + tomli_w.dumps(found.robot.as_dict()), replace[1]))
        facts |= {"robot_file": str(robot_out), "reasons": list(found.lines)}
        for line in found.lines:
            note(line)
    else:
        layout = layout_for(log, robot)
    texts.append((proposal, layout_toml(layout), replace[0]))
    imported = import_log(log, layout)
    for file, text, force in texts:
        with atomic_write(file, force=force) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return imported, {**facts, "layout": tomllib.loads(texts[-1][1]), "robot": imported.recording.robot.label()}


def _tell(path: Path, imported: ImportResult, more: dict[str, Any], as_json: bool) -> None:
    recording = imported.recording
    missed = int((recording.outputs != recording.outputs).any(axis=1).sum())
    facts = {
        "recording": str(path),
        "rows": len(recording),
        "runs": len(recording.runs()),
        "sample_time_s": recording.sample_time,
        "missed_samples": missed,
        "notes": list(imported.notes),
        **more,
    }
    if as_json:
        print_json(facts)
        return
    for remark in imported.notes:
        note(remark)
    if more:
        note(f"the proposed layout is in {more['layout_file']}; edit it and use --layout if anything is wrong")
    click.echo(
        f"{path}: {len(recording)} rows in {facts['runs']} run(s) at {1e3 * recording.sample_time:g} ms, "
        f"{missed} with a missed sample"
    )
