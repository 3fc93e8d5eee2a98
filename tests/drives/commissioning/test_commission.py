"""Drives with mistakes planted: each is named, the files proposed are right, and the neck never tilts by 3 deg.

The tilt is that of the simulated plant, absolute: a neck that leans by 1.5 deg before counts with it.
"""

from __future__ import annotations

import itertools

import pytest

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import default_drives, load_drives
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._units import current_to_internal
from softneck.drives.commissioning._commission import commission, write_files
from softneck.drives.commissioning._moves import PULLED
from softneck.drives.running._bus_loop import Session
from softneck.drives.running._timing import Ask
from softneck.drives.running._virtual import simulated_plant
from softneck.plant import NeckParameters
from softneck.robot import Robot

from .commissioned import Run, Truth, agrees, believed, commissioned
from .planted import plant, planted_link

MISTAKES = {
    "reversed:1": {"reversed"},
    "exchanged:1:2": {"exchanged motors"},
    "exchanged:2:3": {"exchanged motors", "sensor sign"},
    "gear:1:2": {"gear"},
    "gear:1:0.5": {"gear"},
    "lines:1:2": {"encoder lines"},
    "lines:1:0.5": {"encoder lines"},
    "current:1:2": {"current scale"},
    "current:1:0.5": {"current scale"},
    "axes": {"sensor axes"},
    "sign:pitch": {"sensor sign"},
    "sign:roll": {"exchanged motors", "sensor sign"},
    "late:0.2": {"sensor late"},
}
# These two undo each other: a neck in a mirror, in which every move is as it should be.
MIRROR = {"exchanged:2:3", "sign:roll"}
# Some that no test here plants alone: what each touches is another one's.
PAIRS = [
    ("gear:1:0.5", "late:0.2"),
    ("reversed:1", "axes"),
    ("lines:2:2", "current:1:2"),
    ("exchanged:1:2", "gear:1:2"),
]


def named(run: Run, mistake: str) -> bool:
    """Whether a mistake is named: by itself, or as what no move can tell from it."""
    others = {text.partition(":")[0] for one in run.found.findings for text in one.instead}
    said = others | {one.name for one in run.found.findings}
    kind, _, rest = mistake.partition(":")
    # What motor 2 has is called as what motor 1 has.
    return bool(MISTAKES.get(mistake, MISTAKES.get(f"{kind}:1{rest[1:]}", set())) & said)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "rough"])
