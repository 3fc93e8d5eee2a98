"""Whole runs on simulated drives: equal to the co-simulation, and over a real python-can bus."""

from __future__ import annotations

import math
import threading
import time
import tracemalloc
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest

from softneck.core import CheckFailedError, SettingsError, load
from softneck.cosim import load_loop, simulate
from softneck.drives import (
    CanInclinometer,
    CanLink,
    default_drives,
    preflight,
    prepare,
    run_on_bus,
    run_simulated,
    simulated_neck,
    zero,
)
from softneck.drives.bus._file import DriveEntry
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._units import DriveScale
from softneck.drives.commissioning import _zero
from softneck.drives.master import Tilt
from softneck.drives.master._master import Measurement
from softneck.drives.master._settings import RampSettings
from softneck.drives.running._pilot import LoopPilot
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings, serve
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.drives.simulated._servo_runtime import (
    SERVO_DEMAND,
    SERVO_POSITION,
    SERVO_SCALE,
    SERVO_TARGET,
    SERVO_ZERO,
)
from softneck.fmu import build_fmu
from softneck.plant import NeckParameters

from ..data import slow_but
from .bench import Bench, tear
from .conftest import STEP, Project

ROTATION = 'kind = "rotation"\ninclination_deg = 12.0\nfrequency_hz = 0.2'


@pytest.mark.parametrize("profile", ["ipos2015", "ds402"])
@pytest.mark.parametrize(
    ("name", "reference", "bound_deg"),
    [
        # A smooth motion agrees to 0.02 deg: servo loops sampled at 1 ms, encoders, the ramp between set-points.
        pytest.param("rotation", ROTATION, 0.02, id="rotation"),
        # While the drives run at their limits the controller's lead limit sees positions that are one bus cycle old:
        # 10 ms at the slew limit of 12.5 rad/s are 0.125 rad of each motor, 0.25 rad of theta_i, at 5.2 deg/rad.
        pytest.param("step", STEP, 1.3, id="step"),
    ],
)
def test_a_run_on_simulated_drives_equals_the_co_simulation(
    project: Project, profile: str, name: str, reference: str, bound_deg: float
) -> None:
    setup = load_loop(project.write_loop(f"{name}.toml", reference, 5.0))
    expected = simulate(setup)
    result = run_simulated(prepare(setup, project.controller), default_drives(profile))
    assert result.completed
    assert len(result.signals.time) == len(expected["pitch"])
    for axis in ("pitch", "roll"):
        gap = np.degrees(np.abs(result.signals[axis] - expected[axis]))
        assert gap.max() < bound_deg
        # The end of the run agrees whatever happened before: drives and neck have come to rest or to their circle.
        assert gap[-50:].max() < 0.1


def test_a_controller_s_fmu_answers_drives_as_its_file_does(project: Project, tmp_path: Path) -> None:
    fmu = build_fmu(load(project.controller, role="controller").block(), tmp_path / "Pi.fmu")
    pilots = [LoopPilot(prepare(load_loop(project.loop), path).loop) for path in (project.controller, fmu)]
    for pilot in pilots:
        pilot.start()
    answers = [
        [pilot.step(Measurement(k, Tilt(0.0, 0.0), True, (0.1, 0.0, -0.1))) for k in range(100)] for pilot in pilots
    ]
    for pilot in pilots:
        pilot.close()
    first, second = (np.array(answer, dtype=float) for answer in answers)
    # Compiled and plain Python; from 1 s on the step wants more than these motors, which do not move, let it lead.
    np.testing.assert_allclose(second, first, rtol=0, atol=1e-12)
    assert first[-1, 0] > 0.2


@pytest.mark.slow
def test_the_same_run_twice_is_the_same_to_the_bit(project: Project) -> None:
    setup = load_loop(project.loop)
    first, second = (run_simulated(prepare(setup, project.controller), default_drives()) for _ in range(2))
    for name, values in first.signals.signals.items():
        np.testing.assert_array_equal(values, second.signals[name])


