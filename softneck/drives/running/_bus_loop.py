"""The loop on the bus that `run`, `record` and `jog` share: pre-flight, enabling, ramps, the pilot, ramps, off.

On simulated drives it runs in virtual time, on a bus at the pace of the monotonic clock. Who wants to see what happens
(logs, recordings, a watchdog, a display) is called once a cycle.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from softneck.core import SettingsError

from ..bus._file import DrivesFile
from ..bus._link import CanLink, GuardedLink, VirtualLink
from ..logs._cycle import LoggedPilot
from ..logs._result import CycleTimes, fault_table, require_unstopped
from ..logs._run_log import RunLogger, run_facts
from ..master import Event, Frame, Master, MasterSettings
from ..master._cia402 import OFF
from ..master._fieldbus import Command as NmtCommand
from ..master._fieldbus import nmt_frame
from ..master._master import Pilot
from ..master._supervisor import ACTIVE
from ..sensing._sources import Sensor
from ._keyboard import Keyboard
from ._preflight import preflight
from ._stop import disarm, stop
from ._timing import Ask, Notifier, Operator, steady
from ._virtual import VirtualRun, Watch

# Before the first cycle on a bus each drive is given this time to become operational [s].
_START_TIME = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """Drives, link, sensor and log on which a pilot runs.

    Attributes:
        file: how drives and master are set up.
        link: to simulated drives, or an open bus.
        sensor: the inclinometer on a bus; simulated drives have their own.
        override: names of pre-flight checks that may fail.
        pace: of simulated drives, in multiples of real time; None: as fast as possible.
        watches: called after each cycle with (now, frames in, frames out, sample of the inclinometer or None, master).
            On a bus they run in the control loop: what takes long belongs to another thread or process.
        operator: asked each cycle what somebody at the keyboard wants.
        settings: changes the master's settings, for tests.
        log: of frames and cycles; its owner closes it.
        files: role -> path of what acts in the run, for the log.
        facts: what else the log says about the run; `replay` computes an experiment or a jog again from it.
    """

    file: DrivesFile
    link: CanLink | VirtualLink
    sensor: Sensor | None = None
    override: Collection[str] = ()
    pace: float | None = None
    watches: tuple[Watch, ...] = ()
    operator: Operator | None = None
    settings: Callable[[MasterSettings], MasterSettings] | None = None
    log: RunLogger | None = None
    files: Mapping[str, str | Path] = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Whether time is virtual."""
        return isinstance(self.link, VirtualLink)

    @property
    def folder(self) -> Path | None:
        """Where rows are kept during the run: beside the log; None: where temporary files are."""
        return None if self.log is None else self.log.path.parent


@dataclass(frozen=True, slots=True, eq=False)
class RunEnd:
    """A run that is over; its drives are off.

    Attributes:
        master: as it ended.
        times: of the cycles, in real time.
        wall_time: [s].
        terminated: whether SIGTERM asked for the end.
        tensions: estimated when the drives last had power [N].
        error: which ended the loop, or kept the drives from being switched off; None without one.
    """

    master: Master
    times: CycleTimes
    wall_time: float
    terminated: bool = False
    tensions: tuple[float, ...] = ()
    error: Exception | None = None

    def require(self) -> None:
        """Raise the error that ended the loop, or CheckFailedError if something else stopped the drives."""
        if self.error is not None:
            raise self.error
        supervisor = self.master.supervisor
        require_unstopped(supervisor.fault, rehome=supervisor.rehome)

    @property
    def left(self) -> bool:
        """Whether the operator ended it, at once or by the ramp out."""
        counts = self.master.counts
        return counts["left"] + counts["operator"] > 0

    def table(self) -> dict[str, Any]:
        """Return the JSON values."""
        master = self.master
        return {
            "phase": str(master.supervisor.phase),
            "fault": fault_table(master.supervisor.fault),
            "rehome": master.supervisor.rehome,
            "events": dict(master.counts),
            "cycles": master.cycle,
            "cycle_s": master.settings.bus.cycle,
            "real_time_factor": master.cycle * master.settings.bus.cycle / max(self.wall_time, 1e-9),
        }


def run_session(
    session: Session, pilot: Pilot, *, sample_time: float, most: float, begin: Callable[[Master], None] | None = None
) -> RunEnd:
    """Check the drives, enable them, ramp in, let `pilot` lead, ramp out, switch off.

    On a bus without an operator a `Keyboard` is one: SIGTERM ends it by the ramp to rest, a second one at once. A
    service manager is told (sd_notify) when the pre-flight holds, which phase the run is in, and that the loop lives.
    `session`: on what. `pilot`: gives set-points each `sample_time`. `sample_time`: [s]; a multiple of the bus period.
    `most`: length of what the pilot does [s]. `begin`: called with the master before the first cycle. Raises
    CheckFailedError: the pre-flight failed; nothing moved.
    """
    if session.simulated:
        return _run_session(session, pilot, sample_time, most, begin, Notifier({}))
    with steady(), Notifier() as notifier, contextlib.ExitStack() as stack:
        operator = session.operator or stack.enter_context(Keyboard())
        return _run_session(replace(session, operator=operator), pilot, sample_time, most, begin, notifier)


