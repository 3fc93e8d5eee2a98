"""The project's fault table as scenarios: what is broken, who must react, until when, and how it must end.

Every check raises AssertionError where the requirement is missed; `test_fault_table` runs all of them, and
`test_guards_are_needed` shows that each one fails without the guards that it names.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from softneck.drives.bus._objects import Write
from softneck.drives.master import Frame, MasterSettings, Phase
from softneck.drives.master._fieldbus import BUS_OFF

from .bench import DISABLED, FAULT, REACTION, Bench, T

# A cycle's rounding in comparisons of times.
EPS = 1e-6
SAFE = (DISABLED, FAULT)


@dataclass(frozen=True)
class Scenario:
    """One row, or one way into it.

    Attributes:
        row: of the fault table.
        play: breaks things and asserts the reaction.
        guards: of the host, without which (all of them off) it must fail.
        drive_guard: objects that switch the drive's own guard off, the same.
        others_off: guards that would react as well, off in any case.
        change: of the master's settings.
    """

    row: str
    play: Callable[[Bench], None]
    guards: frozenset[str] = frozenset()
    drive_guard: tuple[Write, ...] = ()
    others_off: frozenset[str] = frozenset()
    change: Callable[[MasterSettings], MasterSettings] | None = None


def stops(bench: Bench, fault: str, begin: float, deadline: float) -> None:
    """The host stops for `fault` within `deadline` [s]; all drives end without power; nothing restarts."""
    bench.finish(3.0)
    assert bench.stopped_at is not None, "the host did not react"
    assert bench.stopped_at - begin <= deadline + EPS, f"{bench.stopped_at - begin:.3f} s"
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name == fault
    latched(bench)


def latched(bench: Bench) -> None:
    """The run is over for good: stopped, no drive has power, and none gets it again while time passes."""
    assert bench.phase is Phase.STOPPED
    # A drive that hears no set-points any more loses its sign of life and faults by itself.
    bench.pass_time(0.15)
    assert all(state in SAFE for state in bench.states), bench.states
    bench.master.start()
    bench.pass_time(0.5)
    assert bench.phase is Phase.STOPPED
    assert not bench.restarted
    assert all(state in SAFE for state in bench.states), bench.states
    # The log is kept.
    fault = bench.master.supervisor.fault
    assert fault is not None
    assert fault.name in {event.name for event in bench.master.events}


def drives_fault(bench: Bench, begin: float, deadline: float = 0.11) -> None:
    """Every drive reacts by itself within `deadline` [s] and latches Fault."""
    for moment in bench.drive_stopped_at:
        assert moment is not None, "a drive ran on"
        assert moment - begin <= deadline + EPS, f"{moment - begin:.3f} s"
    assert all(state in (FAULT, REACTION) for state in bench.states), bench.states


# -- lost set-points ------------------------------------------------------------------------------------------------


def lost_setpoints(bench: Bench) -> None:
    before = bench.master.setpoints
    bench.pilot.act = lambda _: None
    begin = bench.now
    bench.pass_time(2 * T)
    # Held within two cycles: the last set-points stay.
    assert bench.master.setpoints == before
    assert bench.master.counts["setpoint_missing"] >= 1
    # The sample without a set-point is the first of five cycles.
    stops(bench, "setpoint_lost", begin, 5 * T)


# -- bus-off, cable ---------------------------------------------------------------------------------------------------


def bus_off(bench: Bench) -> None:
    bench.link._inbox.append(BUS_OFF)
    bench.link.cut = True
    begin = bench.now
    bench.pass_time(0.2)
    drives_fault(bench, begin)
    stops(bench, "bus_off", begin, T)


def cable(bench: Bench) -> None:
    bench.link.drain()
    bench.link.cut = True
    begin = bench.now
    bench.pass_time(0.2)
    drives_fault(bench, begin)
    stops(bench, "bus_silent", begin, 3 * T)
    bench.link.cut = False
    bench.pass_time(1.0)
    assert all(state == FAULT for state in bench.states)


# -- drive EMCY or Fault ----------------------------------------------------------------------------------------------


def drive_trips(bench: Bench) -> None:
    bench.neck.drives[1].axis.trip(0x2310)
    begin = bench.now
    bench.pass_time(0.1)
    # All three, not the one alone.
    assert all(moment is not None and moment - begin <= 2 * T + EPS for moment in bench.drive_stopped_at)
    stops(bench, "emergency", begin, 2 * T)
    assert bench.master.bus.drives[1].emergencies[-1][1] == 0x2310


def emergency_alone(bench: Bench) -> None:
    bench.neck.drives[2].axis.emergencies.append((0x4280, 0x08))
    stops(bench, "emergency", bench.now, 2 * T)


def fault_without_emergency(bench: Bench) -> None:
    bench.link.lose = lambda from_master, frame: not from_master and 0x80 < frame.identifier < 0x100
    bench.neck.drives[0].axis.trip(0x7500)
    stops(bench, "drive_fault", bench.now, 2 * T)


def drive_leaves(bench: Bench) -> None:
    bench.neck.drives[0].axis._enter(DISABLED)
    stops(bench, "drive_left", bench.now, 2 * T)


def enable_input_opens(bench: Bench) -> None:
    bench.neck.drives[2].axis.enable_input = False
    begin = bench.now
    stops(bench, "emergency", begin, 2 * T)
    assert bench.master.bus.drives[2].emergencies[-1][1] == 0x5441


# -- TPDO or heartbeat missing ----------------------------------------------------------------------------------------


def tpdo_missing(bench: Bench) -> None:
    bench.link.drain()
    bench.link.lose = lambda _, frame: frame.identifier == 0x182
    # The one of the cycle before was drained too: it counts as the first of the five.
    stops(bench, "tpdo_missing", bench.now, 5 * T)


def guard_answer_missing(bench: Bench) -> None:
    bench.link.lose = lambda from_master, frame: not from_master and frame.identifier == 0x702
    stops(bench, "heartbeat_missing", bench.now, 0.3)


def node_leaves(bench: Bench) -> None:
    bench.neck.drives[1]._command(bench.now, 0x80)
    stops(bench, "node_left", bench.now, 0.3)


# -- inclinometer -----------------------------------------------------------------------------------------------------


def _retreats(bench: Bench, fault: str, begin: float, deadline: float) -> None:
    bench.finish(8.0)
    assert bench.stopped_at is not None, "the host did not react"
    assert bench.stopped_at - begin <= deadline + EPS, f"{bench.stopped_at - begin:.3f} s"
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.name == fault
    # Back to rest under control, then off; latched all the same.
    assert bench.phase is Phase.DONE
    assert all(abs(value) < 0.2 for value in bench.master.positions)
    bench.master.start()
    bench.pass_time(0.3)
    assert not bench.restarted
    assert all(state == DISABLED for state in bench.states)


def sensor_drops(bench: Bench) -> None:
    bench.neck.sensor = "drops"
    _retreats(bench, "sensor_lost", bench.now, 0.1)


def sensor_freezes(bench: Bench) -> None:
    bench.neck.sensor = "freezes"
    # The sample that it repeats was the first of 20 identical ones, at 20 ms each; then 100 ms.
    _retreats(bench, "sensor_frozen", bench.now + 19 * 0.02, 0.1)


def short_dropout(bench: Bench) -> None:
    bench.neck.sensor = "drops"
    bench.pass_time(0.04)
    bench.neck.sensor = "works"
    bench.pass_time(0.5)
    assert bench.phase is Phase.RUNNING


def sensor_nan(bench: Bench) -> None:
    _three_bad(bench, "nan")


def sensor_jumps(bench: Bench) -> None:
    _three_bad(bench, "jumps")


def _three_bad(bench: Bench, kind: str) -> None:
    if not bench.master.sample_due:
        bench.step()
    bench.neck.sensor = kind
    bench.pass_time(2 * T)
    bench.neck.sensor = "works"
    bench.pass_time(0.2)
    # One alone: discarded in its cycle and nothing else.
    assert bench.phase is Phase.RUNNING
    assert bench.master.counts["sample_discarded"] == 1
    assert bench.master.tilt is not None
    assert math.isfinite(bench.master.tilt.values[0])
    assert abs(bench.master.tilt.values[0]) < 0.5
    if not bench.master.sample_due:
        bench.step()
    bench.neck.sensor = kind
    stops(bench, "sensor_bad", bench.now + 4 * T, T)


# -- controller -------------------------------------------------------------------------------------------------------


def controller_raises(bench: Bench) -> None:
    def fail(_: object) -> None:
        raise RuntimeError("singular matrix")

    if not bench.master.sample_due:
        bench.step()
    bench.pilot.act = fail
    stops(bench, "controller_failed", bench.now, 0.0)
    assert "singular matrix" in str(bench.master.supervisor.fault)


def controller_not_finite(bench: Bench) -> None:
    if not bench.master.sample_due:
        bench.step()
    bench.pilot.wanted = (0.0, math.nan, 0.0)
    stops(bench, "controller_failed", bench.now, 0.0)


# -- host process -----------------------------------------------------------------------------------------------------


def host_gone(bench: Bench) -> None:
    """Kill -9: the drives alone."""
    bench.host_stopped(True)
    begin = bench.now
    bench.pass_time(0.5)
    drives_fault(bench, begin)


def host_hangs_and_resumes(bench: Bench) -> None:
    """SIGSTOP, then SIGCONT: what resumes finds a stalled clock and must not enable again."""
    bench.host_stopped(True)
    begin = bench.now
    bench.pass_time(0.5)
    drives_fault(bench, begin)
    bench.host_stopped(False)
    resumed = bench.now
    stops(bench, "stalled", resumed, 0.0)
    assert all(state == FAULT for state in bench.states)


def host_stalls_shortly(bench: Bench) -> None:
    """Shorter than the drives' own guarding: the host alone."""
    bench.host_stopped(True)
    bench.pass_time(0.06)
    bench.host_stopped(False)
    stops(bench, "stalled", bench.now, 0.0)


