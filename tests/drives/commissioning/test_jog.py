"""Jogging tells a motor that pulls where it should from one that is wired otherwise."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import DrivesFile, default_drives, jog, neck_drives, record_signal, simulated_neck
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._jog import JogResult, judge
from softneck.drives.commissioning._record import drive_limits
from softneck.drives.running._bus_loop import Session
from softneck.drives.running._timing import Ask
from softneck.plant import NeckParameters
from softneck.signals import prepare, signal

from ..bench import tear

PSI = (0.0, 2.0 * math.pi / 3.0, 4.0 * math.pi / 3.0)
PAPER = NeckParameters.paper()
# What the virtual neck tilts for one radian is a few percent off the watch's gain (Eq. 31 is a fit), and noise and
# hysteresis turn the direction by some degrees.
TILT, DIRECTION = 0.15, 5.0


def link_to(wired: DrivesFile, neck: NeckParameters = PAPER) -> VirtualLink:
    return VirtualLink(simulated_neck(wired, neck, sample_time=0.02, homed=True))


def jogged(
    motor: int, *, wired: DrivesFile | None = None, file: DrivesFile | None = None, neck: NeckParameters = PAPER
) -> JogResult:
    file = file or default_drives()
    return jog(motor, Session(file=file, link=link_to(wired or file, neck)), tendon_angles=PSI)


def reversed_first() -> DrivesFile:
    one, two, three = default_drives().drives
    return default_drives(drives=(replace(one, scale=replace(one.scale, reversed=True)), two, three))


@pytest.mark.parametrize("motor", [1, 2, 3])
def test_a_motor_that_is_wired_right_pulls_towards_its_tendon(motor: int) -> None:
    found = jogged(motor)
    assert found.holds
    found.require()
    seen, expected = found.table()["seen"], found.table()["expected"]
    assert seen["tilt_deg"] == pytest.approx(expected["tilt_deg"], rel=TILT)
    assert abs((seen["direction_deg"] - expected["direction_deg"] + 180.0) % 360.0 - 180.0) < DIRECTION
    # The encoder's word for both ways: 2 x 0.5 rad, off by the following error at stand.
    assert found.turned == pytest.approx(1.0, abs=0.02)
    assert all(abs(value) < 0.6 for value in found.ended.master.setpoints)


def test_swapped_nodes_are_named() -> None:
    one, two, three = default_drives().drives
    wired = default_drives(drives=(replace(one, node=2), replace(two, node=1), three))
    found = jogged(1, wired=wired)
    assert found.verdict == "other motor?"
    with pytest.raises(
        CheckFailedError, match=r"motor 1 \(node 1\): other motor\?.*as motor 2 would: it tilts towards"
    ):
        found.require()
    assert jogged(3, wired=wired).holds


def test_a_reversed_motor_is_seen_by_the_inclinometer() -> None:
    """Limits that let it out as far as it likes, so that it reaches its rest, and friction that hides its sign."""
    file = default_drives()
    limits, watch = replace(file.limits, slack_unwind=10.0), replace(file.watch, pushed=50.0)
    found = jogged(1, wired=reversed_first(), file=default_drives(limits=limits, watch=watch))
    assert found.verdict == "wrong sign"
    assert found.table()["seen"]["direction_deg"] == pytest.approx(180.0, abs=DIRECTION)


def test_a_reversed_motor_is_seen_by_its_current() -> None:
    found = jogged(1, wired=reversed_first())
    assert found.verdict == "wrong sign"
    with pytest.raises(CheckFailedError, match=r"motor 1, about -\d\.\d N: its current .* pushes\. Change `reversed`"):
        found.require()
    # On the way in, before its tendon is tight: not after the 30 s that a ramp may take.
    fault = found.ended.master.supervisor.fault
    assert fault is not None
    assert fault.time < 8.0
    other = jogged(2, wired=reversed_first())
    assert other.advice == "The current of motor 1 says that its tendon pushes: jog that one first."
    with pytest.raises(
        CheckFailedError, match=r"pushes its tendon.*\(node 1\).*See `softneck drives commission --only jog --motor 1`"
    ):
        other.require()


@pytest.mark.parametrize("preset", ["paper", "lab"])
@pytest.mark.parametrize("motor", [1, 2, 3])
def test_record_and_run_name_a_reversed_motor_on_the_way_in(motor: int, preset: str) -> None:
    neck = NeckParameters.preset(preset)
    file = neck_drives(neck)
    drives = list(file.drives)
    drives[motor - 1] = replace(drives[motor - 1], scale=replace(drives[motor - 1].scale, reversed=True))
    wired = replace(file, drives=(drives[0], drives[1], drives[2]))
    played = prepare(signal("sine"), drive_limits(file), ramp_s=2.0)[0]
    done = record_signal([played], Session(file=file, link=link_to(wired, neck)))
    fault = done.ended.master.supervisor.fault
    assert fault is not None
    assert (fault.name, fault.node, done.rows) == ("pushed", motor, 0)
    # The ramp in takes 1 to 6 s, at the end of which a tendon is tight; its time-out was 30 s.
    assert fault.time < 8.0
    with pytest.raises(
        CheckFailedError,
        match=rf"is `reversed` of its drive right\? See `softneck drives commission --only jog --motor {motor}`",
    ):
        done.require()


def test_a_slack_tendon_does_not_move_the_neck() -> None:
    file = default_drives()
    link = link_to(file)
    tear(link.neck, 1)
    found = jog(1, Session(file=file, link=link), tendon_angles=PSI)
    assert found.verdict == "no movement"
    with pytest.raises(CheckFailedError, match=r"no movement. Is its tendon attached and tight"):
        found.require()


@pytest.mark.slow
def test_noise_of_the_lab_does_not_matter() -> None:
    """0.3 deg is the noise of the lab's worse inclinometer; at 1 deg the way is still seen."""
    for noise in (0.3, 1.0):
        assert jogged(1, neck=PAPER.replace(noise_std=math.radians(noise))).holds


