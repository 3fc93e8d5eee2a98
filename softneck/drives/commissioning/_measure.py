"""The moves of a commissioning: on drives, over the master of every run, with limits of their own; and on the virtual
plant that stands for them, which says what to expect.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

from softneck.core import CheckFailedError
from softneck.plant import NeckParameters

from ..bus._file import DrivesFile
from ..bus._link import CanLink, VirtualLink
from ..bus._sdo import Objects, SdoError
from ..master import Frame, Master, MasterSettings
from ..master._settings import ChannelSettings
from ..running._bus_loop import RunEnd, Session, run_session
from ..running._stop import wait
from ..running._virtual import physics_of, simulated_neck
from ._identify import Expected, seen_by
from ._mover import Mover
from ._moves import Guards, Moves

SAMPLE_TIME = 0.02
# Winches without power unwind until nothing pulls them: less than `_STILL` rad in `_LOOK` s, for 10 s at most.
_LOOK, _STILL, _PATIENCE = 0.5, 0.01, 10.0
# Touch probe: on, at each event, at the encoder's index, its rising edge (CiA 402-2, 60B8h); the index is asked for
# each so many cycles.
_PROBE, _PROBE_ON, _CAPTURED, _ASK = 0x60B8, 0x17, 0x60BA, 10
# Nothing is known yet of what these checks compare with.
_SKIPPED_CHECKS = ("homed", "identity", "firmware")
# No watch on what is to be found out; the guards of the moves are narrower.
_OPEN = {"pushed": 200.0, "tilt": 1.6}


def measure(
    session: Session, guards: Guards, *, motors: Sequence[int], report: Callable[[float, str], None] | None = None
) -> tuple[Moves, RunEnd]:
    """Move `motors` (from 1 on) one after the other, switch the drives off, and return the measurements.

    What stopped it early is in the moves; those of the motors before are whole.
    Raises CheckFailedError: the pre-flight failed; nothing moved.
    """
    file = cautious(session.file, guards)
    scales = [entry.scale for entry in file.drives]
    mover = Mover(
        guards, file.nodes, [scale.counts_per_radian for scale in scales], [scale.counts_per_turn for scale in scales],
        motors=motors, sample_time=SAMPLE_TIME,
    )  # fmt: skip
    probe, own = _Probe(session.link, mover, file.nodes), session.settings

    def guard(_now: float, frames: Sequence[Frame], _out: Sequence[Frame], _tilt: Any, master: Master) -> None:
        if mover.stopped and not master.finished and not master.counts["operator"]:
            master.stop(mover.stopped)
        probe.take(frames, master.cycle)
        if report is not None and mover.motor and master.cycle % 50 == 0:
            report(mover.progress, f"motor {mover.motor}")

    def settings(made: MasterSettings) -> MasterSettings:
        made = made if own is None else own(made)
        return _from_here(session.link, file, made, guards, probe)

    session = replace(
        session, file=file, override=(*session.override, *_SKIPPED_CHECKS), settings=settings,
        watches=(guard, *session.watches),
    )  # fmt: skip
    most = guards.time * len(motors) + 60.0
    ended = run_session(session, mover, sample_time=SAMPLE_TIME, most=most, begin=mover.watch)
    fault = ended.master.supervisor.fault
    stopped = mover.stopped or ("somebody asked for the end" if ended.left else "" if fault is None else str(fault))
    return Moves(tuple(mover.done), stopped), ended


def expected_of(file: DrivesFile, guards: Guards, neck: NeckParameters | None = None) -> Expected | None:
    """Return the moves of the robot's virtual plant with drives as in `file`; None without a virtual plant.

    `file`: as believed. `guards`: as for the moves themselves. `neck`: physics of the virtual plant; None: those that
    the robot names.
    """
    physics = physics_of(file.moves, neck)
    if physics is None:
        return None
    # A sensor that sits as it should, next to no noise; every drive as the first, for a mistake would be in it as well.
    physics = physics.replace(noise_std=1e-6, noise_quantum=0.0, drift_std=0.0, dropout_rate=0.0)
    file = replace(file, sensor_axes=())
    link = VirtualLink(simulated_neck(file, physics, sample_time=SAMPLE_TIME, homed=False))
    moves, _ = measure(Session(file=file, link=link), guards, motors=tuple(range(1, len(file.drives) + 1)))
    return seen_by(moves, file, "the virtual plant, with drives as the file has them")


def cautious(file: DrivesFile, guards: Guards) -> DrivesFile:
    """Return `file` with the limits of the moves: low current, slow ramps, no limits on unknown positions."""
    current = file.zero.current if guards.current is None else guards.current
    drives = tuple(replace(entry, current_limit=min(current, entry.current_limit)) for entry in file.drives)
    far, robot = 1.1 * guards.travel + 1.0, file.robot
    if robot is not None:
        robot = replace(robot, motors=replace(robot.motors, setpoint_min=None, setpoint_max=None, rate_limit=None))
    return replace(
        file,
        drives=drives,
        limits=replace(file.limits, position=far, speed=2.0, slack_unwind=20.0),
        watch=replace(file.watch, **_OPEN),
        ramps=replace(file.ramps, speed=0.3, settle=0.2, tolerance=0.2),
        robot=robot,
    )


def _from_here(
    link: CanLink | VirtualLink, file: DrivesFile, settings: MasterSettings, guards: Guards, probe: _Probe
) -> MasterSettings:
    """Set P = 0 at the present winch positions, and the drives' own limits around it."""
    objects = [Objects(link, node) for node in file.nodes]
    here = _still(link, objects, settings.counts_per_radian)
    for one, entry, counts in zip(objects, file.drives, here, strict=True):
        far = round(abs(1.1 * guards.travel * entry.scale.counts_per_radian))
        for subindex, edge in ((1, counts - far), (2, counts + far)):
            if one.write_checked(0x607D, subindex, edge) != edge:
                raise CheckFailedError(f"node {entry.node}: 607Dh:{subindex} does not keep {edge}. Nothing was moved.")
        probe.begin(one)
    low = tuple((-1.1 * guards.travel, 1.1 * guards.travel, file.limits.speed) for _ in here)
    channels = ChannelSettings(outputs=file.moves.outputs.names, weights=(), ranges=low)
    return replace(settings, zero_counts=tuple(here), channels=channels)