# -- second master ----------------------------------------------------------------------------------------------------


def second_master_sync(bench: Bench) -> None:
    bench.link.inject.append(Frame(0x080, b""))
    # It is on the wire in this cycle and read in the next.
    stops(bench, "second_master", bench.now + T, T)


def second_master_setpoints(bench: Bench) -> None:
    bench.link.inject.append(Frame(0x202, b"\x0f\x00\x00\x00\x00\x00"))
    stops(bench, "second_master", bench.now + T, T)


def second_master_guards(bench: Bench) -> None:
    bench.link.inject.append(Frame(0x703, b"", remote=True))
    stops(bench, "second_master", bench.now + T, T)


def positions_twice(bench: Bench) -> None:
    """A second device answers each SYNC with the position of node 2, as that drive itself does."""

    def answer() -> None:
        view = bench.master.bus.drives[1]
        bench.link.inject.append(Frame(0x180 + view.node, struct.pack("<Hih", view.word, view.counts, view.current)))
        if bench.phase is Phase.RUNNING:
            bench.at(bench.now + T, lambda _: answer())

    answer()
    # The first one is on the wire in this cycle and read in the next.
    begin = bench.now + T
    bench.pass_time(0.45)
    assert bench.phase is Phase.RUNNING
    assert bench.master.counts["tpdo_twice"] >= 40
    stops(bench, "node_twice", begin, 0.5)
    assert bench.master.supervisor.fault is not None
    assert bench.master.supervisor.fault.node == 2