@pytest.mark.parametrize(
    ("seen", "noise", "verdict"),
    [
        (0.05, 0.0, "ok"),
        (0.05 * complex(math.cos(0.5), math.sin(0.5)), 0.001, "ok"),
        (-0.05, 0.0, "wrong sign"),
        (0.05 * complex(math.cos(PSI[2]), math.sin(PSI[2])), 0.0, "other motor?"),
        (-0.05 * complex(math.cos(PSI[1]), math.sin(PSI[1])), 0.0, "other motor?"),
        (0.01, 0.0, "no movement"),
        (0.05, 0.03, "unclear"),
        (0.0, 0.03, "unclear"),
        (math.nan, 0.0, "unclear"),
    ],
)
def test_the_nearest_of_six_ways(seen: complex, noise: float, verdict: str) -> None:
    z = complex(seen)
    assert judge((z.real, z.imag), noise, (0.05, 0.0), [(math.cos(a), math.sin(a)) for a in PSI], 1)[0] == verdict


def test_an_operator_stops_it() -> None:
    file = default_drives()
    link = link_to(file)
    found = jog(1, Session(file=file, link=link, operator=lambda: Ask.STOP if link.now > 8.0 else None),
                tendon_angles=PSI)  # fmt: skip
    assert found.verdict == "stopped"
    assert found.ended.left
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
    with pytest.raises(CheckFailedError, match=r"by the operator\. The drives are off"):
        found.require()


@pytest.mark.parametrize(
    ("motor", "amplitude", "message"),
    [(4, 0.5, "`motor` must be a whole number between 1 and 3"), (1, 0.0, "--travel.*between 0.1 and 1.5"),
     (1, math.nan, "--travel"), (1, 1.2, "beyond the 1 rad of the drives file")],
)  # fmt: skip
def test_bad_input(motor: int, amplitude: float, message: str) -> None:
    file = default_drives(limits=replace(default_drives().limits, position=1.0))
    link = link_to(file)
    sent = []
    link.tap = lambda *frame: sent.append(frame)
    with pytest.raises(SettingsError, match=message):
        jog(motor, Session(file=file, link=link), tendon_angles=PSI, amplitude=amplitude)
    assert sent == []
