"""The steps of `softneck start`, in order: each reads the files of the steps before it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from math import isclose
from pathlib import Path

from softneck import signals
from softneck.core import MOST_TOML, load, read_toml
from softneck.robot import Robot

from ..shared._console import note
from ._possible import FILE, backend, lacking, possible, propose_missing, require_known

#: In the order of the work, as they are counted for the user.
STAGES = ("import", "robot", "quality", "identification", "observer", "tune", "verify", "FMUs", "loop", "study",
          "test", "report")  # fmt: skip


class Unmet(Enum):
    """The consequence of a step that ends with exit code 1."""

    FINDING = "a result; the run continues"
    NO_MODEL = "no usable model; the run ends"
    DONE_WITHOUT = "the later steps do without its files, whatever the reason"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A command, run in the project's folder.

    Attributes:
        stage: one of `STAGES`.
        command: its words; paths are relative to the folder.
        makes: files that exist when it is done.
        reads: files; a change of one repeats the step.
        unmet: the consequence if it does not hold, or if a model is refused.
        finding: a requirement that cannot hold whatever the result; empty if there is none.
        settings: repeats the step when it changes; the command if empty.
        resumes: file of an interrupted run, from which it continues without `--force`.
        beside: later steps that read nothing of it or of those between: they begin with it, on another core.
        compiles: recordings, of a step beside which the functions of later steps are compiled; see `compile_ahead`.
    """

    stage: str
    command: tuple[str, ...]
    makes: tuple[str, ...]
    reads: tuple[str, ...] = ()
    unmet: Unmet = Unmet.FINDING
    finding: str = ""
    settings: str = ""
    resumes: str = ""
    beside: tuple[Step, ...] = ()
    compiles: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Key of the step in the project's file."""
        return f"{self.stage}: {self.makes[0]}"

    @property
    def depends_on(self) -> str:
        """Settings whose change repeats the step."""
        return self.settings or self.shown

    @property
    def shown(self) -> str:
        """The command as a shell takes it."""
        return shlex.join(self.command)


TUNER, CERTIFICATE = "tune/tuner.html", "certificates/best.certificate.json"
AUTO, PI, OBSERVER, BEST = "models/auto.npz", "controllers/pi.npz", "observers/kalman.npz", "tune/best.npz"
FAMILY = "models/family.npz"
PLANT_FMU, OBSERVER_FMU, CONTROLLER_FMU = "fmus/Plant.fmu", "fmus/Observer.fmu", "fmus/Controller.fmu"
_FMUS = (PLANT_FMU, OBSERVER_FMU, CONTROLLER_FMU)
# Of `tune`: without `adaptive`, which was the best on none of the foreign
# necks `column`, `spring` and `chain`, and takes a fifth of a search with empty caches.
_CONTROLLER_KINDS = "pi,pid,fopi,hinf,lqg"
# Beside draws other kinds were not better: their feedforward sets the speed.
KINDS_BESIDE_DRAWS = "pi,hinf"
# Evaluations of `tune` without draws, and beside them: 20 more changed no certified rise of `chain`, `column`,
# `spring`, `foam`, a finger and a platform.
_BUDGETS = (60, 40)
# With a family it gets no certificate: its loops pull no tendons as the recordings do.
_KINDS_WITHOUT_FAMILY = ",mpc"
_TUNED_LOOP, _REQUIREMENTS = "tune/loop.toml", "tune/requirements.toml"


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """The options of the user.

    Attributes:
        logs: absolute paths, as the commands run in the project's folder.
        robot: a preset, or the absolute path of a robot file; None: the neck, or what the log shows.
        requirements: absolute path of the file for `tune`; None: the defaults.
        kinds: of controllers to search; None: those of `tune` but `adaptive`.
        sample_time: of logs without a clock [s].
        motors, positions, outputs: columns of the logs that were named; () for a guess.
        budget: of `tune`; None: 40 evaluations beside draws, else 60.
        seed: of kinds of models and of the search.
        yes: take all guesses.
        backend: of the FMUs.
        tested: whether the closed loop's test can be run here.
    """

    logs: tuple[str, ...]
    robot: str | None = None
    requirements: str | None = None
    kinds: str | None = None
    sample_time: str | None = None
    motors: Sequence[str] = ()
    positions: Sequence[str] = ()
    outputs: Sequence[str] = ()
    budget: int | None = None
    seed: int = 0
    yes: bool = False
    backend: str = "compiled"
    tested: bool = True


