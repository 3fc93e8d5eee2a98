"""Replay of a logged run: the same received frames must give the same sent frames, bit for bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import CheckFailedError, DataError, SettingsError
from softneck.drives.logs._cycle import meaning

from ..master import Master, MasterSettings
from ..master._master import Measurement, Motors, Pilot
from ..supervision._baseline import Baseline
from ..supervision._calibrate import calibrate, require_loops
from ..supervision._motor_models import Motion, MotionLog
from ._cycle import Answer, Cycle, LoggedPilot, cycle_of
from ._log_file import LoggedRun, read_run_log


@dataclass(frozen=True, slots=True)
class Difference:
    """The first difference between a replay and its log.

    `cycle`: number of the step. `time`: [s] after the first step. `what`: the quantity that differs, in words.
    `logged`, `replayed`: both sides.
    """

    cycle: int
    time: float
    what: str
    logged: str
    replayed: str

    def __str__(self) -> str:
        """Return one line on the difference."""
        return f"cycle {self.cycle}, t = {self.time:.3f} s: {self.what}: logged {self.logged}, replayed {self.replayed}"


@dataclass(frozen=True, slots=True)
class Replay:
    """Result of a replay.

    Attributes:
        cycles: number of replayed steps.
        frames: number of compared frames.
        answers: number of controller answers computed again and compared; 0 if the logged ones were used.
        phase, fault: last phase of the replayed run, and the fault that ended it.
        difference: the first one, or None.
        notes: on the result.
    """

    cycles: int
    frames: int
    answers: int
    phase: str
    fault: str
    difference: Difference | None
    notes: tuple[str, ...] = ()

    def require(self) -> None:
        """Raise CheckFailedError if there is a difference."""
        if self.difference is not None:
            raise CheckFailedError(f"the replay differs from the log at {self.difference}.")

    def table(self) -> dict[str, Any]:
        """Return the JSON of `softneck simulate`."""
        found = self.difference
        return {
            "equal": found is None,
            "cycles": self.cycles,
            "frames": self.frames,
            "controller_answers": self.answers,
            "phase": self.phase,
            "fault": self.fault or None,
            "first_difference": None if found is None else {
                "cycle": found.cycle, "time_s": found.time, "what": found.what, "logged": found.logged,
                "replayed": found.replayed,
            },
            "notes": list(self.notes),
        }  # fmt: skip


class _ReplayPilot:
    """A pilot with the answers in the log."""

    def __init__(self) -> None:
        self.answers: list[Answer] = []

    def start(self) -> None:
        self._next("start")

    def step(self, measured: Measurement) -> Motors | None:
        del measured
        return self._next("step")

    @property
    def reference(self) -> tuple[float, ...]:
        if self.answers and self.answers[0][0] == "reference":
            return self._next("reference")
        return ()

    def is_finished(self, index: int) -> bool:
        del index
        return bool(self._next("finished"))

    def _next(self, what: str) -> Any:
        if not self.answers or self.answers[0][0] != what:
            raise _DivergenceError(f"the core asked for `{what}`, which it did not in the logged run")
        value = self.answers.pop(0)[1]
        if isinstance(value, str):
            # The same event has the same text; the exception itself is gone.
            name, _, text = value.partition(": ")
            raise type(name if name.isidentifier() else "LoggedError", (Exception,), {})(text)
        return value


class _DivergenceError(Exception):
    """The replayed master calls the pilot differently from the log."""


def replay(
    log: LoggedRun,
    pilot: Pilot | None = None,
    notes: Iterable[str] = (),
    *,
    watches: Sequence[Callable[..., object]] = (),
) -> Replay:
    """Feed the log's frames, samples, requests and times to a new master and compare its frames with the log.

    Args:
        log: of the run.
        pilot: the run's controller, to compute and compare its answers too; without it the logged answers are used.
        notes: for the result.
        watches: called after each cycle, as in a run.

    Raises:
        DataError: the log has no cycles.
    """
    if not log.cycles:
        raise DataError(f"{log.path}: holds no cycle of the master; there is nothing to replay.")
    recalled = _ReplayPilot()
    listened = LoggedPilot(recalled if pilot is None else pilot)
    master = Master(log.settings(), listened)
    begin, frames, answers, found = log.cycles[0].time, 0, 0, None
    done = 0
    for number, cycle in enumerate(log.cycles):
        recalled.answers = list(cycle.answers)
        for what, why in cycle.taken:
            _ask_again(master, what, why)
        sent = master.step(cycle.time, cycle.received, cycle.tilt)
        for watch in watches:
            watch(cycle.time, cycle.received, sent, cycle.tilt, master)
        again = cycle_of(master, listened, cycle.time, cycle.received, cycle.tilt, sent)
        frames += len(sent)
        answers += sum(what == "step" for what, _ in again.answers) if pilot is not None else 0
        done = number + 1
        where = _first(cycle, again)
        if where is not None:
            found = Difference(number, cycle.time - begin, *where)
            break
    fault = master.supervisor.fault
    told = [*notes, *([f"{log.path}: {log.cut}: replayed up to the cut"] if log.cut else [])]
    return Replay(
        done, frames, answers, str(master.supervisor.phase), "" if fault is None else str(fault), found, tuple(told)
    )


def logged_motion(log: LoggedRun, like: MasterSettings) -> Motion:
    """Return the undisturbed motion of a log, for drives with the settings `like`.

    Raises:
        DataError: a log of other drives, or a run that ended with a fault.
        CheckFailedError: the replay differs from the log.
    """
    settings = log.settings()
    for name, ours, theirs in (
        ("counts_per_radian", like.counts_per_radian, settings.counts_per_radian),
        ("newton_per_unit", like.newton_per_unit, settings.newton_per_unit),
        ("cycle", like.bus.cycle, settings.bus.cycle),
        ("sample_cycles", like.sample_cycles, settings.sample_cycles),
        ("outputs", like.outputs, settings.outputs),
    ):
        if ours != theirs:
            raise DataError(f"{log.path}: `{name}` is {theirs} there and {ours} here; take a log of these drives.")
    motion = MotionLog()
    found = replay(log, watches=(motion,))
    found.require()
    if found.fault:
        raise DataError(f"{log.path}: ended by {found.fault}; take one of motion that nothing disturbed.")
    return motion.motion()


def _ask_again(master: Master, what: str, why: str) -> None:
    if what == "stop":
        master.stop(why)
    elif what == "leave":
        master.leave(why)
    else:
        (master.start if what == "start" else master.finish)()


def _first(logged: Cycle, again: Cycle) -> tuple[str, str, str] | None:
    """Return the first difference in one step: in the controller's answer, the frames, or the phase."""
    # Logs from before the comparison of loops have no references.
    told = any(what == "reference" for what, _ in logged.answers)
    answers = tuple(answer for answer in again.answers if told or answer[0] != "reference")
    # Compared as texts: NaN is not equal to itself, and 0.0 is equal to -0.0.
    if repr(logged.answers) != repr(answers):
        return "the controller's answer", _answers(logged.answers), _answers(again.answers)
    if logged.sent != again.sent:
        for one, other in zip(logged.sent, again.sent, strict=False):
            if one != other:
                return f"frame {one.identifier:03X}h", meaning(one), meaning(other)
        return "number of frames", str(len(logged.sent)), str(len(again.sent))
    if logged.phase != again.phase:
        return "phase", logged.phase, again.phase
    return None


def _answers(answers: Sequence[Answer]) -> str:
    return "; ".join(f"{what} {value}" for what, value in answers) or "none"


def baseline(logs: Sequence[str | Path]) -> Baseline:
    """Return the baseline of logs; `save` it and set `[supervision] baseline` in the drives file.

    Args:
        logs: `.mcap` of `softneck drives record`, such as one without and one with a payload, together at least 40 s;
            logs of `run` add the tracking model of a loop.

    Raises:
        SettingsError: no log.
        DataError: different drives, disturbed or too short motion, or motors that did not move.
        CheckFailedError: a log whose replay differs.
    """
    if not logs:
        raise SettingsError("no log was given.")
    runs = [read_run_log(Path(path)) for path in logs]
    like = runs[0].settings()
    motions = [logged_motion(run, like) for run in runs]
    if loops := [len(motion.due) * like.bus.cycle for motion in motions if motion.references is not None]:
        require_loops(sum(loops))
    return calibrate(motions, cycle=like.bus.cycle, sample_cycles=like.sample_cycles, slack=like.limits.slack)
