"""softneck simulate and study: a loop over FMUs and files, judged, once or many times; a run's log, replayed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck import cosim, drives, plots, signals
from softneck.core import (
    CheckFailedError,
    FileFormatError,
    SettingsError,
    SoftneckError,
    atomic_write,
    refuse_existing,
    write_certificate,
)

from .shared._console import note, print_json, print_table, progress
from .shared._options import common_options, output_option, target, trust_option

if TYPE_CHECKING:
    import pandas as pd

    from softneck.loop import System

# Number of worst runs written as loop files; the table lists all.
_WORST_RUNS = 3


@click.command("simulate", epilog="Example: softneck simulate build/demo/loops/pitch_step.toml --html loop.html")
@click.argument("loop_file", metavar="LOOP.toml|X.ssp|LOG.mcap", type=click.Path(path_type=Path))
@output_option("recording of the run", "REC")
@click.option(
    "--certificate",
    type=click.Path(path_type=Path),
    help="Write a certificate of the limits that held, with the hashes of all files; `drives run` asks for it.",
)
@click.option("--html", type=click.Path(path_type=Path), help="Write a page that plays the run.")
@click.option(
    "--step",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="S",
    help="Step [s] of an SSP archive; needed if neither it nor its FMUs state one.",
)
@trust_option
@common_options("robot", "force")
def command(
    loop_file: Path, output: Path | None, certificate: Path | None, html: Path | None, step: float | None,
    robot: str | None, trust: bool, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Close the loop that LOOP.toml describes; exit code 1 if one of its limits does not hold.

    X.ssp: an SSP 1.0 or 2.0 archive of FMUs for co-simulation, of any tool. A closed loop in it is judged like any
    other; the signals of other systems are named part.output in the result.

    LOG.mcap: the log of `softneck drives` is replayed: its received frames go through the same master and controller
    again, and every sent frame is compared, bit for bit. Exit code 1 with the first difference. No bus is used.
    """
    if loop_file.suffix.lower() == ".mcap":
        if output is not None or certificate is not None or html is not None:
            raise SettingsError(f"{loop_file}: is replayed, which writes nothing; `softneck import` makes a recording.")
        replay_log(loop_file, as_json=as_json)
        return
    from softneck.loop import System

    if step is not None and (loop_file.suffix.lower() != ".ssp" or robot is not None):
        raise SettingsError(f"{loop_file}: `--step` is for SSP archives; a loop file states `sample_time_s`.")
    path, replace = target(output, f"results/{loop_file.stem}.csv", force=force)
    signals.recording_suffix(path)
    refuse_existing(path, force=replace)
    for extra in (certificate, html):
        if extra is not None:
            refuse_existing(extra, force=force)
    if loop_file.suffix == ".ssp" and robot is None:
        setup = cosim.load_ssp(loop_file, step=step)
        if isinstance(setup, System):
            _simulate_system(setup, loop_file, path, certificate, html, force=replace, as_json=as_json)
            return
    else:
        if loop_file.suffix != ".ssp":
            cosim.require_trusted(loop_file, trust=trust)
        setup = cosim.load_loop(loop_file, robot=robot)
    if certificate is not None and not setup.limits:
        from softneck.loop.default_limits import LOOP

        raise SettingsError(
            f"{loop_file}: has no [limits], so a certificate would show nothing; state some, such as "
            f'"pitch.overshoot_pct" = {LOOP["overshoot_pct"]}.'
        )
    from softneck.report import fault_values, loop_decision, loop_page

    faults = fault_values(setup.loop.faults)
    with progress("simulate", quiet=as_json) as report:
        result = cosim.run_setup(setup, report=lambda done: report(done, loop_file.name))
    for remark in result.remarks:
        click.echo(f"warning: {remark}", err=True)
    signals.write_recording(path, result.recording(), force=replace)
    if certificate is not None:
        write_certificate(certificate, result.certificate(), force=force)
    if html is not None:
        plots.write_page(html, loop_page(loop_file.stem, result, faults=faults), force=force)
    if as_json:
        print_json({**result.report(), "faults": faults, "decision": loop_decision(result.limits)})
    else:
        _print(path, result)
    failed = [row["metric"] for row in result.limits if not row["holds"]]
    if failed:
        raise CheckFailedError(f"{loop_file}: {len(failed)} limit(s) do not hold: {', '.join(failed)}.")
    if result.limits and not result.holds:
        raise CheckFailedError(f"{loop_file}: its limits are not shown to hold: the run ended early.")


def _simulate_system(
    system: System, source: Path, path: Path, certificate: Path | None, html: Path | None, *, force: bool, as_json: bool
) -> None:
    """Run FMUs that are no closed loop; the result is a table of all their outputs."""
    if certificate is not None or html is not None:
        raise SettingsError(f"{source}: is no closed loop, of which alone there are pages and certificates.")
    if path.suffix != ".csv":
        raise SettingsError(f"{path}: the outputs of a system that is no closed loop go to a .csv file.")
    with progress("simulate", quiet=as_json) as report:
        result = cosim.run_setup(system, report=lambda done: report(done, source.name))
    for remark in result.remarks:
        click.echo(f"warning: {remark}", err=True)
    with atomic_write(path, force=force) as temporary:
        result.frame.to_csv(temporary, index=False)
    if as_json:
        print_json(result.report())
        return
    click.echo(f"{path}: {len(result.signals.signals)} signals, {result.real_time_factor:,.1f} times real time")


def _print(path: Path, result: cosim.Result) -> None:
    print_table(str(path), *_metrics(result))
    if result.limits:
        print_table("Limits", *_limits(result))
    click.echo(f"{result.real_time_factor:,.1f} times real time")