def steps(options: Options) -> Iterator[Step]:
    """Yield the steps; the folder of the project is the working folder."""
    if options.robot is not None:
        yield _robot(options.robot)
    recordings = []
    for log in options.logs:
        recordings.append(f"recordings/{Path(log).stem}.csv")
        yield _import(log, recordings[-1], options)
    if options.robot is None:
        # Of a log of one axis the import proposes a robot of one output.
        proposed = Path(recordings[0]).with_suffix(".robot.toml")
        yield _robot(proposed.as_posix() if proposed.is_file() else "neck")
    yield from _with_sensor(recordings, options)
    imported = list(recordings)
    yield from _of_one_sample_time(recordings)
    for recording in imported:
        page = f"build/quality/{Path(recording).stem}.html"
        command = ("softneck", "info", recording, "--html", page, "--force")
        yield Step(stage="quality", command=command, makes=(page,), reads=(recording,), beside=(_family(recordings),),
                   compiles=tuple(recordings))  # fmt: skip
    yield from _models(recordings, options)
    yield from _controller(options)
    yield from _loops(options)


def _with_sensor(recordings: list[str], options: Options) -> Iterator[Step]:
    """Add missing values of sensor and proposed motors to `robot.toml`; import again the logs of a given robot."""
    read = [signals.read_recording(recording) for recording in recordings]
    proposed = propose_missing(Path("robot.toml"), read, motors=options.robot is None)
    if proposed and options.robot is not None:
        yield from (_import(log, recording, options) for log, recording in zip(options.logs, recordings, strict=True))


def _robot(source: str) -> Step:
    command = ("softneck", "robot", "new", "robot.toml", "--preset", source, "--force")
    return Step(stage="robot", command=command, makes=("robot.toml",), reads=(source,))


def _import(log: str, recording: str, options: Options) -> Step:
    layout, robot = (Path(recording).with_suffix(ending) for ending in (".layout.toml", ".robot.toml"))
    whose = "robot.toml" if options.robot is not None else robot.as_posix() if robot.is_file() else None
    page, settings = f"build/import/{Path(recording).stem}.html", f"{log} of {options.robot}"
    if Path(log).suffix.lower() == ".mcap" and signals.is_run_log(Path(log)):
        words: list[str] = []  # of a run on drives: its columns are known
    else:
        guess = ["--guess", *(["--yes"] if options.yes else [])]
        guess += [] if options.sample_time is None else ["--sample-time", options.sample_time]
        stored = signals.robot_in_file(Path(log), Path(log).suffix.lower())
        if options.robot is None and stored is None and signals.is_of_another_robot(log):
            guess[:1] = ["--robot-out", robot.as_posix()]
            guess = [word for word in guess if word != "--yes"]
        by_layout = layout.is_file() and not (options.sample_time is not None and _lacks_clock(layout))
        words = ["--layout", layout.as_posix()] if by_layout else guess
        columns = (("--motor", options.motors), ("--position", options.positions), ("--output", options.outputs))
        if named := [word for option, titles in columns for title in titles for word in (option, title)]:
            words = named + ([] if options.sample_time is None else ["--sample-time", options.sample_time])
            words += ["--yes"] if options.yes else []
            settings += f", {shlex.join(named)}"
            whose = None if options.robot is None else whose  # else it is of what was named before
        words += ["--html", page] + ([] if whose is None else ["--robot", whose])
    return Step(
        stage="import", command=("softneck", "import", log, *words, "-o", recording, "--force"), makes=(recording,),
        reads=(log, layout.as_posix(), *([] if whose is None else [whose])), settings=settings,
    )  # fmt: skip