@pytest.mark.slow
def test_reversed_drives_other_nodes_and_200_hz_give_the_same_motion(project: Project) -> None:
    scale = DriveScale(peak_current=20.0, slow_loop=0.8e-3, reversed=True)
    one, two, three = (DriveEntry(node=node, scale=scale) for node in (5, 77, 12))
    other = default_drives(drives=(one, two, three), cycle=0.005)
    setup = load_loop(project.loop)
    plain = run_simulated(prepare(setup, project.controller), default_drives())
    result = run_simulated(prepare(setup, project.controller), other)
    assert result.completed
    # Positions come 5 ms earlier here, and a current of 49 units instead of 98 is 0.1 % less.
    assert np.degrees(np.abs(result.signals["pitch"] - plain.signals["pitch"])).max() < 0.6


def test_a_bus_period_must_divide_the_sample_time(project: Project) -> None:
    with pytest.raises(SettingsError, match=r"bus period 0\.015 s must divide"):
        run_simulated(prepare(load_loop(project.loop)), default_drives(cycle=0.015))


def test_a_fault_ends_the_run_and_its_log_is_kept(project: Project) -> None:
    def breaks(link: VirtualLink) -> None:
        # Pre-flight and enabling take 1.2 s, the ramp back from where the tendons unwound to 5.7 s.
        if link.now > 8.5:
            link.neck.sensor = "freezes"

    result = run_simulated(prepare(load_loop(project.loop)), default_drives(), hook=breaks)
    assert result.fault is not None
    assert result.fault.name == "sensor_frozen"
    assert len(result.signals.time) > 20
    with pytest.raises(CheckFailedError, match=r"the inclinometer is frozen.*softneck drives reset"):
        result.require()


# -- zero -------------------------------------------------------------------------------------------------------------


def virtual(*, homed: bool = False) -> VirtualLink:
    return VirtualLink(simulated_neck(default_drives(), NeckParameters.paper(), sample_time=0.02, homed=homed))


@pytest.mark.slow
@pytest.mark.parametrize("profile", ["ipos2015", "ds402"])
def test_zero_tensions_every_tendon_and_marks_the_drives(profile: str) -> None:
    file = default_drives(profile)
    link = VirtualLink(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, homed=False))
    report = preflight(link, file)
    tensions = []
    zeroed = zero(
        link, file, lambda: (tensions.append([link.neck.motion[i][26] for i in range(3)]), link.newest)[1],
        guarding=report.guarding,
    )  # fmt: skip
    assert all(pulled > 0.5 for pulled in zeroed.pulled)
    # At the end all three motors pull with the current of [zero], in steps of 0.3 mA.
    assert tensions[0] == pytest.approx([0.0151] * 3, abs=3e-4)
    assert all(drive.axis.homed and drive.axis.state == 0x40 for drive in link.neck.drives)
    link.receive(0.5)
    # Nobody guards any more, and nobody faults for it.
    assert all(drive.axis.fault == 0 for drive in link.neck.drives)
    assert preflight(link, file, homed=True).holds


@pytest.mark.slow
def test_a_torn_tendon_is_found_while_zeroing() -> None:
    file, link = default_drives(), virtual()
    tear(link.neck, 2)
    report = preflight(link, file)
    with pytest.raises(CheckFailedError, match=r"node 2: the tendon of this motor did not get tight within 10 s"):
        zero(link, file, lambda: link.newest, guarding=report.guarding)
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)


@pytest.mark.slow
def test_a_neck_that_leans_is_not_zeroed() -> None:
    file, link = default_drives(), virtual()
    link.neck.set(base_tilt_pitch=0.3)
    report = preflight(link, file)
    with pytest.raises(CheckFailedError, match=r"the robot leans by pitch .* No zero was set"):
        zero(link, file, lambda: link.newest, guarding=report.guarding)
    assert not any(drive.axis.homed for drive in link.neck.drives)


ENDS_OF_HOMING = (
    "nothing", "turns on", "turned on by 0.01 rad", "went back by 0.01 rad", "not there", "not attained",
    "tells an error",
)  # fmt: skip


