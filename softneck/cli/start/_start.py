"""softneck start: one command from a log to a verdict."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import click

from softneck import signals
from softneck.core import (
    MOST_JSON,
    CheckFailedError,
    OutputFileError,
    SettingsError,
    SoftneckError,
    find_kind,
    load,
    remove_abandoned,
    require_file,
    settings_text,
)
from softneck.plant import has_own_tendons
from softneck.robot import Robot, Scaling

from .._import import is_terminal
from ..shared._console import note, percent, print_json, print_table
from ..shared._options import columns_options, common_options
from ._plan import BEST, CERTIFICATE, FAMILY, PI, STAGES, TUNER, Options, Step, linear_model, nonlinear_model, steps
from ._possible import backend, has_pytest, require_disk
from ._project_run import FILE, ProjectRun

_PATH = click.Path(path_type=Path)
_CERTIFICATE_FILE = "tune/best.certificate.json"
_NEXT_RECORDING = "Record 60 s of `mixed` and start with that."
# Of a robot that no virtual neck stands for: its own software plays the signal.
_STEPS = "steps of every motor, each held until the outputs settle"
_NEXT_STEPS = f"Record {_STEPS}, and start with that."
_MOTION = "`softneck record mixed`, `softneck drives record mixed`"
_MIXED_ADVICE = (
    "in `mixed` every motor moves by itself and all move together: `softneck drives record mixed` plays it on drives"
)
# [characters] Length of the last line with `softneck: `: two lines of a terminal of 80.
_LINE = 160 - len("softneck: ")
_OWN_REQUIREMENTS = (
    "for requirements of your own see `softneck tune --print-requirements`, and pass them by --requirements"
)
_SECOND_VISIT = (
    "to accept that: --requirements {folder}/tune/requirements.toml; to have more: record another motion ({motion}) "
    "and start with both logs, as more motions leave fewer models"
)
# A common position [rad of a neck] at which a PI on five of the six necks of the tests rises within 0.34 s, in 0.74 to
# 1.0 s without; at two thirds of it `column` still has slack tendons.
_COMMON_RAD = 1.5
_TAUT = (
    "the recordings pull the tendons together by {most:.2g} rad at most, and slack ones answer late: record `softneck "
    "record mixed --cocontraction {common:g}`, and start with that log alone"
)
_WITHOUT = re.compile(r"Leave (\w+(?:, \w+)*) out of `outputs\.names` in a robot\.toml")
# Sentences end where the next begins with a capital; `0.5 %.` within one does not.
_FIRST_SENTENCE = re.compile(r"(?:[^:]*\.(?:csv|npz): )?((?s:.*?)[^.\s]\.)(?=\s+[`A-Z]|$)")


@click.command("start", epilog="Example: softneck start log.csv -o my_neck --yes")
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=_PATH)
@click.option("-o", "output", type=_PATH, metavar="DIR", help="Folder of the project. [default: build/start/LOG]")
@click.option("--requirements", type=_PATH, metavar="TOML", help="Requirements for `tune`. [default: its own]")
@click.option("--kinds", metavar="K,K", help="Kinds of controller to search. [default: those of `tune` but `adaptive`]")
@click.option("--sample-time", metavar="S", help="Of logs without a clock. [default: as the log tells]")
@click.option(
    "--budget", type=click.IntRange(min=1), metavar="EVALUATIONS", help="Of `tune`. [default: 40; without draws 60]"
)
@click.option("--seed", type=click.IntRange(min=0), help="Of models and search. [default: 0]")
@columns_options
@common_options("robot", "yes")
def command(
    logs: tuple[Path, ...], output: Path | None, yes: bool, robot: str | None, requirements: Path | None,
    kinds: str | None, sample_time: str | None, budget: int | None, seed: int | None, motors: tuple[str, ...],
    positions: tuple[str, ...], outputs: tuple[str, ...], as_json: bool,
) -> None:  # fmt: skip
    """Go from LOGs to a verdict: models, controller, certificate, FMUs, loop, study, test and page.

    Each step is a plain command, printed before it runs in DIR, which becomes an ordinary project. Finished steps are
    skipped unless a file that they read has changed: after Ctrl-C the same command continues. If the recordings hold
    too little information, softneck says what to record. Exit code 1: a requirement or limit does not hold.
    """
    _require_logs(logs)
    _require_known(requirements, kinds)
    folder = (output or Path("build/start") / logs[0].stem).absolute()
    given = {"robot": _robot_of(logs[0], robot), "requirements": requirements and str(requirements.absolute()),
             "kinds": kinds, "sample_time": sample_time, "budget": budget, "seed": seed, "motors": motors or None,
             "positions": positions or None, "outputs": outputs or None}  # fmt: skip
    paths = tuple(str(log.absolute()) for log in logs)
    require_disk(folder)
    with _project(folder):
        run = ProjectRun.read(as_json=as_json)
        guided = is_terminal() and not yes and not as_json
        options = _read_options(paths, {**run.answers, **{k: v for k, v in given.items() if v is not None}}, yes=yes,
                       guided=guided and not run.done)  # fmt: skip
        run.answers = {key: value for key, value in asdict(options).items() if key in given}
        options = replace(options, backend=backend(), tested=has_pytest())
        not_run = {} if options.tested else {"test": "pytest is not installed"}
        if not as_json:
            click.echo(f"$ cd {folder}")
        try:
            with contextlib.closing(run):
                for step in steps(options):
                    _before(step, run, guided=guided)
                    run.do(step)
        except SoftneckError as error:
            raise _with_advice(error, run, folder, paths) from error
        facts = {**_facts(run, folder), "not_run": not_run}
        if "tune" in facts["failed"]:
            _advise_tautness()
    _tell(facts, as_json=as_json)


def _require_logs(logs: tuple[Path, ...]) -> None:
    for log in logs:
        require_file(log)
    stems = [log.stem for log in logs]
    twice = next((log for log in logs if stems.count(log.stem) > 1), None)
    if twice is not None:
        raise SettingsError(f"{twice}: another log is called `{twice.stem}` too; rename one of them.")


def _require_known(requirements: Path | None, kinds: str | None) -> None:
    """Check at once the options that `tune` would refuse after minutes."""
    if requirements is not None:
        require_file(requirements)
    for kind in kinds.split(",") if kinds else ():
        find_kind(kind, "controller")


def _robot_of(log: Path, robot: str | None) -> str | None:
    """Return the robot's name for commands in another folder; None if no robot is given or found."""
    from softneck.robot import ROBOT_PRESETS, find_robot

    file = find_robot(robot, beside=log).file  # reports errors in it
    return robot if robot in ROBOT_PRESETS or file is None else str(file.absolute())