def test_drives_as_their_file_says_have_nothing_found(preset: str) -> None:
    run = commissioned([], preset)
    assert [str(one) for one in run.found.findings] == []
    assert run.right == run.planted.file
    assert (run.moves.stopped, [moved.outcome for moved in run.moves.motors]) == ("", [PULLED] * 3)
    # A sample to either side, and noise: 0.05 deg of it is 0.045 deg over 50 samples at rest.
    assert run.found.late == pytest.approx(0.0, abs=0.02)
    assert run.found.noise == pytest.approx(NeckParameters.preset(preset).noise_std, rel=0.25)
    assert run.truth.largest < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_and_put_right_before_three_degrees(mistake: str) -> None:
    run = commissioned([mistake])
    assert named(run, mistake)
    assert len(run.found.findings) == 1
    assert agrees(run)
    assert run.truth.largest < 3.0
    if mistake.startswith("late"):
        assert run.found.late == pytest.approx(0.2, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("pair", PAIRS, ids="+".join)
def test_some_pairs_are_named_and_put_right(pair: tuple[str, str]) -> None:
    run = commissioned(pair)
    assert all(named(run, mistake) for mistake in pair), [str(one) for one in run.found.findings]
    assert agrees(run)
    assert run.truth.largest < 3.0


def _second(mistake: str) -> str:
    """The same mistake of motor 2."""
    kind, _, rest = mistake.partition(":")
    return f"{kind}:2{rest[1:]}" if kind in ("reversed", "gear", "lines", "current") else mistake


def all_pairs() -> list[tuple[str, str]]:
    both = [(a, b) for a, b in itertools.combinations(MISTAKES, 2)
            if a.split(":")[:2] != b.split(":")[:2] and {a, b} != {"exchanged:1:2", "exchanged:2:3"}
            and {a, b} != MIRROR]  # fmt: skip
    # Two motors with the same mistake, or one and its opposite.
    return both + [(a, _second(b)) for a, b in itertools.product(list(MISTAKES)[3:9], repeat=2)
                   if a.split(":")[0] == b.split(":")[0]] + [("reversed:1", "reversed:2")]  # fmt: skip


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("pair", all_pairs(), ids="+".join)
def test_all_pairs_are_named_and_put_right(pair: tuple[str, str]) -> None:
    run = commissioned(pair)
    assert run.truth.largest < 3.0
    assert agrees(run), [str(one) for one in run.found.findings]
    assert run.found.findings


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ["", "axes"])
def test_the_lab_s_noisy_sensor_lets_what_does_not_need_it_be_found(mistake: str) -> None:
    """0.27 deg of slow noise: gears, currents and lateness are not judged, not guessed, and a line says so."""
    run = commissioned([mistake] if mistake else [], "lab")
    assert not run.found.quiet
    assert run.truth.largest < 3.0
    assert run.right.drives == run.planted.file.drives
    assert run.right.sensor_axes == run.planted.file.sensor_axes
    told = {one.name: one for one in run.found.findings}
    assert set(told) == {"sensor noise", "sensor axes"} if mistake else {"sensor noise"}
    assert "0.15 at most: gears, currents and lateness were not judged" in str(told["sensor noise"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "mistake", "found"),
    [
        ("trunk4", "", set()),
        pytest.param("trunk4", "reversed:2", {"reversed"}, marks=pytest.mark.nightly),
        pytest.param("trunk4", "gear:3:2", {"gear"}, marks=pytest.mark.nightly),
        ("trunk4", "exchanged:1:2", {"exchanged motors"}),
        pytest.param("trunk4", "axes", {"sensor axes"}, marks=pytest.mark.nightly),
        ("antagonist", "", set()),
        ("antagonist", "reversed:2", {"reversed"}),
        ("antagonist", "gear:1:2", {"gear"}),
        # One tendon on a link that springs back by itself: taut before it moves, and let out beyond where it stood.
        ("finger", "", set()),
        ("finger", "reversed:1", {"reversed"}),
        ("finger", "gear:1:0.5", {"gear"}),
        ("finger", "sign:pitch", {"sensor sign"}),
        ("finger", "late:0.2", {"sensor late"}),
    ],
)
def test_robots_with_other_tendons_are_commissioned(name: str, mistake: str, found: set[str]) -> None:
    robot = Robot.preset(name)
    file = default_drives(robot=robot)
    planted = plant(file, [mistake] if mistake else [])
    link = planted_link(file, planted, None, sample_time=0.02)
    truth = Truth(link)
    result = commission(Session(file=file, link=link, watches=(truth,)))
    assert {one.name for one in result.findings} == found, [str(one) for one in result.findings]
    assert result.file.drives == planted.file.drives
    assert result.file.sensor_axes == planted.file.sensor_axes
    assert truth.moved < 3.0


def test_springs_that_stand_in_for_a_robot_are_not_commissioned() -> None:
    """They pull both ways, so that the sign of each motor came out as the noise had it."""
    file = default_drives(robot=Robot.preset("arm"))
    with pytest.raises(SettingsError, match=r"has no virtual plant.*Give it one: \[plant\] neck"):
        commission(Session(file=file, link=VirtualLink(simulated_plant(file, None, sample_time=0.02, homed=False))))


@pytest.mark.slow
def test_names_of_motors_do_not_matter() -> None:
    """Motor 2 is wired as motor 1 was before, all else moves with it: the findings do so, too."""
    one, two = commissioned(["reversed:1", "gear:1:2"]), commissioned(["reversed:2", "gear:2:2"])
    assert [(f.name, f.motors, f.factor) for f in one.found.findings] == [
        (f.name, tuple({1: 2, 2: 1}.get(j, j) for j in f.motors), f.factor) for f in two.found.findings
    ]