@pytest.mark.parametrize(
    ("what", "latency"),
    [*((what, latency) for what in ENDS_OF_HOMING for latency in (0.0, 0.05)), ("nothing", 0.03), ("nothing", 0.1)],
)
def test_no_zero_is_taken_for_one_where_homing_did_not_end(what: str, latency: float) -> None:
    """A winch that turns on, a zero that was set later or not at all; whatever the time of an answer."""
    file = default_drives()
    settings = SimulatedSettings(homed=False, quirks=DriveQuirks(sdo_latency=latency))
    link = VirtualLink(SimulatedNeck(NeckParameters.paper(), settings))
    report, axis = preflight(link, file), link.neck.drives[2].axis
    begin, status = axis._mode_bits, axis.getters[(0x6041, 0)]

    def homed(word: int, before: int) -> None:
        at = axis.motion[SERVO_POSITION]
        begin(word, before)
        if axis.values[(0x6060, 0)] != 6 or not word & 0x10:
            return
        sign = math.copysign(1.0, axis.motion[SERVO_SCALE])
        turned = {"turned on by 0.01 rad": 0.01, "went back by 0.01 rad": -0.01}.get(what, 0.0)
        late = sign * turned * abs(axis.motion[SERVO_SCALE]) if what != "not there" else at
        for column in (SERVO_ZERO, SERVO_POSITION, SERVO_DEMAND, SERVO_TARGET):
            axis.motion[column] += late
        if what == "turns on":  # the tendon slips off, and the motor runs where it was asked to pull
            tear(link.neck, 3)

    axis._mode_bits = homed
    wrong = {"not attained": lambda word: word & ~0x1000, "tells an error": lambda word: word | 0x2000}.get(what)
    if wrong:
        axis.getters[(0x6041, 0)] = lambda: wrong(status()) if axis.values[(0x6060, 0)] == 6 else status()
    if what == "nothing":
        zero(link, file, lambda: link.newest, guarding=report.guarding)
        assert preflight(link, file, homed=True).holds
        # Whoever kills the next zeroing before it homes leaves no marks of two different zeros.
        marks = []
        zero(
            link, file, lambda: (marks.extend(d.axis.values[(0x607C, 0)] for d in link.neck.drives), link.newest)[1],
            guarding=report.guarding,
        )  # fmt: skip
        assert marks == [0, 0, 0]
        return
    with pytest.raises(CheckFailedError, match="node 3: homing did not end"):
        zero(link, file, lambda: link.newest, guarding=report.guarding)
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
    # Nor does a mark stay that would let a run start from it.
    with pytest.raises(CheckFailedError, match=r"node 1: homed: no\. Run `softneck drives commission --only zero`"):
        preflight(link, file, homed=True).require()


@pytest.mark.parametrize(("creep", "zeroed"), [(0.15, True), (0.25, False), (-0.25, False)])
def test_a_winch_that_creeps_faster_than_still_is_not_zeroed(creep: float, zeroed: bool) -> None:
    """The zero itself fits at any of these: what refuses it is that the winch turns (`still`: 0.2 rad/s)."""
    file, link = default_drives(), virtual()
    report, axis = preflight(link, file), link.neck.drives[1].axis
    position, per_radian = axis.getters[(0x6064, 0)], file.drives[1].scale.counts_per_radian
    begun: list[float] = []

    def crept() -> int:
        if axis.values[(0x6060, 0)] == 6 and not begun:
            begun.append(link.now)
        return position() + round(creep * per_radian * (link.now - begun[0] if begun else 0.0))

    axis.getters[(0x6064, 0)] = crept
    if zeroed:
        zero(link, file, lambda: link.newest, guarding=report.guarding)
        return
    with pytest.raises(CheckFailedError, match=r"node 2: homing did not end .* -?0\.2\d+ rad/s"):
        zero(link, file, lambda: link.newest, guarding=report.guarding)