def _read_options(logs: tuple[str, ...], given: dict[str, Any], *, yes: bool, guided: bool) -> Options:
    """Return the options; in a terminal the user is asked for missing ones."""
    if guided and given.get("robot") is None:
        said = click.prompt("Whose log is it: neck, arm, antagonist, finger, trunk4 or a robot file (Enter: as its "
                            "columns tell)", default="", show_default=False, err=True)  # fmt: skip
        given["robot"] = None if said in ("", "neck") else _robot_of(Path(logs[0]), said)
    if guided and given.get("requirements") is None:
        said = click.prompt("Requirements file for the controller (Enter: the defaults)", default="",
                            show_default=False, err=True)  # fmt: skip
        _require_known(Path(said) if said else None, None)
        given["requirements"] = said and str(Path(said).absolute())
    known = {key: value for key, value in given.items() if key in {f.name for f in fields(Options)}}
    return Options(logs=logs, yes=yes, **{key: value for key, value in known.items() if value not in (None, "")})


def _before(step: Step, run: ProjectRun, *, guided: bool) -> None:
    """Print before the identification what the recordings do not excite, and ask whether to continue."""
    if step.stage != "identification" or any(key.startswith("identification") for key in run.done):
        return
    lacks = _lacks(run)
    for line in lacks:
        note(line)
    if guided and lacks and not click.confirm("The recordings lack excitation. Continue?", default=True, err=True):
        raise CheckFailedError(f"stopped by the user. {_next_recording()}")


def _lacks(run: ProjectRun) -> list[str]:
    """Return what the imported recordings do not excite."""
    files = [Path(key.partition(": ")[2]) for key in run.ran if key.startswith("import")]
    found = [
        (file, line)
        for file in files
        if file.is_file()
        for line in signals.poor_excitation(signals.read_recording(file))
    ]
    return [f"{file.stem}: {line}" for file, line in found]


