"""What drives may refuse, not tell, or want in another order: each quirk by itself, and the commands on it."""

from __future__ import annotations

import re
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest
from canopen.sdo.exceptions import SdoAbortedError

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import default_drives, jog, preflight, read_run_log, replay, zero
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._jog import jog_pilot
from softneck.drives.logs._run_log import RunLogger
from softneck.drives.master import Frame, Phase
from softneck.drives.master._cia402 import DriveState, Goal
from softneck.drives.master._fieldbus import BusSettings, Fieldbus
from softneck.drives.running._bus_loop import Session, run_session
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings
from softneck.drives.simulated._quirks import DriveQuirks, quirks_of
from softneck.drives.simulated._servo_runtime import SERVO_SCALE, SERVO_ZERO
from softneck.plant import NeckParameters

from ..data import ROOT
from .bench import DISABLED, FAST, Bench, T
from .pairwise import covering
from .test_strict import Direct

ENABLED_MODE_3 = ((0x6060, b"\3"), (0x6040, b"\6\0"), (0x6040, b"\7\0"), (0x6040, b"\x0f\0"))
OPTIONAL = (0x1003, 0x1005, 0x1014, 0x1200, 0x2000, 0x2002)


def linked(*, homed: bool = True, profile: str = "ipos2015", **quirks: Any) -> VirtualLink:
    settings = SimulatedSettings(profile=profile, homed=homed, quirks=DriveQuirks(**quirks))
    return VirtualLink(SimulatedNeck(NeckParameters.paper(), settings))


def client(link: VirtualLink, row: int = 0) -> Any:
    """A foreign client of one drive's SDO server."""
    return Direct(link.neck.drives[row]._sdo).client


def refusal(act: Any, *said: Any) -> int:
    with pytest.raises(SdoAbortedError) as refused:
        act(*said)
    return refused.value.code


def test_each_quirk_stands_in_the_reference() -> None:
    text = (ROOT / "docs" / "reference" / "drives.md").read_text(encoding="utf-8")
    begin = text.index("## The simulated drives")
    named = set(re.findall(r"^\| `(\w+)` \|", text[begin:], re.M))
    assert named == {field.name for field in fields(DriveQuirks)}


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ([], DriveQuirks()),
        (["sdo_latency=0.05", "twin=4", "write_only=true"], DriveQuirks(sdo_latency=0.05, twin=4, write_only=True)),
        (["mode_when=off", "lacks=[0x1003, 0x1014]"], DriveQuirks(mode_when="off", lacks=(0x1003, 0x1014))),
        (["sdo_latency=1"], DriveQuirks(sdo_latency=1.0)),
        (["twins=4"], "unknown setting `twins`"),
        (["twin=many"], "`twin` must be a whole number between 0 and 126; got 'many'"),
        (["twin=0.5"], "`twin` must be a whole number between 0 and 126; got 0.5"),
        (["write_only=1"], "`write_only` is true or false; got 1"),
        (["sdo_latency=2"], "`sdo_latency`"),
        (["twin"], "`twin` must be a whole number between 0 and 126; got ''"),
        (["lacks=[0x6041]"], "`lacks` may not hold 6041h"),
    ],
)
def test_quirks_are_said_in_words(texts: list[str], said: DriveQuirks | str) -> None:
    if isinstance(said, DriveQuirks):
        assert quirks_of(texts) == said
        return
    with pytest.raises(SettingsError, match=re.escape(said)):
        quirks_of(texts)


# -- each by itself ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("index", [0x6040, 0x6060, 0x6098, 0x60C2, 0x60FF])
def test_what_is_write_only_takes_values_and_tells_none(index: int) -> None:
    sub = int(index == 0x60C2)
    drive = client(linked(write_only=True))
    assert refusal(drive.upload, index, sub) == 0x06010001
    size = len(client(linked()).upload(index, sub))
    drive.download(index, sub, (8 if index == 0x6060 else 0).to_bytes(size, "little"))


def test_an_expedited_write_without_size_reaches_what_cannot_be_read() -> None:
    link = linked(write_only=True)
    link.send([Frame(0x601, b"\x22\x60\x60\0\x03\0\0\0", False)])
    assert Frame(0x581, b"\x60\x60\x60\0\0\0\0\0") in link.drain()
    assert link.neck.drives[0].axis.values[(0x6060, 0)] == 3


@pytest.mark.parametrize(("mode_when", "off", "enabled"), [("off", 0, 0x08000022), ("enabled", 0x08000022, 0)])
def test_a_mode_is_taken_before_or_after_operation_enabled(mode_when: str, off: int, enabled: int) -> None:
    link = linked(mode_when=mode_when)
    drive, axis = client(link), link.neck.drives[0].axis
    for code in (off, enabled):
        if code:
            assert refusal(drive.download, 0x6060, 0, b"\x08") == code
        else:
            drive.download(0x6060, 0, b"\x08")
        for index, data in ENABLED_MODE_3[1:]:
            drive.download(index, 0, data)
        assert axis.state == 0x27