def test_a_winch_that_pulls_slowly_is_not_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pulled at less than twice what counts as still, a tendon is not tight before it is."""
    monkeypatch.setattr(_zero, "_TIME", 60.0)
    pulled = []
    for speed in (0.35, 2.0):
        file, link = default_drives(), virtual()
        file = replace(file, zero=replace(file.zero, speed=speed))
        report = preflight(link, file)
        pulled.append(zero(link, file, lambda link=link: link.newest, guarding=report.guarding).pulled)
    # A slower pull comes to rest with less swing: a tenth of a radian is a hundredth of a millimetre of stretch.
    assert pulled[0] == pytest.approx(pulled[1], abs=0.1)


def test_another_slow_loop_is_found_while_zeroing() -> None:
    file = default_drives()
    link = virtual()
    for drive in link.neck.drives:
        drive.axis.slow_loop = 0.5e-3
    report = preflight(link, file)
    with pytest.raises(CheckFailedError, match=r"node 1: its speed \(606Ch\) is 0\.\d+ times that of its position"):
        zero(link, file, lambda: link.newest, guarding=report.guarding)


def test_a_run_without_zero_is_refused() -> None:
    file, link = default_drives(), virtual()
    with pytest.raises(CheckFailedError, match=r"node 1: homed: no\. Run `softneck drives commission --only zero`"):
        preflight(link, file, homed=True).require()


# -- in real time -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_run_over_a_bus_of_python_can(project: Project) -> None:
    """The same loop in real time over python-can's virtual bus; bounds are wide, for machines are shared."""
    setup = load_loop(project.write_loop("short.toml", STEP.replace("at_s = 1.0", "at_s = 0.2"), 1.2))
    file = replace(
        default_drives(), ramps=RampSettings(speed=3.0, settle=0.1, tolerance=0.2), sensor_kind="can", sensor_node=10
    )
    ended = threading.Event()
    with can.Bus(interface="virtual", channel="softneck") as theirs, can.Bus("softneck", interface="virtual") as ours:
        neck = SimulatedNeck(NeckParameters.paper(), SimulatedSettings(homed=True))
        server = threading.Thread(target=serve, args=(theirs, neck), kwargs={"stopped": ended.is_set})
        server.start()
        try:
            link = CanLink(ours, "virtual:softneck")
            # The threads share one interpreter: a stall of 50 ms is this machine's, not the master's.
            begin = time.monotonic()
            watched: list[int] = []
            result = run_on_bus(
                prepare(setup, project.controller), file, link, CanInclinometer(10),
                watches=(lambda *seen: watched.append(seen[-1].cycle),),
            )  # fmt: skip
            assert watched == list(range(1, result.cycles + 1))
            took = time.monotonic() - begin
        finally:
            ended.set()
            server.join()
    if result.fault is not None:
        assert result.fault.name in (
            "stalled",
            "tpdo_missing",
            "bus_silent",
            "heartbeat_missing",
            "sensor_lost",
            "emergency",
        )
        pytest.skip(f"this machine stalled: {result.fault}")
    assert result.completed
    assert took > 1.2
    assert np.degrees(result.signals["pitch_measured"][-1]) > 5.0


def test_our_own_frames_that_a_bus_hands_back_are_dropped() -> None:
    from softneck.drives.master import Frame

    with can.Bus("echo", interface="virtual", receive_own_messages=True) as bus:
        link = CanLink(bus, "virtual:echo", echoes=True)
        link.send([Frame(0x080, b""), Frame(0x201, b"\x06\0"), Frame(0x701, b"\0", remote=True)])
        assert link.receive(0.05) == []
        bus.send(can.Message(arbitration_id=0x181, data=b"\1", is_extended_id=False))
        assert link.receive(0.05) == [Frame(0x181, b"\1")]


# -- long runs --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("minutes", slow_but((5, 30), (), nightly=(30,)))
def test_minutes_without_a_missed_reaction_or_growth(minutes: int) -> None:
    """Simulated minutes; in every one a short dropout and a late cycle, at the end a fault in time."""
    bench = Bench().start()
    bench.pass_time(60.0)
    tracemalloc.start()
    bench.pass_time(1.0)
    before = tracemalloc.take_snapshot()
    for _ in range(minutes - 1):
        bench.neck.sensor = "drops"
        bench.pass_time(0.04)
        bench.neck.sensor = "works"
        bench.pass_time(59.96)
    after = tracemalloc.take_snapshot()
    tracemalloc.stop()
    grown = sum(item.size_diff for item in after.compare_to(before, "filename") if "softneck" in str(item.traceback))
    # Nothing but counters: less than 20 kB, where one float a cycle would be 0.7 MB in four minutes.
    assert grown < 20_000
    assert bench.master.supervisor.fault is None
    bench.neck.drives[0].axis.trip(0x2310)
    begin = bench.now
    bench.finish()
    assert bench.stopped_at is not None
    assert bench.stopped_at - begin <= 0.02 + 1e-6