def _with_advice(error: SoftneckError, run: ProjectRun, folder: Path, logs: tuple[str, ...]) -> SoftneckError:
    """Return the error with its step; print further advice before it to keep it short."""
    if not run.ran:
        return error
    last = next(reversed(run.ran))
    stage, step = last.partition(":")[0], run.done[last]
    said = str(error)
    for log in logs:
        said = said.replace(log, Path(log).name)
    between = step["ended"] and step["holds"]  # the robot file lacks something
    if last.endswith(PI) and "to design on" not in said:
        note("the models are kept: `softneck validate` and `softneck fmu` take them, and `softneck design` other kinds")
        return type(error)(_shorten(f"first controller: {said}"))
    if stage == "identification" and not between:  # the lacking excitation was printed before
        if (advice := _next_recording()) == _NEXT_RECORDING:
            note(_MIXED_ADVICE)
        first = _FIRST_SENTENCE.match(said)
        return CheckFailedError(_shorten(f"{stage}: {first[1] if first else said}", _without(said) or advice))
    if stage == "tune":
        note(_OWN_REQUIREMENTS)
    note(f"paths are those in {folder}; fix this and run the same command again")
    return type(error)(_shorten(f"{stage}: {said}"))


def _next_recording() -> str:
    return _NEXT_RECORDING if _plays_signals("") else _NEXT_STEPS


def _plays_signals(folder: str) -> bool:
    """Return whether `softneck record` plays signals on the robot of the project."""
    given = Path(folder, "robot.toml")
    return not given.is_file() or has_own_tendons(Robot.read(given))


def _without(said: str) -> str:
    """Return the advice to go on without an output, which needs no other recording; empty if that is no way out."""
    found = _WITHOUT.search(said)
    if found is None:
        return ""
    good = [name for name in signals.OUTPUTS if name != found[1]]
    if len(good) == 1 and Robot.read("robot.toml").outputs.names == signals.OUTPUTS:
        return f"Go on without {found[1]}: --output {good[0]}."
    return f"{found[0]}."


def _shorten(said: str, advice: str = "") -> str:
    """Return message and advice in one short line; print the whole message before if it does not fit."""
    line = " ".join([said, *advice.split()])
    if len(line) <= _LINE:
        return line
    note(said)
    room = _LINE - len(f" ... {advice}")
    return f"{said[:room].rpartition(' ')[0]} ... {advice}".rstrip()


@contextlib.contextmanager
def _project(folder: Path) -> Iterator[None]:
    """Make `folder` the working folder; remove it at the end if no step made a file."""
    if folder.exists() and not folder.is_dir():
        raise SettingsError(f"{folder}: is a file; name a folder.")
    if folder.is_dir():
        remove_abandoned(folder)  # a run that was killed at its first file leaves a temporary one alone
    if folder.is_dir() and any(folder.iterdir()) and not (folder / FILE).is_file():
        raise OutputFileError(f"{folder}: is not empty and holds no `start.json`; choose another folder.")
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputFileError(f"{folder}: cannot be written: {error.strerror}. Choose another folder.") from error
    try:
        with contextlib.chdir(folder):
            yield
    finally:
        _leave_nothing_empty(folder, new)


def _leave_nothing_empty(folder: Path, new: list[Path]) -> None:
    """Remove the new folders if no step made a file."""
    with contextlib.suppress(OSError):
        if all(path.is_dir() or path == folder / FILE for path in folder.rglob("*")):
            (folder / FILE).unlink(missing_ok=True)
            inside = sorted((path for path in folder.rglob("*") if path.is_dir()), reverse=True)
            for path in [*inside, *new]:
                path.rmdir()


def _facts(run: ProjectRun, folder: Path) -> dict[str, Any]:
    """Return the results of all steps."""
    names = ("command", "holds", "said", "seconds")
    rows = [
        {"stage": key.partition(":")[0], **{name: run.done[key][name] for name in names}, "done_before": kept}
        for key, kept in run.ran.items()
    ]
    models = {"linear": linear_model(), "nonlinear": nonlinear_model()}
    found = {sort: _model(file) for sort, file in models.items() if file is not None}
    return {
        "folder": str(folder),
        "holds": all(row["holds"] for row in rows),
        "doubts": _doubts(),
        "failed": [row["stage"] for row in rows if not row["holds"]],
        "models": found,
        "controller": BEST,
        **_certified(),
        "report": "build/report.html",
        "tuner": TUNER,
        "decision": _decision(list(found.values())),
        "steps": rows,
    }


def _decision(models: Sequence[dict[str, Any]]) -> str:
    """Return the decision with which the project's page opens."""
    from softneck.report import project_decision
    from softneck.verification import certificate_values

    found = [path for path in (Path(_CERTIFICATE_FILE), Path(CERTIFICATE)) if path.is_file()]
    read = [certificate_values(path.as_posix(), json.loads(settings_text(path, MOST_JSON))) for path in found]
    return project_decision(models, read, tuner=TUNER if Path(TUNER).is_file() else None)


