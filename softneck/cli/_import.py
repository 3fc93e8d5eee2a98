"""softneck import: a foreign log becomes a recording."""

from __future__ import annotations

import dataclasses
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck import drives, plots, signals
from softneck.core import DataError, SettingsError, atomic_write, refuse_existing

from .shared._console import note, print_json
from .shared._options import columns_options, common_options, sample_time_of, target

if TYPE_CHECKING:
    from softneck.robot import Robot


def is_terminal() -> bool:
    """Return whether someone can answer."""
    return bool(sys.stdin and sys.stdin.isatty() and sys.stderr.isatty())


def settle(guess: signals.Guess, log: Path, proposal: Path) -> signals.Guess:
    """Ask the user about all doubts and the sample time of a log without a clock; return the settled guess.

    Raises:
        DataError: the user rejects columns; the message names the layout to fix.
    """
    for doubt in guess.doubts:
        if doubt.choices:
            click.echo(str(doubt), err=True)
            kind = click.Choice([doubt.taken, *doubt.choices])
            said = click.prompt(doubt.about, default=doubt.taken, type=kind, err=True)
            guess = guess.settle_doubt(doubt, None if said == doubt.taken else said)
        else:
            _confirm(
                doubt, log, f"Write the right columns into a layout (`softneck import {log} --guess --yes` "
                f"proposes {proposal}) and use --layout.",
            )  # fmt: skip
            guess = guess.settle_doubt(doubt)
    if any(line.startswith("the sample time") for line in guess.missing):
        kind = click.FloatRange(min=0.0, max=1e4, min_open=True)
        guess = guess.with_sample_time(click.prompt("No column is a time. Sample time [s]", type=kind, err=True))
    return guess


def _confirm(doubt: signals.Doubt, log: Path, advice: str) -> None:
    """Ask whether a guess is right; raise DataError with the advice if it is not."""
    if not click.confirm(f"{doubt}. Is that right?", default=True, err=True):
        raise DataError(f"{log}: {doubt.about}: {doubt.taken} was said to be wrong. {advice}")


@dataclass(slots=True)
class _Job:
    """One import: its log, options and output files.

    Attributes:
        log: to read.
        path: of the recording.
        replace: whether files at `path` and beside it may be replaced.
        force: whether `--force` is given.
        html: of the preview.
        yes: take all guesses without asking.
        as_json: print JSON.
        sample_time: to resample at: a number [s], "robot", or None.
        clock: the sample time [s] of a log without a clock, given by the user.
        robot: as the user named it.
        named: the columns that the user named.
        texts: file -> text to write beside the recording, and whether it may be replaced.
    """

    log: Path
    path: Path
    replace: bool
    force: bool
    html: Path | None = None
    yes: bool = False
    as_json: bool = False
    sample_time: str | None = None
    clock: float | None = None
    robot: str | None = None
    named: signals.NamedColumns | None = None
    texts: dict[Path, tuple[str, bool]] = field(default_factory=dict)

    @property
    def asks(self) -> bool:
        """Whether the user is asked about what is not sure."""
        return not self.yes and not self.as_json and is_terminal()

    def beside(self, ending: str) -> Path:
        """Return the path of a file beside the recording; raise OutputFileError if it exists and must be kept."""
        path = self.path.with_suffix(ending)
        refuse_existing(path, force=self.replace)
        return path

    def write(self, more: dict[Path, tuple[Callable[[Path], object], bool]] | None = None) -> None:
        """Write all files or, where one cannot be written, none."""
        writers = {path: (_writer(text), force) for path, (text, force) in self.texts.items()} | (more or {})
        with ExitStack() as stack:
            for path, (write, force) in writers.items():
                write(stack.enter_context(atomic_write(path, force=force)))


def _writer(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text, encoding="utf-8")


@click.command(
    "import",
    epilog="Example: softneck import log.csv --guess -o neck.csv, then edit neck.layout.toml and go on with "
    "softneck import log.csv --layout neck.layout.toml -o neck.csv --force",
)
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--layout", "layout_file", type=click.Path(path_type=Path), help="How to read the log.")
@click.option(
    "--robot-out",
    type=click.Path(path_type=Path),
    metavar="ROBOT.toml",
    help="Propose a robot by the log's columns, write it here, and import the log as its recording.",
)
@click.option("--guess", is_flag=True, help="Propose a layout, say why, and write it beside the recording.")
@click.option("--sample-time", "clock", metavar="S", help="Of a log without a clock, with --guess or named columns.")
@click.option(
    "--html", type=click.Path(path_type=Path), metavar="FILE", help="Page: raw columns and channels, doubts first."
)
@click.option(
    "--resample",
    "sample_time",
    metavar="S|robot",
    help="Resample the recording at this sample time [s], or at the robot's.",
)
@columns_options
@click.option("-o", "output", type=click.Path(path_type=Path), metavar="REC",
              help="Where to write the recording. [default: under build/]")  # fmt: skip