def _run_session(
    session: Session,
    pilot: Pilot,
    sample_time: float,
    most: float,
    begin: Callable[[Master], None] | None,
    notifier: Notifier,
) -> RunEnd:
    file, link = session.file, session.link
    if not session.simulated and session.sensor is None:
        raise SettingsError("drives on a bus need an inclinometer.")
    file.master_settings(sample_time)
    log = session.log
    if log is not None:
        link.tap = log.frame
    checked = preflight(link, file, override=session.override, homed=True, sensor=session.sensor)
    checked.require()
    settings = file.master_settings(sample_time, guarding=checked.guarding, late_modes=tuple(checked.late_modes))
    settings = settings if session.settings is None else session.settings(settings)
    if log is not None:
        facts = {**file.moves.in_header(), **session.facts}
        log.describe(run_facts(settings, session.files, simulated=session.simulated, **facts))
        pilot = LoggedPilot(pilot)
        session = replace(session, watches=(*session.watches, log.watch(pilot)))
    master = Master(settings, pilot)
    link.send([nmt_frame(NmtCommand.START, node) for node in file.nodes])
    if begin is not None:
        begin(master)
    times = CycleTimes(file.cycle)
    tensions = [(0.0,) * len(file.nodes)]

    def remember(_now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Any, master: Master) -> None:
        if master.supervisor.phase in ACTIVE:
            tensions[0] = master.tensions

    session = replace(session, watches=(remember, *session.watches))
    started = time.perf_counter()
    master.start()
    error: Exception | None = None
    try:
        if isinstance(link, VirtualLink):
            link.receive(_START_TIME)
            _in_virtual_time(session, link, master, times, most)
        else:
            time.sleep(_START_TIME)
            link.receive(0.0)
            notifier.ready()
            _in_real_time(session, link, master, times, notifier)
    except BaseException as failure:
        # Whatever happens here must not leave a drive on, for this loop feeds them, and must not lose the recording.
        fed = _emergency_stop(link, file, master)
        if not isinstance(failure, Exception):
            raise
        error = failure
        _take_back(master, Event(link.now, "loop_failed", 0, f"{type(failure).__name__}: {failure}"))
    else:
        fed = not master.starved
    failed = _switch_off(link, file, checked.guarding, master, master.bus.signs_of_life() if fed else ())
    terminated = bool(getattr(session.operator, "terminated", False))
    return RunEnd(master, times, time.perf_counter() - started, terminated, tensions[0], error or failed)


def _switch_off(
    link: CanLink | VirtualLink, file: DrivesFile, guarding: str, master: Master, signs: Sequence[Frame]
) -> Exception | None:
    """End the guarding of the drives; a drive that is not off ends a run that looked done. Return what failed."""
    error: Exception | None = None
    try:
        left = disarm(link, file, guarding, signs)
    except Exception as failure:  # the recording must not be lost by it
        error, left = failure, dict.fromkeys(file.nodes, f"{type(failure).__name__}: {failure}")
    if master.supervisor.fault is None:
        for node, why in left.items():
            _take_back(master, Event(link.now, "not_off", node, why))
    return error


def _take_back(master: Master, event: Event) -> None:
    """Let `event` end a run that looked done."""
    master.supervisor.revoke(event)
    master.counts[event.name] += 1
    master.events.append(event)


def _in_virtual_time(
    session: Session, link: VirtualLink, master: Master, times: CycleTimes, most: float
) -> None:  # fmt: skip
    begin, first = time.perf_counter(), link.now

    def ends(_now: float, _in: Sequence[Frame], _out: Sequence[Frame], _tilt: Any, _master: Master) -> None:
        now = time.perf_counter()
        times.take(now, 0.0)
        if session.operator is not None:
            _ask(master, session.operator())
        if session.pace is not None:
            rest = begin + (link.now - first + link.cycle) / session.pace - now
            if rest > 0.0:
                time.sleep(rest)

    run = VirtualRun(link, master, watches=(*session.watches, ends))
    run.run(most)


def _in_real_time(session: Session, link: CanLink, master: Master, times: CycleTimes, notifier: Notifier) -> None:
    """Step the master at its period until it is done."""
    sensor, operator = cast("Sensor", session.sensor), session.operator
    period = master.settings.bus.cycle
    due = link.now
    while not master.finished:
        rest = due - link.now
        if rest > 0.0:
            time.sleep(rest)
        now = link.now
        # All that is there, so that one late TPDO does not leave a lag for ever.
        frames = link.receive(0.0)
        tilt = None
        if master.sample_due:
            tilt = sensor.read(now, frames)
        else:
            sensor.take(frames)
        if operator is not None:
            _ask(master, operator())
        out = master.step(now, frames, tilt)
        link.send(out)
        times.take(now, link.now - now)
        notifier.cycle(now, master)
        for watch in session.watches:
            watch(now, frames, out, tilt, master)
        due = max(due + period, now + 0.5 * period) if link.now - due > period else due + period


def _ask(master: Master, ask: Ask | None) -> None:
    if ask is Ask.STOP:
        master.stop("asked to")
    elif ask is Ask.LEAVE:
        master.leave("asked to")


def _emergency_stop(link: CanLink | VirtualLink, file: DrivesFile, master: Master) -> bool:
    """Stop all drives, guarded until they had the time to; return whether all are off."""
    guarded = GuardedLink(link, master.bus.signs_of_life(), file.guard_cycles * file.cycle)
    try:
        states = stop(guarded, file)
    except Exception:  # the drives' own guarding stops them where nothing can be sent any more
        return False
    return all(state in {one.name for one in OFF} for state in states.values())