def _advise_tautness() -> None:
    """Say what to record where tendons are not pulled together far enough to stay taut."""
    family = load(FAMILY, role="family") if Path(FAMILY).is_file() else None
    found = [] if family is None else family.findings.get("tested", {}).get("conditions", [])
    if family is None or not found or family.robot.tendon_angles is None or family.robot.motors.unit != "rad":
        return  # `softneck record` turns motors
    if not family.robot.redefinition()[1][:, -1].any():
        return  # a single tendon has none to pull against
    most = max(sum(part["cocontraction"]) / 2.0 for part in found)
    common = _COMMON_RAD * Scaling.of(family.robot).motor_unit
    if most < 0.9 * common:
        note(_TAUT.format(most=max(most, 0.0), common=common))


def _certified() -> dict[str, Any]:
    """Return what the certificate of the tuned controller says beside its requirements.

    "loosened": metric -> the loosened default, and the value reached. "draws": what loops over them say, in words.
    "judged_elsewhere": condition -> what was judged instead of it.
    """
    certificate = Path(_CERTIFICATE_FILE)
    said = json.loads(settings_text(certificate, MOST_JSON)) if certificate.is_file() else {}
    return {
        "loosened": said.get("loosened", {}), "draws": [part["statement"] for part in said.get("draws", [])],
        "judged_elsewhere": said.get("judged_elsewhere", {}),
    }  # fmt: skip


def _doubts() -> dict[str, list[str]]:
    """Return layout -> the doubts of the import that are still open."""
    files = [*sorted(Path("recordings").glob("*.layout.toml")), *filter(Path.is_file, [Path("robot.toml")])]
    found = {path.as_posix(): signals.doubts_in(path) for path in files}
    return {name: list(doubts) for name, doubts in found.items() if doubts}


def _unsure(facts: dict[str, Any]) -> str:
    """Return the least certain open doubt in a clause; empty if there is none."""
    doubts = [(one, name) for name, found in facts["doubts"].items() for one in found]
    if not doubts:
        return ""
    said, file = min(doubts, key=lambda pair: not pair[0].startswith("outputs: "))
    more = f", {len(doubts) - 1} more" if doubts[1:] else ""
    what = "the robot" if file == "robot.toml" else "the log"
    return f"not sure of {what}: {said.partition(' sure): ')[0]} sure){more}; see NOT SURE in {file}"


def _model(file: str) -> dict[str, Any]:
    from softneck.report import model_values

    return model_values(file, load(file, role="model"))


def _tell(facts: dict[str, Any], *, as_json: bool) -> None:
    from softneck.tuning import Loosened

    folder, failed = facts["folder"], [row for row in facts["steps"] if not row["holds"]]
    if as_json:
        print_json(facts)
    else:
        for sort, model in facts["models"].items():
            fits = "/".join(map(percent, model["fit"].values()))
            said = f"simulation {fits} % over the rows held out" if fits else "not judged on rows held out"
            click.echo(f"\nbest {sort} model: {model['kind']}, {said}, {model['file']}")
        print_table(f"Verdict on {folder}", ["step", "", "processor time [s]"], _rows(facts))
        for metric, one in facts["loosened"].items():
            click.echo(f"all holds but {Loosened(**one).in_words(metric)}")
        if facts["loosened"]:
            click.echo(_SECOND_VISIT.format(folder=folder, motion=_MOTION if _plays_signals(folder) else _STEPS))
        for line in (*facts["draws"], *(f"{what}: {how}" for what, how in facts["judged_elsewhere"].items())):
            click.echo(line)
        for doubt in (one for found in facts["doubts"].values() for one in found):
            click.echo(f"not sure: {doubt}")
        click.echo(f"report: {folder}/{facts['report']}")
    unsure = _unsure(facts)
    if unsure and not failed:
        note(unsure)
    if failed:
        more = f" ({len(failed)} of {len(STAGES)} steps: {', '.join(facts['failed'])})" if failed[1:] else ""
        also = f" ({unsure}.)" if unsure else ""
        raise CheckFailedError(f"{failed[0]['stage']} does not hold{more}: {failed[0]['said']}{also}")


def _rows(facts: dict[str, Any]) -> list[list[str]]:
    found = []
    for stage in STAGES:
        rows = [row for row in facts["steps"] if row["stage"] == stage]
        verdict = "holds" if stage in ("tune", "verify", "loop", "test") else "done"
        if stage == "tune" and facts["loosened"]:
            verdict = f"holds all but {', '.join(facts['loosened'])}"
        if not all(row["holds"] for row in rows):
            verdict = "fails"
        if not rows:
            verdict = f"not run: {facts['not_run'].get(stage, 'not needed')}"
        found.append([stage, verdict, f"{sum(row['seconds'] for row in rows):.1f}"])
    return found