@pytest.mark.parametrize("index", OPTIONAL)
def test_an_object_that_a_drive_lacks_is_not_there(index: int) -> None:
    there, lacking = client(linked()), client(linked(lacks=(index,)))
    there.upload(index, 0)
    assert refusal(lacking.upload, index, 0) == 0x06020000
    assert refusal(lacking.download, index, 0, there.upload(index, 0)) == 0x06020000


def test_no_drive_lacks_what_makes_it_one() -> None:
    with pytest.raises(SettingsError, match="`lacks` may not hold 6041h"):
        DriveQuirks(lacks=(0x1003, 0x6041))
    with pytest.raises(SettingsError, match="`mode_when` must be"):
        DriveQuirks(mode_when="never")


def test_a_twin_answers_with_its_own_serial_number_and_turns_nothing() -> None:
    link = linked(twin=2)
    link.send([Frame(0x602, b"\x40\x18\x10\4\0\0\0\0", False)])
    told = [int.from_bytes(f.data[4:], "little") for f in link.drain() if f.identifier == 0x582]
    assert told == [1002, 2002]
    report = preflight(link, default_drives())
    with pytest.raises(CheckFailedError, match="node 2: node number: 2 devices answer"):
        report.require()


# -- the commands -----------------------------------------------------------------------------------------------------

QUIRKS: dict[str, tuple[Any, ...]] = {
    "sdo_latency": (0.0, 0.05),
    "write_only": (False, True),
    "mode_when": ("always", "off", "enabled"),
    "lacks": ((), OPTIONAL),
    "profile": ("ipos2015", "ds402"),
}