def _lacks_clock(layout: Path) -> bool:
    """Return whether the sample time of a proposed layout is still missing."""
    with layout.open(encoding="utf-8", errors="replace") as file:
        return "MISSING the sample time" in file.read(MOST_TOML)


def _of_one_sample_time(recordings: list[str]) -> Iterator[Step]:
    """Bring recordings to the sample time of the first, in `recordings`, where they differ."""
    if len(recordings) < 2:
        return
    first = signals.read_recording(recordings[0]).sample_time
    for number, recording in enumerate(recordings):
        if isclose(signals.read_recording(recording).sample_time, first, rel_tol=1e-6):  # as `identify` has it
            continue
        recordings[number] = resampled = f"{recording.removesuffix('.csv')}_resampled.csv"
        command = ("softneck", "import", recording, "--resample", repr(first), "-o", resampled, "--force")
        yield Step(stage="quality", command=command, makes=(resampled,), reads=(recording, recordings[0]))


def _models(recordings: list[str], options: Options) -> Iterator[Step]:
    """Yield the identification steps; `design pi` refuses a model that is too poor."""
    seed = str(options.seed)
    command = ("softneck", "identify", "auto", *recordings, "-o", AUTO, "--html", "build/models.html", "--seed", seed,
               "--force")  # fmt: skip
    robot = Robot.read("robot.toml")
    if absent := lacking(robot):
        note(f"robot.toml lacks {', '.join(absent)}: add them now, or the run ends after the models")
    family = _family(recordings)
    yield Step(stage="identification", command=command, makes=(AUTO,), reads=tuple(recordings), unmet=Unmet.NO_MODEL,
               beside=(family,), compiles=tuple(recordings))  # fmt: skip
    require_known(Robot.read("robot.toml"))
    linear = linear_model()
    command = ("softneck", "design", "pi", linear, "-o", PI, "--force")
    yield Step(stage="identification", command=command, makes=(PI,), reads=(linear,), unmet=Unmet.NO_MODEL)
    data = [word for recording in recordings for word in ("--data", recording)]
    command = ("softneck", "observer", linear, *data, "-o", OBSERVER, "--force")
    yield Step(stage="observer", command=command, makes=(OBSERVER,), reads=(linear, *recordings),
               beside=tuple(_fmus(options)[:1]))  # fmt: skip
    yield family


def _family(recordings: Sequence[str]) -> Step:
    """Return the step with which linear checks cover the uncertainty of the recordings, not one nominal model."""
    words = ("softneck", "family", *recordings, "-o", FAMILY, "--html", "build/family.html", "--force")
    return Step(stage="identification", command=words, makes=(FAMILY,), reads=tuple(recordings),
                unmet=Unmet.DONE_WITHOUT)  # fmt: skip


def linear_model() -> str:
    """Return the file of the best linear model."""
    beside = AUTO.replace(".npz", "_linear.npz")
    return beside if Path(beside).is_file() else AUTO


def nonlinear_model() -> str | None:
    """Return the file of the best nonlinear model; None if no such kind could be simulated."""
    beside = AUTO.replace(".npz", "_nonlinear.npz")
    return beside if Path(beside).is_file() else AUTO if linear_model() != AUTO else None