@common_options("robot", "yes", "force")
def command(
    log: Path,
    layout_file: Path | None,
    robot: str | None,
    robot_out: Path | None,
    guess: bool,
    clock: str | None,
    yes: bool,
    html: Path | None,
    sample_time: str | None,
    motors: tuple[str, ...],
    positions: tuple[str, ...],
    outputs: tuple[str, ...],
    output: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    """Turn any logger's table LOG into a recording: by a layout file, a guess at one, or columns that are named.

    With --resample alone LOG is a recording. Where the new sample time is slower, measured channels are low-passed
    first, without a delay; set-points and flags hold their last value. At its own sample time it is copied unchanged.

    Reads text in any encoding, spreadsheets, Parquet, MATLAB files, and ROS 2 bags (.mcap). The .mcap log of
    `softneck drives run --log` needs neither layout nor guess.
    """
    from softneck.robot import find_robot, robot_file_of

    named = signals.NamedColumns(motors, outputs, positions) if motors or outputs or positions else None
    asked = guess or layout_file is not None or robot_out is not None or named is not None
    ours = log.suffix.lower() == ".mcap" and (not asked or signals.is_run_log(log))
    path, replace = target(output, f"recordings/{log.stem}.csv", force=force)
    known = None if clock is None else sample_time_of(clock, "--sample-time")
    if known is not None and not guess and named is None and robot_out is None:
        raise SettingsError("--sample-time goes with --guess; a layout says it as `sample_time_s` in [time].")
    if named is not None and (guess or layout_file is not None):
        raise SettingsError("--motor, --position and --output are the layout; leave out --guess and --layout.")
    alone_output = _output_of_neck(log, named)
    if alone_output is not None:
        named, guess = None, True
    job = _Job(log, path, replace, force, html, yes, as_json, sample_time, known, robot, named)
    alone = ours or (not asked and sample_time is not None)
    if ours and asked:
        raise SettingsError(f"{log}: is a log of softneck, whose columns are known; leave out --layout and --guess.")
    if alone and html is not None:
        what = "log of softneck" if ours else "recording"
        raise SettingsError(f"--html shows what a layout or a guess made of a log; a {what} needs neither.")
    if robot_out is not None:
        if guess or layout_file is not None or (robot is not None and named is None):
            raise SettingsError("--robot-out guesses robot and layout; leave out --guess, --layout and --robot.")
        if robot_out.suffix.lower() != ".toml":
            raise SettingsError(f"{robot_out}: must end in `.toml`, by which softneck recognises the file.")
        if (said := signals.robot_in_file(log, log.suffix.lower())) is not None:
            raise SettingsError(f"{log}: is a recording of robot {said.label()} already, which commands take as it is.")
        guess = named is None
    if not alone and named is None and guess == (layout_file is not None):
        what = "both were given" if guess else "neither was given (a recording needs --resample)"
        raise SettingsError(f"import needs either --layout LAYOUT.toml or --guess; {what}.")
    signals.recording_suffix(path)
    refuse_existing(path, force=replace)
    if html is not None:
        refuse_existing(html, force=force)
    if alone:
        _finish(job, *_read_known(log, robot, ours=ours))
        return
    facts: dict[str, Any] = {}
    given = robot is not None or robot_file_of(log) is not None
    stored = None if given else signals.robot_in_file(log, log.suffix.lower())
    whose = stored or find_robot(robot, beside=log)
    known_robot = given or stored is not None
    propose = named is not None or robot_out is not None
    propose |= layout_file is None and not known_robot and signals.is_of_another_robot(log)
    # A log without titles can be guessed for a robot with the neck's channels.
    of_neck = (whose.set_points, whose.outputs.names) == (signals.SET_POINTS, signals.OUTPUTS)
    if propose or (layout_file is None and not of_neck):
        proposed, imported, facts = _of_robot(job, whose, robot_out, known=known_robot, propose=propose)
        layout = proposed.layout
    elif layout_file is None:
        proposed, imported, facts = _by_guess(job, whose, alone_output)
        layout = proposed.layout
    else:
        layout, proposed = signals.read_layout(layout_file, robot=whose), None
        imported = _import(job, layout)
    _finish(job, imported, facts, layout, proposed)


def _output_of_neck(log: Path, named: signals.NamedColumns | None) -> str | None:
    """Return "pitch" or "roll" if it alone was named and no column is called so: the rest is guessed."""
    if named is None or named.motors or named.positions or len(named.outputs) != 1:
        return None
    (output,) = named.outputs
    if output not in signals.OUTPUTS or signals.has_column(log, output) or signals.is_of_another_robot(log):
        return None
    return output


def _read_known(log: Path, robot: str | None, *, ours: bool) -> tuple[signals.ImportResult, dict[str, Any]]:
    """Return the recording of a run on drives (`ours`), or a recording to be resampled."""
    if not ours:
        before = signals.read_recording(log, robot=robot)
        return signals.ImportResult(before, ()), {"sample_time_before_s": before.sample_time}
    run = drives.read_run_log(log)
    notes = (f"{log}: {run.cut}: imported up to the cut",) if run.cut else ()
    return signals.ImportResult(run.recording(), notes), {}


def _finish(
    job: _Job, imported: signals.ImportResult, facts: dict[str, Any], layout: signals.Layout | None = None,
    proposed: signals.Guess | signals.RobotGuess | None = None,
) -> None:  # fmt: skip
    """Resample if required, write all files, and print a summary."""
    imported = _at_sample_time(job, imported)
    if job.html is not None and layout is not None:
        job.texts[job.html] = (_preview(job, layout, proposed, imported), job.force)
        facts["html"] = str(job.html)
    job.write({job.path: (lambda path: signals.write_recording(path, imported.recording, force=True), job.replace)})
    _tell(job.path, imported, facts, job.as_json)


def _at_sample_time(job: _Job, imported: signals.ImportResult) -> signals.ImportResult:
    """Return the import at the required sample time."""
    if job.sample_time is None:
        return imported
    recording = imported.recording
    if job.sample_time == "robot":
        asked = recording.robot.require("sample_time_s", "--resample robot")
    else:
        asked = sample_time_of(job.sample_time, "--resample")
    told = f"resampled from {1e3 * recording.sample_time:.6g} to {1e3 * asked:.6g} ms"
    return signals.ImportResult(signals.resampled(recording, asked), (*imported.notes, told))


def _preview(
    job: _Job, layout: signals.Layout, proposed: signals.Guess | signals.RobotGuess | None,
    imported: signals.ImportResult | None, problems: tuple[str, ...] = (),
) -> str:  # fmt: skip
    """Return the page that shows the log's columns and their channels."""
    return plots.import_page(
        job.log,
        signals.read_log(job.log, layout),
        layout,
        recording=None if imported is None else imported.recording,
        doubts=() if proposed is None else proposed.doubts,
        lines=[*(() if proposed is None else proposed.lines), *(() if imported is None else imported.notes)],
        problems=(*problems, *(proposed.missing if isinstance(proposed, signals.Guess) else ())),
    )


@contextmanager
def _page_of_refusal(job: _Job, doubts: tuple[signals.Doubt, ...] = ()) -> Iterator[None]:
    """Write the page that was asked for if the log is refused inside: its raw columns, and why."""
    try:
        yield
    except DataError as error:
        if job.html is not None:
            frame, columns = signals.describe_columns(job.log, job.named)
            why = str(error).removeprefix(f"{job.log}: ")
            page = plots.refused_page(job.log, frame, columns, why, doubts)
            job.texts = {job.html: (page, job.force)}
            job.write()
        raise


def _import(job: _Job, layout: signals.Layout, doubts: tuple[signals.Doubt, ...] = ()) -> signals.ImportResult:
    with _page_of_refusal(job, doubts):
        return signals.import_log(job.log, layout)


def _by_guess(
    job: _Job, whose: Robot, output: str | None = None
) -> tuple[signals.Guess, signals.ImportResult, dict[str, Any]]:
    """Guess a layout, ask about its doubts, and import by it."""
    import tomli_w

    proposal = job.beside(".layout.toml")
    guess = signals.guess_layout(job.log, robot=whose, output=output)
    if job.clock is not None:
        if guess.layout.time is not None:
            raise SettingsError(f"{job.log}: has a clock; leave out --sample-time, or say --resample {job.clock:g}.")
        guess = guess.with_sample_time(job.clock)
    for line in guess.lines:
        note(line)
    if job.asks:
        guess = settle(guess, job.log, proposal)
    job.texts[proposal] = (guess.text, job.replace)
    if guess.missing:
        if job.html is not None:
            job.texts[job.html] = (_preview(job, guess.layout, guess, None), job.force)
        job.write()
        for line in guess.missing[1:]:
            note(f"not found either: {line}")
        note(f"the layout, as far as it goes, is in {proposal}: fill in what is MISSING, and use --layout {proposal}")
        note(f"or name the columns: {signals.columns_line(job.log)}")
        raise DataError(f"{job.log}: not found: {guess.missing[0]}.")
    facts = {"layout_file": str(proposal), "layout": tomllib.loads(guess.text), "reasons": list(guess.lines),
             "doubts": [doubt.as_dict() for doubt in guess.doubts]}  # fmt: skip
    if guess.layout.robot.hash != whose.hash:
        robot_file = job.beside(".robot.toml")
        text = f"# Proposed by softneck import --guess for {job.log.name!r}; its layout needs --robot {robot_file}\n"
        job.texts[robot_file] = (text + tomli_w.dumps(guess.layout.robot.as_dict()), job.replace)
        facts["robot_file"] = str(robot_file)
    try:
        return guess, signals.import_log(job.log, guess.layout), facts
    except DataError as error:
        if job.html is not None:
            said = str(error).removeprefix(f"{job.log}: ")
            job.texts[job.html] = (_preview(job, guess.layout, guess, None, (said,)), job.force)
        job.write()
        note(f"if the columns are wrong, name them: {signals.columns_line(job.log)}")
        raise DataError(f"{error} (The proposed layout is in {proposal}.)") from error


def _of_robot(
    job: _Job, robot: Robot, robot_out: Path | None, *, known: bool, propose: bool
) -> tuple[signals.RobotGuess, signals.ImportResult, dict[str, Any]]:
    """Import a log by named or recognised columns, or by the titles of `robot`; write the robot that is proposed.

    `known`: whether somebody, or the log itself, said that it is of `robot`.
    """
    import tomli_w

    from softneck.robot import find_robot

    proposal = job.beside(".layout.toml")
    facts: dict[str, Any] = {"layout_file": str(proposal)}
    if propose and robot_out is not None:
        refuse_existing(robot_out, force=job.force)
    with _page_of_refusal(job):
        if propose:
            whose = robot if known and job.named is not None else None
            found = signals.guess_robot(job.log, job.named, robot=whose, sample_time=job.clock)
        else:
            found = signals.layout_for(job.log, robot, sample_time=job.clock)
    for line in found.lines:
        note(line)
    if job.asks:
        for doubt in found.doubts:
            line = signals.columns_line(job.log)
            _confirm(doubt, job.log, f"Name the right columns, with units in their titles: {line}")
        found = dataclasses.replace(found, doubts=())
    facts |= {"reasons": list(found.lines), "doubts": [doubt.as_dict() for doubt in found.doubts]}
    layout, remarks = found.layout, {}
    for doubt in found.doubts:
        said = remarks.get(doubt.channels[0])
        remarks[doubt.channels[0]] = f"{said}; NOT SURE: {doubt}" if said else f"NOT SURE: {doubt}"
    if robot_out is not None or layout.robot.hash != find_robot(job.robot, beside=job.log).hash:
        file = robot_out or job.beside(".robot.toml")
        force = job.replace if robot_out is None else job.force
        refuse_existing(file, force=force)
        text = f"# Proposed by softneck import for {job.log.name!r}; edit it.\n"
        job.texts[file] = (text + tomli_w.dumps(layout.robot.as_dict()), force)
        facts["robot_file"] = str(file)
    text = signals.layout_toml(layout, remarks=remarks)
    job.texts[proposal] = (text, job.replace)
    imported = _import(job, layout, found.doubts)
    return found, imported, {**facts, "layout": tomllib.loads(text), "robot": imported.recording.robot.label()}


def _tell(path: Path, imported: signals.ImportResult, more: dict[str, Any], as_json: bool) -> None:
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
    if more.get("doubts"):
        note(f"{len(more['doubts'])} guess(es) under 90 % sure are marked NOT SURE in the layout")
    if "layout_file" in more:
        robot = f" with --robot {more['robot_file']}" if "doubts" in more and "robot_file" in more else ""
        note(f"the proposed layout is in {more['layout_file']}; edit it and use --layout{robot} if anything is wrong")
    click.echo(
        f"{path}: {len(recording)} rows in {facts['runs']} run(s) at {1e3 * recording.sample_time:g} ms, "
        f"{missed} with a missed sample{_one_output(more)}"
    )


def _one_output(more: dict[str, Any]) -> str:
    """Return the end of the last line for a log taken as that of a robot with one output."""
    taken = [doubt["taken"] for doubt in more.get("doubts", ()) if doubt["about"] == signals.ONE_AXIS]
    return f"; NOT SURE: {taken[0]}, as no column is the other angle" if taken else ""