@pytest.mark.parametrize(
    ("quirks", "said"),
    [
        ({"write_only": True}, "3 values written and read back (not 6060h, 60C2h: write only)"),
        ({"mode_when": "enabled"}, "2 values written and read back"),
        ({"mode_when": "off", "lacks": OPTIONAL}, "3 values written and read"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_the_pre_flight_says_what_it_could_not_read_back(quirks: dict[str, Any], said: str) -> None:
    report = preflight(linked(**quirks), default_drives(), homed=True)
    assert report.holds, [row for row in report.rows if not row.holds]
    assert any(row.name == "modes" and row.found.startswith(said) for row in report.rows)
    assert tuple(report.late_modes) == ((1, 2, 3) if quirks.get("mode_when") == "enabled" else ())


def test_a_guard_that_cannot_be_read_back_is_none() -> None:
    """Only what is no guard may be write only."""
    link = linked()
    read = link.neck.drives[1].axis.read
    link.neck.drives[1]._sdo._read = lambda index, sub: 0x06010001 if index == 0x6007 else read(index, sub)
    with pytest.raises(CheckFailedError, match="node 2: options: node 2 refuses object 6007h"):
        preflight(link, default_drives()).require()


@pytest.mark.parametrize(("mode", "holds"), [(0, True), (3, True), (6, True), (-1, False)])
def test_a_drive_that_takes_its_mode_late_must_hold_until_then(mode: int, holds: bool) -> None:
    link = linked(mode_when="enabled")
    axis = link.neck.drives[0].axis
    axis.values[(0x6060, 0)], axis.values[(0x60FF, 0)] = mode, 1000
    report = preflight(link, default_drives())
    assert report.holds is holds
    assert not holds or axis.values[(0x60FF, 0)] == 0, "it would turn as soon as it is enabled"


def test_a_mode_that_a_drive_does_not_have_is_not_asked_for_later(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("softneck.drives.simulated._quirks._KNOWN_MODES", (1, 3, 6))
    report = preflight(linked(mode_when="enabled"), default_drives())
    assert [row.found for row in report.rows if row.found.startswith("6502h")] == [
        "6502h is 001F0065h, mode 8 is refused"
    ] * 3


def ran(link: VirtualLink, profile: str) -> Any:
    file = replace(default_drives(profile), ramps=FAST)
    pilot = jog_pilot(1, 0.1)
    return run_session(Session(file=file, link=link), pilot, sample_time=0.02, most=5.0)


@pytest.mark.slow
@pytest.mark.parametrize("row", covering(QUIRKS), ids=lambda row: ",".join(f"{v}" for v in row.values()))
def test_zero_pre_flight_and_a_run_hold_under_all_pairs_of_quirks(row: dict[str, Any]) -> None:
    quirks = {name: value for name, value in row.items() if name != "profile"}
    profile = row["profile"]
    link, file = linked(homed=False, profile=profile, **quirks), default_drives(profile)
    report = preflight(link, file)
    report.require()
    zeroed = zero(link, file, lambda: link.newest, guarding=report.guarding)
    assert all(pulled > 0.5 for pulled in zeroed.pulled)
    ended = ran(link, profile)
    ended.require()
    assert ended.master.supervisor.phase is Phase.DONE
    assert [drive.axis.state for drive in link.neck.drives] == [DISABLED] * 3


@pytest.mark.slow
@pytest.mark.parametrize("mode_when", ["off", "enabled"])
def test_a_zero_stands_where_the_tendons_were_tight_whatever_the_order(mode_when: str) -> None:
    """A drive that loses its power to change its mode lets the winch go back; the zero does not."""
    zeros, file = [], default_drives()
    for quirks in ({}, {"mode_when": mode_when}):
        link = linked(homed=False, **quirks)
        zero(link, file, lambda link=link: link.newest, guarding=preflight(link, file).guarding)
        zeros.append(link.neck.motion[:, SERVO_ZERO] / link.neck.motion[:, SERVO_SCALE])
        assert [drive.axis.values[(0x607C, 0)] for drive in link.neck.drives] == [1, 1, 1]
    # Between the moments of the two a winch creeps by up to `still` (0.02 rad/s) for the second that homing takes.
    assert zeros[0] == pytest.approx(zeros[1], abs=0.02)


def test_a_drive_that_counts_by_its_home_offset_at_once_is_not_zeroed() -> None:
    file, link = default_drives(), linked(homed=False, mode_when="off")
    axis = link.neck.drives[0].axis
    position, shift = axis.getters[(0x6064, 0)], axis._mode_bits
    homed_by: list[int] = []

    def homed(word: int, before: int) -> None:
        shift(word, before)
        if axis.homed:
            homed_by.append(axis.values[(0x607C, 0)])

    axis._mode_bits = homed
    axis.getters[(0x6064, 0)] = lambda: (
        position() + (axis.values[(0x607C, 0)] - homed_by[-1] if axis.homed and homed_by else 0)
    )
    with pytest.raises(CheckFailedError, match="node 1: its position follows 607Ch at once"):
        zero(link, file, lambda: link.newest, guarding=preflight(link, file).guarding)
    assert [drive.axis.state for drive in link.neck.drives] == [DISABLED] * 3


def test_a_drive_that_is_to_stop_is_not_asked_to_change_its_mode() -> None:
    """Also where it is in Operation Enabled already."""
    for goal, asked in ((Goal.ENABLED, 1), (Goal.STOPPED, 0), (Goal.OFF, 0), (Goal.READY, 0)):
        bus = Fieldbus(BusSettings(late_modes=(2,)))
        bus.receive(0.0, [Frame(0x182, b"\x37\x02" + bytes(6))])
        assert bus.drives[1].state is DriveState.ENABLED
        frames = bus.send([goal] * 3, [0] * 3)
        assert [frame.identifier for frame in frames].count(0x602) == asked
        # And once is enough: the answer takes its time.
        assert 0x602 not in [frame.identifier for frame in bus.send([goal] * 3, [0] * 3)]


# -- the master -------------------------------------------------------------------------------------------------------


def test_a_run_waits_for_the_late_mode_and_is_then_like_any_other() -> None:
    begun = []
    for quirks in (DriveQuirks(), DriveQuirks(mode_when="enabled")):
        bench = Bench(quirks=quirks)
        bench.master.start()
        while bench.phase is not Phase.RAMP_IN and bench.now < 2.0:
            bench.step()
        begun.append(bench.now)
        assert [drive.axis.values[(0x6060, 0)] for drive in bench.neck.drives] == [8, 8, 8]
        bench.start()
        assert bench.phase is Phase.RUNNING
    # Each mode is asked for in the cycle in which its drive says that it is enabled, and taken in the next.
    assert begun[1] - begun[0] == pytest.approx(3 * T)


@pytest.mark.parametrize("what", ["lost", "refused"])
def test_a_late_mode_that_is_not_taken_stops_the_run_before_anything_moves(
    what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if what == "refused":
        monkeypatch.setattr("softneck.drives.simulated._quirks._KNOWN_MODES", (1, 3, 6))
    bench = Bench(quirks=DriveQuirks(mode_when="enabled"))
    if what == "lost":
        bench.link.lose = lambda _from_master, frame: 0x580 <= frame.identifier < 0x680
    bench.start()
    fault = bench.master.supervisor.fault
    assert fault is not None
    assert (fault.name, fault.node, fault.detail) == ("enable_timeout", 1, "it is ENABLED and does not take mode 8")
    assert bench.finish().states == [DISABLED] * 3
    assert not bench.pilot.started


@pytest.mark.slow
def test_a_run_with_late_modes_replays(tmp_path: Path) -> None:
    path, file = tmp_path / "j.mcap", replace(default_drives(), ramps=FAST)
    with RunLogger(path, wait=True) as log:
        jog(2, Session(file=file, link=linked(mode_when="enabled"), log=log), amplitude=0.4)
    logged = read_run_log(path)
    assert logged.settings().bus.late_modes == (1, 2, 3)
    replay(logged, jog_pilot(2, 0.4)).require()
    # Had the master believed that they have their mode, it would have done something else.
    plain = replace(logged, facts={**logged.facts, "settings": {**logged.facts["settings"], "bus": {
        **logged.facts["settings"]["bus"], "late_modes": []}}})  # fmt: skip
    assert replay(plain, jog_pilot(2, 0.4)).difference is not None