@pytest.mark.slow
def test_what_was_proposed_leaves_nothing_to_find(tmp_path: object) -> None:
    file, guards, _ = believed("paper")
    planted = plant(file, ["reversed:3", "lines:2:2", "sign:pitch"])
    neck = NeckParameters.paper()
    result = commission(
        Session(file=file, link=planted_link(file, planted, neck, sample_time=0.02)), guards=guards, neck=neck
    )
    assert {one.name for one in result.findings} == {"reversed", "encoder lines", "sensor sign"}
    with pytest.raises(CheckFailedError, match=r"3 finding\(s\): motor 3: reversed"):
        result.require()
    written = write_files(tmp_path, result, force=False)  # type: ignore[arg-type]
    again = load_drives(written["drives"])
    assert again.drives == planted.file.drives
    assert again.sensor_axes == planted.file.sensor_axes
    assert again.robot is not None
    assert again.robot.is_neck
    second = commission(
        Session(file=again, link=planted_link(again, planted, neck, sample_time=0.02)), guards=guards, neck=neck
    )
    assert second.holds, [str(one) for one in second.findings]
    second.require()


def test_two_devices_with_one_number_are_named_and_nothing_moves() -> None:
    file = default_drives()
    link = planted_link(file, plant(file, ["duplicate:2", "gear:1:2"]), None, sample_time=0.02)
    truth = Truth(link)
    result = commission(Session(file=file, link=link, watches=(truth,)))
    assert [(one.name, one.motors) for one in result.findings] == [("duplicate node", (2,))]
    assert result.moves is None
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
    with pytest.raises(
        CheckFailedError, match=r"motor 2: duplicate node: node 2: 2 devices answer \(serial numbers 10"
    ):
        result.require()


def test_a_type_that_is_public_names_a_wrong_current_scale_before_anything_moves() -> None:
    """20 A tell that they are an iPOS4808; the moves go on with the right scale, and are broken off here."""
    file = default_drives()
    link = planted_link(file, plant(file, ["current:2:2"]), None, sample_time=0.02)
    result = commission(Session(file=file, link=link, operator=lambda: Ask.STOP), motors=(1,))
    assert next((one.name, one.motors, one.factor) for one in result.findings) == ("wrong type", (2,), 2.0)
    assert result.file.drives[1].scale.peak_current == 20.0


def test_an_operator_ends_it_with_all_drives_off() -> None:
    file = default_drives()
    link = planted_link(file, plant(file, []), None, sample_time=0.02)
    result = commission(Session(file=file, link=link, operator=lambda: Ask.LEAVE if link.now > 8.0 else None))
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
    assert {one.name for one in result.findings} == {"not moved"}
    assert result.ended is not None
    assert result.ended.left
    assert result.file.drives == file.drives
    # The drives' own limits were those of the moves: the current of `zero`, and the travel from where the winch stood.
    for entry, drive in zip(file.drives, link.neck.drives, strict=True):
        values, counts = drive.axis.values, entry.scale.counts_per_radian
        assert values[(0x207F, 0)] == current_to_internal(file.zero.current, entry.scale)
        assert values[(0x607D, 2)] - values[(0x607D, 1)] == pytest.approx(2.0 * 1.1 * 10.0 * counts, abs=2)
        # And no zero is left behind: what was not homed before is not homed now.
        assert values[(0x607C, 0)] == 0


def test_a_push_is_stopped_by_the_guard() -> None:
    file, guards = default_drives(), None
    link = planted_link(file, plant(file, []), None, sample_time=0.02)

    def push(*_: object) -> None:
        # Half a second after the motors got power: 0.6 N at the platform.
        link.neck.set(push_x=2.0 if link.now > 6.0 else 0.0)

    result = commission(Session(file=file, link=link, watches=(push,)), guards=guards)
    assert result.moves is not None
    assert result.moves.stopped.startswith("tilt: ")
    assert all(drive.axis.state == 0x40 for drive in link.neck.drives)
