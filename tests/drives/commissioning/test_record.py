"""An experiment on simulated drives is the one on the virtual neck, and ends well whatever happens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import default_drives, neck_drives, preflight, record_signal, simulated_neck, zero
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._record import ExperimentResult, drive_limits
from softneck.drives.master import Master
from softneck.drives.running._bus_loop import Session
from softneck.drives.running._timing import Ask
from softneck.identification import Rls
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Excitation, prepare, signal

FILE = default_drives()
# Next to no noise: what is compared is drives, not draws; none at all would look frozen.
NECK = NeckParameters.paper().replace(noise_std=1e-6)
QUIET = {"paper": NECK, "lab": NeckParameters.lab().replace(noise_std=1e-6, drift_std=0.0, noise_quantum=0.0)}


def link_to(neck: NeckParameters = NECK) -> VirtualLink:
    return VirtualLink(simulated_neck(FILE, neck, sample_time=0.02, homed=True))


def excitation(name: str, duration: float | None = None, *, seed: int = 0) -> Excitation:
    return prepare(signal(name, duration=duration, seed=seed), drive_limits(FILE), ramp_s=2.0)[0]


def recorded(*excitations: Excitation, link: VirtualLink | None = None, **session: object) -> ExperimentResult:
    return record_signal(excitations, replace(Session(file=FILE, link=link or link_to()), **session))


SLOW = [("steps", None), ("rotation", None), ("aprbs", 20.0), ("sine", None), ("eq22", None), ("mixed", None)]


@pytest.mark.parametrize("neck", ["paper", "lab"])
@pytest.mark.parametrize(
    ("name", "duration"),
    [("eq22", 20.0), *(pytest.param(name, duration, marks=pytest.mark.slow) for name, duration in SLOW)],
)
def test_it_equals_softneck_record_over_the_same_neck(name: str, duration: float | None, neck: str) -> None:
    """With the drives set up for the neck, as `--simulated --neck` does."""
    parameters = QUIET[neck]
    file = neck_drives(parameters)
    played = prepare(signal(name, duration=duration), drive_limits(file), ramp_s=2.0)[0]
    link = VirtualLink(simulated_neck(file, parameters, sample_time=0.02, homed=True))
    done = record_signal([played], Session(file=file, link=link))
    assert done.completed, done.ended.master.supervisor.fault
    found, wanted = done.recording, record(played, VirtualNeck(parameters))
    assert found is not None
    np.testing.assert_allclose(found.set_points, wanted.set_points, rtol=0, atol=1e-12)
    gap = np.degrees(np.abs(found.outputs - wanted.outputs))
    # Servo loops at 1 ms, with whole ticks of latency, against the neck's own drive model: 0.03 rad of a motor while it
    # turns, at 5 (paper) and 8 (lab) deg/rad; 0.15 deg and 0.026 deg rms were found on the worst signal.
    assert gap.max() < 0.22
    assert np.sqrt(np.mean(gap**2)) < 0.04
    assert np.abs(found.motor_positions - wanted.motor_positions).max() < 0.045
    for j in (1, 2, 3):
        # Of up to 11 N; a tendon that gets tight does so some milliseconds later.
        assert np.abs(found.channels[f"tension_{j}"] - wanted.channels[f"tension_{j}"]).max() < 0.5


@pytest.mark.parametrize("name", ["sine", "aprbs"])
def test_speeds_are_those_of_the_motors(name: str) -> None:
    """Central differences over 20 ms, against twice as long ones of the virtual neck's own motors without counts."""
    played = excitation(name, 15.0)
    found, wanted = recorded(played).recording, record(played, VirtualNeck(NECK))
    assert found is not None
    speeds = np.column_stack([found.channels[f"motor_velocity_{j}"] for j in (1, 2, 3)])
    reference = np.gradient(wanted.motor_positions, 0.02, axis=0)
    assert np.isfinite(speeds).all()
    inner = slice(1, -1)
    difference = (speeds - reference)[inner]
    # One count over 20 ms is 0.0065 rad/s; the rest is where a motor's acceleration changes within 40 ms.
    assert np.sqrt(np.mean(difference**2)) < 0.02 * np.abs(reference).max()
    # What the speeds add up to is how far the motors went, to the trapezoid rule and a count per sample at random.
    way = np.cumsum(0.01 * (speeds[1:] + speeds[:-1]), axis=0)
    assert np.abs(way - (found.motor_positions - found.motor_positions[0])[1:]).max() < 0.03


def test_a_neck_of_ones_own_gets_drives_that_fit_it() -> None:
    assert neck_drives(NeckParameters.paper()) == default_drives()
    lab = neck_drives(NeckParameters.lab())
    parameters = NeckParameters.lab()
    assert all(drive.current_limit == parameters.current_limit for drive in lab.drives)
    assert lab.neck.winch_radius == parameters.winch_radius
    # A stop needs more tension than the motors have.
    pull = parameters.current_limit * parameters.torque_constant * parameters.gear_ratio * parameters.gear_efficiency
    assert lab.limits.tension > pull / parameters.winch_radius
    # It tilts further: a softer joint on a winch a third larger.
    assert lab.watch.gain > 1.3 * default_drives().watch.gain