# -- limits -----------------------------------------------------------------------------------------------------------


def over_limit(bench: Bench) -> None:
    bench.pilot.wanted = (1.5, -0.25, -0.25)
    begin = bench.now
    bench.pass_time(0.04)
    assert bench.master.counts["clamped"] >= 1
    stops(bench, "clamp_persistent", begin, 1.0)
    assert bench.widest <= 1.0 + 1e-3


def too_fast(bench: Bench) -> None:
    """A set-point that jumps to and fro: each move is slowed to what the limits allow, and at last it stops."""
    side = [1.0]

    def jump(_: object) -> tuple[float, float, float]:
        side[0] = -side[0]
        return 3.0 * side[0], 0.0, 0.0

    bench.pilot.act = jump
    begin, before = bench.now, bench.master.setpoints[0]
    moves = []
    for _ in range(30):
        bench.step()
        moves.append(abs(bench.master.setpoints[0] - before))
        before = bench.master.setpoints[0]
    assert max(moves) <= 15.6 * T + 1e-9
    stops(bench, "clamp_persistent", begin, 1.0)


# -- model and measurement --------------------------------------------------------------------------------------------


def motor_blocked(bench: Bench) -> None:
    bench.neck.block(1)
    bench.pilot.wanted = (3.0, -0.25, -0.25)
    at = bench.master.positions[0]
    while bench.master.setpoints[0] - at <= bench.master.settings.watch.following and bench.now < 20.0:
        bench.step()
    stops(bench, "following", bench.now, 0.2)


def tilt_diverges(bench: Bench) -> None:
    start = bench.neck.truth()["pitch_measured"]
    tolerance = bench.master.settings.watch.tilt
    beyond = math.inf
    for k in range(40):
        bench.neck.set(base_tilt_pitch=min(0.5, 0.03 * k))
        bench.pass_time(2 * T)
        if bench.master.finished or bench.stopped_at is not None:
            break
        if math.isinf(beyond) and abs(bench.neck.truth()["pitch_measured"] - start) > tolerance:
            beyond = bench.now
    # The neck bends a little under the lean as well: the watch may see it a sample or two before.
    stops(bench, "diverged", beyond - 2 * T, 0.2)


def tendon_pulled(bench: Bench) -> None:
    bench.pilot.wanted = (2.0, 2.0, 2.0)
    bench.finish(3.0)
    assert bench.master.supervisor.fault is not None
    # Near the limit it may not pull further; that alone, if it lasts, stops; beyond it the watch does.
    assert bench.master.supervisor.fault.name in ("tension", "clamp_persistent")
    assert bench.stopped_at is not None
    latched(bench)
    assert max(bench.neck.truth()[f"tension_{j}"] for j in (1, 2, 3)) < 8.0


# -- boot-up ----------------------------------------------------------------------------------------------------------


def drive_boots(bench: Bench) -> None:
    bench.neck.drives[1].power_cycle(bench.now)
    stops(bench, "boot_up", bench.now, 2 * T)
    assert bench.master.supervisor.rehome
    assert bench.neck.drives[1].axis.values[(0x607C, 0)] == 0