def _still(
    link: CanLink | VirtualLink, objects: Sequence[Objects], counts_per_radian: Sequence[float]
) -> list[int]:  # fmt: skip
    until = link.now + _PATIENCE
    before = [one.read(0x6064) for one in objects]
    while True:
        wait(link, _LOOK)
        here = [one.read(0x6064) for one in objects]
        moved = max(abs((a - b) / k) for a, b, k in zip(here, before, counts_per_radian, strict=True))
        if moved < _STILL:
            return here
        if link.now > until:
            raise CheckFailedError(
                f"a winch still turns by {moved / _LOOK:.2f} rad/s without power. Let it come to rest; nothing was "
                "moved."
            )
        before = here


class _Probe:
    """Asks the drive that moves for the position of its encoder's last index pulse, within the cycles of the run."""

    def __init__(self, link: CanLink | VirtualLink, mover: Mover, nodes: Sequence[int]) -> None:
        self._link, self._mover, self._nodes = link, mover, tuple(nodes)
        self._able: set[int] = set()
        self._motor, self._first = 0, None

    def begin(self, objects: Objects) -> None:
        """Switch the touch probe on, before the first cycle; a drive without one has no index to tell."""
        try:
            objects.write(_PROBE, 0, 0)
            if objects.write_checked(_PROBE, 0, _PROBE_ON) == _PROBE_ON:
                self._able.add(objects.node)
        except SdoError as error:
            if not error.aborted:
                raise

    def take(self, frames: Collection[Frame], cycle: int) -> None:
        """Look for the answer to the last question, and ask the next."""
        motor = self._mover.motor
        if motor != self._motor:
            self._motor, self._first = motor, None
        if not motor or self._nodes[motor - 1] not in self._able:
            return
        node = self._nodes[motor - 1]
        about = bytes([0x43, _CAPTURED & 0xFF, _CAPTURED >> 8, 0])
        for frame in frames:
            if frame.identifier == 0x580 + node and frame.data[:4] == about and len(frame.data) == 8:
                counts = int.from_bytes(frame.data[4:8], "little", signed=True)
                # The first answer may be of before.
                if self._first is None:
                    self._first = counts
                elif counts != self._first:
                    self._mover.captured = counts
        if cycle % _ASK == 0:
            self._link.send([Frame(0x600 + node, bytes([0x40, *about[1:], 0, 0, 0, 0]))])