def _controller(options: Options) -> Iterator[Step]:
    family = Path(FAMILY).is_file()
    linear, nonlinear = FAMILY if family else linear_model(), nonlinear_model()
    plant = _plant()
    # Where draws decide, a nonlinear model that predicts worse than the linear one has no say.
    drawn = family and load(FAMILY).draws is not None
    plants = (linear, AUTO if drawn else plant) if family or nonlinear else (linear,)
    kinds = KINDS_BESIDE_DRAWS if drawn else _CONTROLLER_KINDS + _KINDS_WITHOUT_FAMILY * (not family)
    kinds = options.kinds or kinds
    # Requirements of the user stay; infeasible defaults are left out, and the step fails.
    finding = possible(plants) if options.requirements is None else ""
    stated = FILE if finding else options.requirements
    wanted = () if stated is None else (stated,)
    words = [word for name, value in (("--requirements", stated), ("--kinds", kinds),
                                      ("--budget", options.budget or _BUDGETS[drawn]), ("--seed", options.seed))
             if value is not None for word in (name, str(value))]  # fmt: skip
    # --force continues the same search, and replaces another one.
    command = ("softneck", "tune", *plants, *words, "--observer", OBSERVER, "-o", "tune", "--force")
    fmus = _fmus(options)
    yield Step(stage="tune", command=command, makes=(BEST, _TUNED_LOOP, "tune/report.html", TUNER),
               reads=(*plants, OBSERVER, *wanted), finding=finding, beside=tuple(fmus[:2]))  # fmt: skip
    eyes = (OBSERVER,) if "observer" in read_toml(_TUNED_LOOP) else ()
    command = ("softneck", "verify", BEST, *plants, "--requirements", _REQUIREMENTS,
               *(word for file in eyes for word in ("--observer", file)),
               "-o", CERTIFICATE, "--html", "build/verify.html", "--force")  # fmt: skip
    yield Step(stage="verify", command=command, makes=(CERTIFICATE, "build/verify.html"),
               reads=(BEST, *plants, _REQUIREMENTS, *eyes))  # fmt: skip
    yield from fmus


def _plant() -> str:
    """Return the file of the model that loops and FMUs take for the robot."""
    return nonlinear_model() or linear_model()


def _fmus(options: Options) -> list[Step]:
    """Return the steps of the three FMUs: plant, observer, controller."""
    made = options.backend
    if made == "compiled":
        robot = Robot.read("robot.toml")
        made = backend(packaged=(len(robot.motors.names), len(robot.outputs.names)) == (3, 2))
    return [
        Step(stage="FMUs", command=("softneck", "fmu", file, "--backend", made, "-o", fmu, "--force"), makes=(fmu,),
             reads=(file,)) for file, fmu in ((_plant(), PLANT_FMU), (OBSERVER, OBSERVER_FMU), (BEST, CONTROLLER_FMU))
    ]  # fmt: skip


def _loops(options: Options) -> Iterator[Step]:
    files = ("README.md", "loop.toml", "study.toml", "test_closed_loop.py", "pyproject.toml", ".gitignore")
    command = ("softneck", "new", ".", "--loop", _TUNED_LOOP, "--force")
    yield Step(stage="loop", command=command, makes=("loop.toml", *files), reads=(_TUNED_LOOP, "robot.toml"))
    command = ("python", "-m", "pytest", "-q", "-p", "no:cacheprovider", "--junitxml", "build/test.xml")
    tests = [Step(stage="test", command=command, makes=("build/test.xml",),
                  reads=("test_closed_loop.py", "loop.toml", *_FMUS))] if options.tested else []  # fmt: skip
    page, certificate = "build/loop.html", "loop.certificate.json"
    command = ("softneck", "simulate", "loop.toml", "-o", "results/loop.csv", "--html", page, "--force")
    if "limits" in read_toml("loop.toml"):
        command += ("--certificate", certificate)
    yield Step(stage="loop", command=command, makes=("results/loop.csv", page), reads=("loop.toml", *_FMUS),
               beside=tuple(tests))  # fmt: skip
    # In this process: its 30 runs take less time than two processes that import what is loaded here.
    command = ("softneck", "study", "study.toml", "--workers", "0", "-o", "build/study", "--force")
    yield Step(stage="study", command=command,
               makes=("build/study/runs.csv", "build/study/report.html"),
               reads=("study.toml", "loop.toml", *_FMUS), resumes="build/study/study.json")  # fmt: skip
    yield from tests
    command = ("softneck", "report", ".", "-o", "build/report.html", "--force")
    yield Step(stage="report", command=command, makes=("build/report.html",),
               reads=(AUTO, BEST, CERTIFICATE, TUNER, "results/loop.csv", "build/study/runs.csv",
                      "build/test.xml"))  # fmt: skip
