"""Drives files, simulated drives, sensors, experiments and loops of robots with 1 to 8 motors."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from softneck.core import CheckFailedError, SettingsError, SoftneckError, Vector
from softneck.core._certificate import Certificate
from softneck.cosim.loops._loop_file import LoopSetup, make_loop
from softneck.cosim.loops._simulate import run_setup
from softneck.design import design_controller
from softneck.drives import (
    Experiment,
    default_drives,
    jog,
    load_drives,
    preflight,
    prepare,
    read_run_log,
    record_signal,
    replay,
    run_simulated,
    zero,
)
from softneck.drives.bus._file import bus_load, frame_bits
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._objects import limit_writes
from softneck.drives.commissioning._record import drive_limits
from softneck.drives.logs._cycle import decode_cycle, encode_cycle
from softneck.drives.logs._run_log import RunLogger
from softneck.drives.master import Frame
from softneck.drives.running import _virtual
from softneck.drives.running._bus_loop import Session
from softneck.drives.running._certified import _require_robot
from softneck.drives.running._deploy import Deployment
from softneck.drives.running._pilot import LoopPilot
from softneck.drives.running._virtual import neck_drives, physics_of, simulated_plant, simulated_springs, stand_in
from softneck.drives.sensing._sources import CanInclinometer, PythonInclinometer
from softneck.drives.simulated import SimulatedNeck
from softneck.drives.simulated._springs import SimulatedSprings
from softneck.loop import Loop
from softneck.plant import NeckParameters
from softneck.robot import Robot
from softneck.runtime import Port
from softneck.signals import Recording, read_recording, write_recording
from tests.design.test_robots import plant

from .robots import robot

DRIVES = """profile = "ipos2015"
[watch]
gain = 0.08
pole_per_s = 4.0
"""
TS = 0.02


def drives_text(count: int, *, more: str = "", reversed: int = 0) -> str:
    """Return a drives file with nodes 11, 12, ...; motor `reversed`, from 1, turns the other way."""
    tables = [
        f"[[drive]]\nnode = {10 + j}\npeak_current_A = 10.0\nreversed = {'true' if j == reversed else 'false'}\n"
        for j in range(1, count + 1)
    ]
    return DRIVES + "".join(tables) + more


def link_to(file: Any, *, homed: bool = True) -> VirtualLink:
    return VirtualLink(simulated_plant(file, None, sample_time=TS, homed=homed))


# -- drives file ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 4, 8])
def test_a_drives_file_has_a_drive_for_each_motor(tmp_path: Path, count: int) -> None:
    path = tmp_path / "drives.toml"
    path.write_text(drives_text(count), encoding="utf-8")
    file = load_drives(path, robot(count))
    assert file.nodes == tuple(range(11, 11 + count))
    assert len(file.master_settings(TS).counts_per_radian) == count
    # The whole cyclic traffic at 200 Hz and 1 Mbit/s, with guarding every 20 ms.
    assert bus_load(count, cycle=0.005, guard_cycles=4, bit_rate=1_000_000) < 0.5
    path.write_text(drives_text(count + 1), encoding="utf-8")
    with pytest.raises(
        SettingsError, match=rf"for robot `robot of {count}` .*motors 1 to {count}.*there are {count + 1}"
    ):
        load_drives(path, robot(count))


def test_the_robot_beside_a_drives_file_is_its_robot(tmp_path: Path) -> None:
    (tmp_path / "robot.toml").write_text('name = "two"\nextends = "antagonist"\n', encoding="utf-8")
    (tmp_path / "drives.toml").write_text(drives_text(2), encoding="utf-8")
    assert load_drives(tmp_path / "drives.toml").moves.name == "two"


@pytest.mark.parametrize(
    ("tables", "more", "line"),
    [
        ({"motors": {"sign": [1.0, -1.0]}}, "", r"\[\[drive\]\] 2 has reversed = false.*motor 2 is -1"),
        ({"winch": {"radius_m": 0.01}}, "[neck]\nwinch_radius_m = 0.0075\n", r"winch_radius_m is 0.0075.*has 0.01 m"),
        ({"motors": {"unit": "bar"}}, "", "has motors in bar"),
        ({"outputs": {"unit": "m", "display_unit": "m"}}, "", "has outputs in m"),
        ({"motors": {"setpoint_min": 1.0}}, "", "motor 1 may go from 1 to 4 rad"),
        ({}, "[bus]\nbit_rate = 50000\n", r"2 drives every 10 ms would take 1\d\d % of a bus with 50000 bit/s"),
        ({}, '[sensor]\nkind = "can"\nnode = 12\n', "node 12 is that of a drive"),
    ],
)
def test_what_robot_and_drives_file_contradict_is_one_line(
    tmp_path: Path, tables: dict[str, Any], more: str, line: str
) -> None:
    path = tmp_path / "drives.toml"
    path.write_text(drives_text(2, more=more), encoding="utf-8")
    with pytest.raises(SettingsError, match=line) as caught:
        load_drives(path, robot(2, **tables))
    assert "\n" not in str(caught.value)


def test_what_the_watch_needs_is_not_assumed(tmp_path: Path) -> None:
    path = tmp_path / "drives.toml"
    path.write_text(drives_text(2).replace("gain = 0.08\n", ""), encoding="utf-8")
    with pytest.raises(SettingsError, match=r"\[watch\] `gain` is missing.*robot `robot of 2`"):
        load_drives(path, robot(2))
    # Where the directions are to be identified there is nothing to watch, and the check says so.
    file = load_drives(path, Robot.from_dict({**robot(2).as_dict(), "directions": {"kind": "identified"}}))
    assert file.weights == ()


def test_signs_that_agree_and_none_at_all_are_both_fine(tmp_path: Path) -> None:
    path = tmp_path / "drives.toml"
    path.write_text(drives_text(2, reversed=2), encoding="utf-8")
    for sign in ([1.0, -1.0], [1.0, 1.0]):
        file = load_drives(path, robot(2, motors={"sign": sign}))
        assert [drive.scale.reversed for drive in file.drives] == [False, True]


def test_the_tighter_limit_of_robot_and_drives_file_holds_and_check_says_whose(tmp_path: Path) -> None:
    path = tmp_path / "drives.toml"
    path.write_text(drives_text(2, more="[limits]\nposition_rad = 4.5\nspeed_rad_s = 13.0\n"), encoding="utf-8")
    file = load_drives(path, robot(2, motors={"setpoint_max": [2.0, 9.0]}))
    assert file.ranges == ((-4.5, 2.0, 12.0), (-4.5, 4.5, 12.0))
    rows = preflight(link_to(file), file).rows
    said = [row.found for row in rows if row.name == "set-points"]
    assert said == [
        "-4.5 rad (drives file) to 2 rad (robot), 12 rad/s (robot)",
        "-4.5 rad (drives file) to 4.5 rad (drives file), 12 rad/s (robot)",
    ]
    high = [write.value for write in limit_writes(file, file.drives[0]) if (write.at, write.sub) == (0x607D, 2)]
    assert high == [round(2.0 * file.drives[0].scale.counts_per_radian) + 1]


def test_a_neck_alone_has_no_row_and_no_limit_of_a_robot() -> None:
    file = default_drives()
    names = {row.name for row in preflight(link_to(file), file).rows}
    assert names.isdisjoint({"robot", "set-points", "bus load"})
    assert file.master_settings(TS).channels is None


def test_the_bits_of_a_frame_at_worst() -> None:
    """Davis, Burns et al. 2007, Eq. 2 with g = 34: 135 bits for 8 bytes, 55 for none."""
    assert [frame_bits(size) for size in (0, 6, 8)] == [55, 115, 135]
    assert frame_bits(1, remote=True) == 55


# -- simulated --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["antagonist", "finger", "trunk4"])
def test_simulated_drives_turn_the_virtual_plant_of_a_preset(name: str) -> None:
    file = neck_drives(physics_of(Robot.preset(name)), Robot.preset(name))  # pyright: ignore[reportArgumentType]
    plant = simulated_plant(file, None, sample_time=TS)
    assert isinstance(plant, SimulatedNeck)
    assert len(plant.drives) == len(file.nodes)
    assert stand_in(file, None) == ""
    for _ in range(10):
        plant.move()
    assert len(plant.sample(0.1).values) == len(Robot.preset(name).outputs.names)


# What grows with a parameter of the neck, to which power; all else stays: (tension, slack, tightening current).
GROWS = {
    "pretension": (0, 1, 1), "current_limit": (1, 0, 0), "gear_ratio": (1, 0, -1), "winch_radius": (-1, 0, 1),
    "torque_constant": (1, 0, -1), "gear_efficiency": (1, 0, -1), "position_limit": (0, 0, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", GROWS)
def test_drives_of_a_neck_keep_their_proportions(name: str) -> None:
    paper = NeckParameters.paper()
    before = neck_drives(paper)
    assert before == default_drives()
    changed = paper.replace(**{name: 0.8 * getattr(paper, name)})
    file = neck_drives(changed)
    ratios = (file.limits.tension / before.limits.tension, file.limits.slack / before.limits.slack,
              file.zero.current / before.zero.current)  # fmt: skip
    np.testing.assert_allclose(ratios, [0.8**power for power in GROWS[name]], rtol=1e-12)
    # How far the neck tilts: the watch's gain and tolerance, and how far a tendon may be let out, all alike.
    tilts = file.watch.gain / before.watch.gain
    assert tilts == pytest.approx(1.0, rel=0.3)
    assert (tilts == 1.0) is (name == "position_limit")
    assert file.watch.tilt / before.watch.tilt == pytest.approx(tilts, rel=1e-12)
    assert file.limits.slack_unwind / before.limits.slack_unwind == pytest.approx(tilts, rel=1e-12)
    assert file.limits.position == min(before.limits.position, changed.position_limit)
    assert (file.neck.winch_radius, file.neck.torque_constant, file.neck.efficiency) == (
        changed.winch_radius, changed.torque_constant, changed.gear_efficiency,
    )  # fmt: skip
    assert {(drive.current_limit, drive.scale.gear) for drive in file.drives} == {
        (changed.current_limit, changed.gear_ratio)
    }
    assert neck_drives(paper.replace(position_limit=9.0)).limits.position == before.limits.position


def test_springs_and_drives_are_those_of_the_file(monkeypatch: pytest.MonkeyPatch) -> None:
    file = default_drives(robot=robot(2))
    scales = [replace(d.scale, gear=3.0 + k, counts_per_turn=500 + k, peak_current=1.0 + k, slow_loop=0.001 * (k + 1),
                      reversed=bool(k)) for k, d in enumerate(file.drives)]  # fmt: skip
    drives = tuple(replace(d, scale=s, current_limit=0.1 + k) for k, (d, s) in
                   enumerate(zip(file.drives, scales, strict=True)))  # fmt: skip
    file = replace(file, drives=drives)
    for name in ("SimulatedSettings", "SpringSettings", "SimulatedSprings"):
        monkeypatch.setattr(_virtual, name, lambda *args, **named: named or args)
    springs, found = cast("Any", simulated_springs(file, sample_time=TS, seed=5, homed=None))
    assert found == {
        "nodes": file.nodes, "profile": file.profile, "gear": (3.0, 4.0), "counts_per_turn": (500, 501),
        "reversed": (False, True), "peak_current": (1.0, 2.0), "slow_loop": (0.001, 0.002), "sample_time": TS,
        "cycle": file.cycle, "hold": TS, "seed": 5,
    }  # fmt: skip
    weights = springs.pop("weights")
    np.testing.assert_allclose(weights, file.watch.gain * np.array(robot(2).weights()))
    assert springs == {
        "outputs": robot(2).outputs.names, "pole": file.watch.pole, "torque_constant": file.neck.torque_constant,
        "reach": tuple(max(-low, high) for low, high, _ in file.ranges), "efficiency": file.neck.efficiency,
        "current_limit": (0.1, 1.1), "winch_radius": file.neck.winch_radius, "pretension_current": file.zero.current,
        "noise_std": pytest.approx(1e-5),
    }  # fmt: skip


def test_springs_stand_for_a_robot_without_a_plant_and_say_so() -> None:
    file = default_drives(robot=robot(8))
    assert isinstance(simulated_plant(file, None, sample_time=TS), SimulatedSprings)
    assert "robot `robot of 8`" in stand_in(file, None)
    unknown = default_drives(robot=Robot.from_dict({**robot(2).as_dict(), "directions": {"kind": "identified"}}))
    with pytest.raises(SettingsError, match="nothing can stand for it"):
        simulated_springs(unknown, sample_time=TS)


def test_outputs_of_springs_end_where_directions_and_gain_say() -> None:
    file = default_drives(robot=robot(8))
    plant = simulated_springs(file, sample_time=TS)
    plant._winches[0] = positions = np.linspace(-1.0, 1.0, 8)
    for _ in range(400):
        plant.move()
    weights = robot(8).weights()
    assert weights is not None
    # 4 s are 21 time constants: e^-21 is left.
    np.testing.assert_allclose(plant.outputs[0], file.watch.gain * weights @ positions, atol=1e-8)


# -- acts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 8])
def test_zero_tightens_every_tendon(count: int) -> None:
    file = default_drives(robot=robot(count))
    link = link_to(file, homed=False)
    found = zero(link, file, lambda: link.newest, guarding=preflight(link, file).guarding)
    # Loose by 1 rad; tight within the last fifth of a radian's catch.
    assert found.pulled == pytest.approx((1.0,) * count, abs=0.05)
    assert set(found.outputs) == set(robot(count).outputs.names)
    assert {f"{name}_deg" for name in robot(count).outputs.names} <= set(found.table())


@pytest.mark.parametrize(("count", "motor"), [(1, 1), (2, 2), (4, 3), (8, 6)])
def test_jog_knows_each_motor_by_its_direction(count: int, motor: int) -> None:
    file = default_drives(robot=robot(count))
    found = jog(motor, Session(file=file, link=link_to(file)))
    assert found.verdict == "ok"
    assert found.seen == pytest.approx(found.expected, abs=1e-3)
    assert found.outputs == robot(count).outputs.names


def test_jog_tells_a_motor_that_is_another_one() -> None:
    """Nodes 1 and 2 swapped: motor 1 moves what motor 2 should."""
    file = default_drives(robot=robot(4))
    turned = default_drives(robot=robot(4, directions={"angles_deg": [90.0, 0.0, 180.0, 270.0]}))
    link = VirtualLink(simulated_springs(turned, sample_time=TS))
    found = jog(1, Session(file=file, link=link))
    assert found.verdict == "other motor?"
    assert "as motor 2 would" in found.advice


def test_jog_goes_no_further_than_the_motor_may() -> None:
    file = default_drives(robot=robot(1, motors={"setpoint_min": 0.0}))
    found = jog(1, Session(file=file, link=link_to(file)))
    assert found.verdict == "ok"
    assert found.expected[0] == pytest.approx(0.25 * file.watch.gain)


@pytest.mark.parametrize("count", [2, 8])
def test_an_experiment_is_recorded_logged_and_replayed(tmp_path: Path, count: int) -> None:
    file = default_drives(robot=robot(count))
    moved, t = robot(count), np.arange(100) * TS
    wave = 0.3 * np.sin(math.pi * t)[:, None] * np.linspace(-1.0, 1.0, count)
    channels = dict(zip(moved.set_points, wave.T, strict=True)) | dict.fromkeys(moved.outputs.names, 0.0 * t)
    write_recording(tmp_path / "signal.csv", Recording(t, TS, channels, robot=moved))
    played = Experiment(
        signal=str(tmp_path / "signal.csv"), limits=drive_limits(file), ramp=0.2, cocontraction=0.02, robot=moved,
        ranges=file.ranges,
    )  # fmt: skip
    with RunLogger(tmp_path / "run.mcap", wait=True) as log:
        session = Session(file=file, link=link_to(file), log=log, facts={"record": played.facts()})
        result = record_signal([one for one, _ in played.prepare_runs()], session)
    assert result.completed
    recording = result.recording
    assert recording is not None
    assert recording.robot.hash == moved.hash
    # Behind by the latency of the paper's drives (80 ms), the bus, and their position loop: eight samples.
    np.testing.assert_allclose(recording.motor_positions[8:], recording.set_points[:-8], atol=0.05)
    logged = read_run_log(tmp_path / "run.mcap")
    assert logged.robot.hash == moved.hash
    np.testing.assert_array_equal(logged.recording().outputs, recording.outputs)
    again = Experiment.of(logged.facts["record"], logged.robot, file.ranges)
    assert replay(logged, again.pilot()).difference is None
    assert {decode_cycle(json.loads(json.dumps(encode_cycle(cycle)))) == cycle for cycle in logged.cycles[:50]} == {
        True
    }
    write_recording(tmp_path / "out.csv", recording)
    assert read_recording(tmp_path / "out.csv").robot.hash == moved.hash


def test_set_points_of_another_robot_are_not_played(tmp_path: Path) -> None:
    t = np.arange(10) * TS
    neck = Recording(
        t, TS, dict.fromkeys(("motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3", "pitch", "roll"), 0 * t)
    )
    write_recording(tmp_path / "neck.csv", neck)
    played = Experiment(signal=str(tmp_path / "neck.csv"), limits=drive_limits(default_drives()), robot=robot(2))
    with pytest.raises(SoftneckError, match=r"`robot of 2` .* and `neck`|`neck` .* and `robot of 2`"):
        played.prepare_runs()


def test_signals_by_name_are_those_of_the_robot_within_its_ranges() -> None:
    moved = Robot.preset("trunk4")
    file = default_drives(robot=moved)
    played = Experiment(signal="aprbs", limits=drive_limits(file), duration=8.0, robot=moved, ranges=file.ranges)
    ((excitation, _),) = played.prepare_runs()
    assert excitation.set_points.shape == (400, 4)
    assert np.abs(excitation.set_points).max() <= 6.0
    # Between the ramps of 2 s, which are longer where a motor has to go further, all are moved by the common position.
    slow, taut = (
        replace(played, signal="rotation", cocontraction=common).prepare_runs()[0][0].set_points[120:280]
        for common in (0.0, 0.4)
    )
    np.testing.assert_allclose(taut, slow + 0.4, rtol=1e-12)  # rounding


# -- sensors ----------------------------------------------------------------------------------------------------------


def test_a_one_axis_inclinometer_on_the_bus() -> None:
    sensor = CanInclinometer(10, 1)
    sample = sensor.read(0.0, [Frame(0x18A, (2500).to_bytes(4, "little"))])
    assert sample is not None
    assert sample.values == pytest.approx((math.radians(2.5),))
    assert sensor.read(0.1, [Frame(0x18A, b"\0" * 8)]) is None
    none = sensor.read(0.2, [Frame(0x18A, (-(2**31)).to_bytes(4, "little", signed=True))])
    assert none is not None
    assert not none.valid
    with pytest.raises(SettingsError, match="has one axis or two; the robot has 4 outputs"):
        CanInclinometer(10, 4)


def test_a_sensor_of_ones_own_says_a_number_for_each_output() -> None:
    class Own:
        answer: Any = (0.1, 0.2, 0.3, 0.4)

        def take(self, frames: Any) -> None: ...

        def read(self, now: float, frames: Any) -> Any:
            del now, frames
            return self.answer

    own = Own()
    sensor = PythonInclinometer(own, "own", 4)
    sample = sensor.read(0.0, [])
    assert sample is not None
    assert sample.values == own.answer
    own.answer = (0.1, 0.2)
    assert sensor.read(0.1, []) is None
    assert "2 numbers for 4 outputs" in sensor.problem


# -- loops ------------------------------------------------------------------------------------------------------------


class Ports:
    """A part of a loop by its ports: a plant that is only wired, or a controller that is a function of its inputs."""

    def __init__(self, role: str, inputs: list[str], outputs: list[str], act: Any = None) -> None:
        self.role, self.sample_time, self._act = role, TS, act
        self.inputs = tuple(Port(name=name, unit="rad") for name in inputs)
        self.outputs = tuple(Port(name=name, unit="rad") for name in outputs)

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        del time, parameters
        return np.zeros(len(self.outputs))

    def advance(self, time: float, inputs: Vector) -> Vector:
        del time
        return np.zeros(len(self.outputs)) if self._act is None else self._act(inputs)

    def close(self) -> None: ...


def loop_of(moved: Robot, act: Any) -> Loop:
    names = list(moved.outputs.names)
    plant = Ports("plant", list(moved.set_points), [*names, *moved.motor_positions])
    asked = ["pitch_reference", "roll_reference", *names]
    controller = Ports("controller", asked, list(moved.set_points), act)

    def wanted(t: float) -> tuple[float, float, float]:
        return (0.1 if t > 0.5 else 0.0, 0.0, 0.0)

    return Loop(plant=plant, controller=controller, reference=wanted, duration=3.0, robot=moved)


def test_a_controller_runs_on_four_drives_by_the_names_of_its_ports(tmp_path: Path) -> None:
    moved = Robot.preset("trunk4")
    weights = moved.weights()
    assert weights is not None
    file = neck_drives(physics_of(moved), moved)  # pyright: ignore[reportArgumentType]

    def act(u: Vector) -> Vector:
        # Static: what brings the outputs to their references, and half of what is missing.
        return weights.T @ ((u[:2] + 0.5 * (u[:2] - u[2:])) / (2.0 * file.watch.gain))

    with RunLogger(tmp_path / "run.mcap", wait=True) as log:
        result = run_simulated(Deployment(loop_of(moved, act), None), file, log=log)
    assert result.completed
    recording = result.recording()
    assert recording.robot.hash == moved.hash
    # Within a quarter of the reference: a static controller, and tendons with friction.
    assert recording.channels["pitch"][-1] == pytest.approx(0.1, abs=0.025)
    assert recording.channels["roll"][-1] == pytest.approx(0.0, abs=0.025)
    logged = read_run_log(tmp_path / "run.mcap")
    again = replay(logged, LoopPilot(loop_of(moved, act), logged.robot))
    assert again.difference is None
    assert again.answers == len(recording)


def test_a_loop_of_another_robot_is_refused() -> None:
    with pytest.raises(SoftneckError, match=r"loop and drives of two robots .* `neck` .* and `trunk4`"):
        LoopPilot(loop_of(Robot.preset(), None), Robot.preset("trunk4"))


def test_a_certificate_of_another_robot_arms_nothing(tmp_path: Path) -> None:
    def certificate(**contents: dict[str, str]) -> Certificate:
        return Certificate(path=tmp_path / "c.json", kind="verify", holds=True, files={}, contents=contents)

    trunk, neck = Robot.preset("trunk4"), Robot.preset()
    _require_robot(certificate(), neck)
    of_trunk = {"name": "trunk4", "hash": trunk.hash}
    _require_robot(certificate(robot=of_trunk), trunk)
    for found, moved in ((certificate(), trunk), (certificate(robot=of_trunk), neck)):
        with pytest.raises(CheckFailedError, match=f"the drives move `{moved.name}`"):
            _require_robot(found, moved)


def test_a_controller_of_wider_limits_is_told_in_a_loop_and_refused_on_drives() -> None:
    """Robots that differ in limits alone have one hash."""
    wide = Robot.preset("antagonist")
    narrow = replace(wide, motors=replace(wide.motors, setpoint_min=(-4.0, -4.0), setpoint_max=(4.0, 4.0)))
    assert wide.hash == narrow.hash
    model, far = plant(narrow), design_controller("pi", plant(wide))

    def loop_with(controller: object, **more: object) -> LoopSetup:
        return make_loop({
            "duration_s": 0.1, "plant": {"object": model}, "controller": {"object": controller, **more},
            "reference": {"kind": "step", "pitch_deg": 1.0},
        })  # fmt: skip

    why = f"may send `motor_setpoint_1` to -6 rad, and robot {narrow.label()} goes to -4 rad"
    assert any(why in remark for remark in run_setup(loop_with(far)).remarks)
    with pytest.raises(CheckFailedError, match=r"so were its certificates\. Design and certify it for that robot"):
        prepare(loop_with(far), robot=narrow)
    prepare(loop_with(far), robot=wide)
    within = loop_with(far, parameters={"position_limit": 4.0})
    assert not any("may send" in remark for remark in run_setup(within).remarks)
    prepare(within, robot=narrow)