def _metrics(result: cosim.Result) -> tuple[list[str], list[list[str]]]:
    rows = []
    for part, values in result.metrics.items():
        rows += [
            [f"{part}.{name}", "-" if value is None else f"{value:.5g}"]
            for name, value in values.items()
            if name != "slack_s" or result.robot.tendon_angles is not None
        ]
    return ["metric", "value"], rows


def _limits(result: cosim.Result) -> tuple[list[str], list[list[str]]]:
    rows = []
    for row in result.limits:
        value = "-" if row["value"] is None else f"{row['value']:.5g}"
        rows.append([row["metric"], f"{row['limit']:.4g}", value, "holds" if row["holds"] else "fails"])
    return ["metric", "limit", "value", "verdict"], rows


def replay_log(log: Path, *, as_json: bool) -> None:
    """Replay a logged run through the same master and controller, and compare every sent frame, bit for bit.

    A log that is cut is replayed up to the cut, with a note. Nothing is sent to any bus.
    """
    run = drives.read_run_log(log)
    notes = drives.changed_files(run)
    pilot = _pilot(run)
    if pilot is None:
        notes.append("the controller was not computed again: its logged answers were used")
    result = drives.replay(run, pilot, notes)
    for text in result.notes:
        note(text)
    if as_json:
        print_json({"log": str(log), **result.table()})
    else:
        rows = [["cycles", str(result.cycles)], ["frames out", str(result.frames)],
                ["controller's answers", str(result.answers)], ["phase", result.phase],
                ["fault", result.fault or "none"],
                ["equal", "yes" if result.difference is None else "no"]]  # fmt: skip
        print_table(str(log), ["what", "value"], rows)
    result.require()


def _pilot(run: drives.LoggedRun) -> drives.Pilot | None:
    """Return the pilot of the run: controller and observer, a jog or an experiment.

    None where the log names none, or the files of the loop are gone.
    """
    try:
        if "jog" in run.facts:
            return drives.jog_pilot(**run.facts["jog"])
        if "record" in run.facts:
            channels = run.settings().channels
            robot, ranges = (None, ()) if channels is None else (run.robot, channels.ranges)
            return drives.Experiment.of(run.facts["record"], robot, ranges).pilot()
    except (SoftneckError, TypeError) as error:
        raise FileFormatError(f"{run.path}: what it played does not fit this softneck ({error}).") from error
    files = {role: Path(str(entry.get("path"))) for role, entry in run.facts.get("files", {}).items()}
    loop, controller = files.get("loop"), files.get("controller")
    if loop is None or controller is None or not (loop.is_file() and controller.is_file()):
        return None
    return drives.LoopPilot(drives.prepare(cosim.load_loop(loop), controller, run.robot).loop, run.robot)


@click.command("study", epilog="Example: softneck study study.toml -o build/study --workers 2")
@click.argument("study_file", metavar="STUDY.toml", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), metavar="DIR",
    help="Folder of runs, report and worst cases. [default: build/studies/NAME]",
)  # fmt: skip
@click.option("--workers", type=int, help="Number of local processes. [default: one for each core]")
@trust_option
@common_options("force")
def study_command(
    study_file: Path, output: Path | None, workers: int | None, trust: bool, force: bool, as_json: bool
) -> None:
    """Run the loop of STUDY.toml over all that its [vary] names; exit code 1 if every run failed.

    \b
    DIR gets  runs.csv       a row for each run: what varied, seed, metrics, limits, error
              report.html    ranking, Pareto front, distributions, influences
              worst/         the worst runs as loop files for softneck simulate
    Ctrl-C or a crash loses no finished run: the same command continues.
    """
    from softneck.report import failures, study_head, study_page, study_rows

    cosim.require_trusted(study_file, trust=trust)
    study = cosim.load_study(study_file)
    folder = output if output is not None else Path("build") / "studies" / study_file.stem
    if folder.is_file():
        raise SettingsError(f"{folder}: is a file; name a folder.")
    with progress(f"study of {len(study.points)} runs", quiet=as_json) as report:
        # Under build/ another study is replaced.
        other = output is None and (folder / cosim.STUDY_FILE).is_file()
        anew = force or (other and cosim.read_study_description(folder).get("digest") != study.digest)
        runs = cosim.run_study(study, folder, workers=workers, force=anew, report=report)
    plots.write_page(folder / "report.html", study_page(cosim.read_study_description(folder), runs), force=True)
    paths = cosim.write_worst(study, runs, folder / "worst", count=_WORST_RUNS)
    if as_json:
        print_json(_summary(runs, folder, study.objectives, paths))
    else:
        keys = list(study.vary)
        print_table(str(folder), study_head(keys, study.objectives), study_rows(runs, keys, study.objectives))
        failed = sum(failures(runs))
        note(f"{len(runs)} runs, {failed} failed; report: {folder / 'report.html'}")
    if all(failures(runs)):
        raise CheckFailedError(f"{study_file}: every run failed; the first said: {runs['error'].iloc[0]}")


def _summary(runs: pd.DataFrame, folder: Path, objectives: tuple[str, ...], worst: list[Path]) -> dict[str, Any]:
    from softneck.report import failures

    held = cosim.held_runs(runs).dropna().tolist()
    return {
        "folder": str(folder),
        "runs": len(runs),
        "failed": sum(failures(runs)),
        "holds_share": sum(held) / len(held) if held else None,
        "objectives": list(objectives),
        "best": [int(run) for run in cosim.rank(runs, objectives)["run"].head(10)],
        "pareto_front": [int(run) for run in cosim.pareto_front(runs, objectives)["run"]],
        "worst": [str(path) for path in worst],
    }