def test_motors_that_do_not_follow_say_what_to_do() -> None:
    file, neck = default_drives(), QUIET["lab"]
    played = prepare(signal("eq22", duration=20.0), replace(drive_limits(file), speed=5.2), ramp_s=2.0)[0]
    # Drives that were set up for another neck: half of the current that this one needs.
    link = VirtualLink(simulated_neck(file, neck, sample_time=0.02, homed=True))
    with pytest.raises(CheckFailedError, match=r"does not follow its set-point \(node \d\).*lower speed_rad_s"):
        record_signal([played], Session(file=file, link=link)).require()


@pytest.mark.slow
def test_it_is_usable_by_identify_and_the_model_is_that_of_the_virtual_neck() -> None:
    played = excitation("eq22", 40.0)
    ours = recorded(played).recording
    assert ours is not None
    assert {"pitch_rate", "motor_position_1"} <= set(ours.channels)
    one, two = (Rls().fit([item]).tf("pitch", angle_unit="rad") for item in (ours, record(played, VirtualNeck(NECK))))
    # Angles agree to 0.06 deg rms of 10 deg rms: gains to about a percent.
    assert one.dcgain() == pytest.approx(two.dcgain(), rel=0.02)


def test_runs_are_numbered_and_never_joined() -> None:
    parts = [excitation("aprbs", 6.0, seed=seed) for seed in (1, 2)]
    result = recorded(*parts)
    assert result.completed
    assert result.recording is not None
    one, two = result.recording.runs()
    assert [int(one.run[0]), int(two.run[0])] == [1, 2]
    assert [len(one), len(two)] == [300, 300]
    np.testing.assert_allclose(two.set_points, parts[1].set_points, rtol=0, atol=1e-12)
    assert two.time[0] - one.time[-1] == pytest.approx(3.02)


@pytest.mark.slow
def test_a_fault_in_the_middle_keeps_what_was_recorded() -> None:
    link, played = link_to(), excitation("rotation")
    whole = recorded(played)

    def breaks(*_cycle: object) -> None:
        if link.now > 12.0:
            link.neck.drives[1].axis.trip(0x2310)

    result = recorded(played, link=link, watches=(breaks,))
    assert 100 < result.rows < result.planned
    assert result.recording is not None
    assert whole.recording is not None
    assert not result.completed
    n = result.rows
    np.testing.assert_array_equal(result.recording.set_points, whole.recording.set_points[:n])
    np.testing.assert_array_equal(result.recording.outputs, whole.recording.outputs[:n])
    with pytest.raises(CheckFailedError, match=r"stopped at t = 12\.\d+ s.*softneck drives reset"):
        result.require()
    assert all(drive.axis.state != 0x27 for drive in link.neck.drives)


@pytest.mark.slow
@pytest.mark.parametrize(("ask", "fault", "phase"), [(Ask.LEAVE, None, "done"), (Ask.STOP, "operator", "stopped")])
def test_an_operator_ends_it_with_the_drives_off(ask: Ask, fault: str | None, phase: str) -> None:
    link = link_to()
    last = {}

    def watch(_now: float, _in: object, _out: object, _tilt: object, master: Master) -> None:
        last[str(master.supervisor.phase)] = master.setpoints

    result = recorded(
        excitation("rotation"),
        link=link,
        watches=(watch,),
        operator=lambda: ask if 12.0 <= link.now < 12.015 else None,
    )
    supervisor = result.ended.master.supervisor
    assert (supervisor.fault.name if supervisor.fault else None, str(supervisor.phase)) == (fault, phase)
    assert result.ended.left
    assert 100 < result.rows < result.planned
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
    if ask is Ask.LEAVE:
        # At rest before they were switched off.
        assert all(abs(value) < 1e-6 for value in last["ramp out"])


@pytest.mark.parametrize("ask", list(Ask))
def test_asked_before_anything_moved_it_only_switches_off(ask: Ask) -> None:
    link = link_to()
    result = recorded(excitation("rotation"), link=link, operator=lambda: ask)
    assert result.rows == 0
    assert result.recording is None
    assert result.ended.master.supervisor.phase == "stopped"
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)


def test_what_the_drives_file_does_not_allow_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"position 20 is beyond the .* of \[limits\] in the drives file"):
        drive_limits(FILE, position=20.0)
    with pytest.raises(SettingsError, match=r"eq22 asks for .* rad/s.*ramp it in and out"):
        recorded(signal("eq22", duration=10.0))
    with pytest.raises(SettingsError, match="there is no signal"):
        recorded()


@pytest.mark.slow
def test_the_first_experiment_after_zeroing_ends_as_planned() -> None:
    """The tendons keep the tension of `zero`; the motors have what is left of their current."""
    link = VirtualLink(simulated_neck(FILE, NECK, sample_time=0.02, homed=False))

    zero(link, FILE, lambda: link.newest, guarding=preflight(link, FILE).guarding)
    recorded = record_signal([excitation("eq22", 40.0)], Session(file=FILE, link=link))
    recorded.require()
    assert recorded.rows == recorded.planned
