"""Every row of the pre-flight and every comparison that guards the drives has the case that it refuses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import CheckFailedError, SettingsError
from softneck.drives import default_drives
from softneck.drives.bus._link import BusError, VirtualLink
from softneck.drives.bus._objects import CSP, GUARDING_OBJECTS, HOMED_MARK, Write
from softneck.drives.bus._sdo import SdoError
from softneck.drives.logs._result import CycleTimes
from softneck.drives.master import Frame, MasterSettings, Phase, Tilt
from softneck.drives.master._cia402 import DriveState
from softneck.drives.master._events import Event
from softneck.drives.master._fieldbus import Fieldbus, NodeState
from softneck.drives.master._gate import Gate
from softneck.drives.master._limiter import Limiter
from softneck.drives.master._master import Master, Measurement
from softneck.drives.master._settings import LimitSettings, WatchSettings
from softneck.drives.master._supervisor import ACTIVE, Signal
from softneck.drives.master._watches import Watches, timing
from softneck.drives.running import _bus_loop, _certified, _deploy, _pilot, _preflight, _stop
from softneck.drives.running._bus_loop import RunEnd, Session
from softneck.drives.running._certified import _as_strict, require_same_again
from softneck.drives.running._pilot import LoopPilot, SignalLog, SignalPilot, raised_cosine
from softneck.drives.running._preflight import PreflightCheck, Report, foreign_master, set_points_of_others
from softneck.drives.running._stop import require_reset, require_stopped
from softneck.drives.running._timing import Ask
from softneck.drives.running._virtual import VirtualRun
from softneck.loop import Loop
from softneck.plant import NeckParameters
from softneck.robot import Robot
from softneck.signals import NECK

from .test_any_robot import Ports

FILE = default_drives()
ENTRY = FILE.drives[0]
NODE = ENTRY.node
# A CiA 402 drive with the cyclic mode, life guarding, a neutral factor group, switched on and ready.
GOOD: dict[tuple[int, int], int] = {
    (0x1000, 0): 0x00020192, (0x1018, 1): 0x2B, (0x1018, 2): 7, (0x1018, 4): 99, (0x6041, 0): 0x0240,
    (0x6502, 0): 0x80, (0x6061, 0): 0, (0x100C, 0): 0, (0x100D, 0): 0, (0x607C, 0): HOMED_MARK,
    **{(index, sub): 1 for index in (0x6093, 0x6094, 0x6097) for sub in (1, 2)},
}  # fmt: skip


class Told:
    """The objects of one drive, without a bus: what is not in the table is aborted, as is a write to `refused`."""

    def __init__(self, changes: Mapping[tuple[int, int], int | None] | None = None, **more: Any) -> None:
        table: dict[tuple[int, int], Any] = {**GOOD, **(changes or {})}
        self.table = {key: value for key, value in table.items() if value is not None}
        self.refused: dict[int, int] = more.get("refused", {})
        self.kept: dict[int, int] = more.get("kept", {})
        self.silent: int | None = more.get("silent")
        self.node, self.untold, self.written = NODE, set[str](), list[tuple[int, int, int]]()

    def read(self, index: int, subindex: int = 0) -> int:
        if index == self.silent:
            raise SdoError("no answer")
        if (index, subindex) not in self.table:
            raise SdoError(f"{index:04X}h is not there", aborted=True, code=0x06020000)
        return self.table[index, subindex]

    def has(self, index: int, subindex: int = 0) -> bool:
        return (index, subindex) in self.table

    def read_text(self, index: int) -> str:
        if index not in (0x1008, 0x100A):
            raise SdoError("no text", aborted=True)
        return "F1"

    def write(self, index: int, subindex: int, value: int) -> None:
        if index == self.silent:
            raise SdoError("no answer")
        if index in self.refused:
            raise SdoError("refused", aborted=True, code=self.refused[index])
        self.written.append((index, subindex, value))

    def write_checked(self, index: int, subindex: int, value: int) -> int:
        self.write(index, subindex, value)
        return self.kept.get(index, value)


def checked(objects: Told, entry: Any = ENTRY, guarding: str = "auto") -> dict[str, PreflightCheck]:
    rows = Report()
    _preflight._check_drive(objects, FILE, entry, guarding, rows)  # pyright: ignore[reportArgumentType]
    return {row.name: row for row in rows.rows}


def test_a_good_drive_passes_every_row_and_all_is_written() -> None:
    objects = Told()
    rows = checked(objects)
    assert set(rows) == {"present", "identity", "firmware", "factor group", "state", "modes", "slow loop", "options",
                         "limits", "guarding", "mapping"}  # fmt: skip
    assert all(row.holds for row in rows.values())
    assert all(not row.advice for row in rows.values())
    assert all(row.node == NODE for row in rows.values())
    assert (0x6060, 0, CSP) in objects.written
    assert {0x607D, 0x6065, 0x100C, 0x100D} <= {index for index, _, _ in objects.written}


@pytest.mark.parametrize("index", [0x6093, 0x6094, 0x6097])
@pytest.mark.parametrize("sub", [1, 2])
def test_each_factor_that_is_not_neutral_is_named(index: int, sub: int) -> None:
    row = checked(Told({(index, sub): 2}))["factor group"]
    assert not row.holds
    pair = "2/1" if sub == 1 else "1/2"
    assert row.found == f"{index:04X}h is {pair}"
    assert "1/1" in row.advice
    # Equal numbers cancel, and an object that a drive lacks scales nothing.
    assert checked(Told({(index, 1): 5, (index, 2): 5}))["factor group"].holds
    assert checked(Told({(index, sub): None}))["factor group"].holds


@pytest.mark.parametrize(
    ("kind", "holds"), [(0x192, True), (0x20192, True), (0x191, False), (0x1920000, False), (0, False)]
)
def test_only_a_drive_is_a_drive(kind: int, holds: bool) -> None:
    assert checked(Told({(0x1000, 0): kind}))["present"].holds is holds


@pytest.mark.parametrize(("field", "sub"), [("vendor", 1), ("product", 2), ("serial", 4)])
def test_each_number_of_the_identity_must_be_the_one_of_the_file(field: str, sub: int) -> None:
    right = GOOD[0x1018, sub]
    for wanted, holds in ((None, True), (right, True), (right + 1, False), (0, False)):
        entry = SimpleNamespace(**{name: getattr(ENTRY, name) for name in ("node", "scale")}, vendor=None, product=None,
                                serial=None, firmware=None)  # fmt: skip
        setattr(entry, field, wanted)
        rows = Report()
        _preflight._check_identity(Told(), entry, rows)  # pyright: ignore[reportArgumentType]
        assert rows.rows[0].holds is holds
        assert (f"{field} {right} instead of {wanted}" in rows.rows[0].found) is not holds
        assert rows.rows[1].holds


@pytest.mark.parametrize(("wanted", "holds"), [(None, True), ("F1", True), ("F2", False)])
def test_the_firmware_must_be_the_one_of_the_file(wanted: str | None, holds: bool) -> None:
    entry: Any = SimpleNamespace(node=NODE, vendor=None, product=None, serial=None, firmware=wanted)
    rows = Report()
    _preflight._check_identity(Told(), entry, rows)  # pyright: ignore[reportArgumentType]
    assert [row.holds for row in rows.rows] == [True, holds]


@pytest.mark.parametrize(
    ("word", "holds", "advice"),
    [(0x0240, True, ""), (0x0221, True, ""), (0x0223, True, ""), (0x0227, False, "drives stop"),
     (0x0207, False, "drives stop"), (0x0208, False, "drives reset"), (0x020F, False, "drives stop")],
)  # fmt: skip
def test_a_drive_with_power_or_a_fault_is_not_taken(word: int, holds: bool, advice: str) -> None:
    row = checked(Told({(0x6041, 0): word}))["state"]
    assert row.holds is holds
    assert advice in row.advice


@pytest.mark.parametrize(
    ("modes", "code", "now", "kept", "holds", "late"),
    [
        (0x80, None, 0, CSP, True, False), (0x001F0065, None, 0, CSP, True, False), (0x7F, None, 0, CSP, False, False),
        (0, None, 0, CSP, False, False), (0x80, None, 0, 3, False, False),
        # A drive that has the mode may refuse it while it is off, if until then it holds its motor.
        (0x80, 0x08000022, 0, CSP, True, True), (0x80, 0x08000020, 1, CSP, True, True),
        (0x80, 0x08000021, 8, CSP, True, True), (0x80, 0x08000000, 6, CSP, True, True),
        (0x80, 0x08000022, 3, CSP, True, True), (0x80, 0x08000022, 4, CSP, False, True),
        (0x80, 0x08000022, -1, CSP, False, True), (0x80, 0x06090030, 0, CSP, False, False),
        (0x7F, 0x08000022, 0, CSP, False, False),
    ],
)  # fmt: skip
def test_the_cyclic_mode_is_needed(modes: int, code: int | None, now: int, kept: int, holds: bool, late: bool) -> None:
    objects = Told({(0x6502, 0): modes, (0x6061, 0): now}, refused={} if code is None else {0x6060: code},
                   kept={0x6060: kept})  # fmt: skip
    rows = Report()
    _preflight._check_modes(objects, NODE, rows)  # pyright: ignore[reportArgumentType]
    assert rows.rows[0].holds is holds
    assert rows.late_modes == [NODE] * late
    # Until it takes the mode, a speed is none.
    assert ((0x60FF, 0, 0) in objects.written) is (late and now in (0, 1, 3, 6, 8))


def test_a_drive_that_falls_silent_is_no_refusal() -> None:
    for silent in (0x6060, 0x6502, 0x1000, 0x6041):
        with pytest.raises(SdoError, match="no answer"):
            checked(Told(silent=silent))


@pytest.mark.parametrize(
    ("lacks", "wanted", "kind"),
    [((0x1016, 0x1017), "auto", "life"), ((0x100C,), "auto", "heartbeat"), ((), "auto", "heartbeat"),
     ((), "life", "life"), ((0x100D,), "life", ""), ((0x1017,), "heartbeat", ""), ((0x1016, 0x100C), "auto", ""),
     ((0x100D,), "heartbeat", "heartbeat")],
)  # fmt: skip
def test_a_drive_must_be_able_to_notice_that_its_master_is_gone(lacks: tuple[int, ...], wanted: str, kind: str) -> None:
    objects = Told({(index, sub): None if index in lacks else 0 for index, sub in GUARDING_OBJECTS})
    rows = Report()
    found, has = _preflight._guarding(objects, wanted, rows)  # pyright: ignore[reportArgumentType]
    assert found == kind
    assert has == {index for index, _ in GUARDING_OBJECTS} - set(lacks)
    assert [row.holds for row in rows.rows] == ([] if kind else [False])
    if not kind:
        assert all(f"{index:04X}h" in rows.rows[0].found for index in lacks)
        assert "limits" not in checked(objects, guarding=wanted)


@pytest.mark.parametrize("index", [0x607D, 0x6065, 0x100C, 0x605E, 0x1A00])
def test_a_value_that_is_refused_or_not_kept_fails_its_topic(index: int) -> None:
    for objects in (Told(refused={index: 0x06090030}), Told(kept={index: 0x55})):
        failed = [row for row in checked(objects).values() if not row.holds]
        assert len(failed) == 1
        assert failed[0].name in ("limits", "guarding", "options", "mapping")
        assert failed[0].advice
    with pytest.raises(SdoError):
        checked(Told(silent=index))


def test_a_negative_number_that_reads_back_as_its_bits_is_kept() -> None:
    rows = Report()
    flipped = [(0xFFFFFFFE ^ 1 << bit, False) for bit in range(32)]
    for found, holds in ((0xFFFFFFFE, True), (-2, True), (2, False), (-1, False), *flipped):
        write: Any = Write(0x607D, 1, -2)
        _preflight._apply(Told(kept={0x607D: found}), "limits", [write], rows)  # pyright: ignore[reportArgumentType]
        assert rows.rows[-1].holds is holds


def test_a_drive_that_takes_its_mode_later_is_not_asked_for_it_again() -> None:
    """All other objects of its mode are written all the same."""
    objects = Told(refused={0x6060: 0x08000022})
    rows = checked(objects)
    assert all(row.holds for row in rows.values())
    assert {0x60C2, 0x60FF, 0x607D, 0x100C} <= {index for index, _, _ in objects.written}


class Wire:
    """A link of a pre-flight: frames go out, and nothing comes by itself."""

    def __init__(self, problem: str = "") -> None:
        self.now, self.problem, self.sent = 0.0, problem, list[Frame]()

    def send(self, frames: Any) -> None:
        self.sent += frames

    def receive(self, timeout: float) -> list[Frame]:
        self.now += timeout
        return []


def preflown(
    monkeypatch: pytest.MonkeyPatch, changes: dict[int, Told] | None = None,
    serials: dict[int, list[int]] | None = None,     **how: Any,
) -> tuple[Report, Wire, dict[int, Told]]:  # fmt: skip
    """Return the report on three good drives but for `changes`, by node."""
    drives = {node: (changes or {}).get(node) or Told() for node in FILE.nodes}
    for node, drive in drives.items():
        drive.node = node
    found = {node: [node] for node in FILE.nodes} | (serials or {})
    monkeypatch.setattr(_preflight, "listen", lambda *_: "")
    monkeypatch.setattr(_preflight, "devices_at", lambda *_: found)
    monkeypatch.setattr(_preflight, "Objects", lambda _, node: drives[node])
    wire = Wire(how.pop("problem", ""))
    return _preflight.preflight(wire, how.pop("file", FILE), **how), wire, drives


def told_of(report: Report, name: str) -> dict[int, bool]:
    return {row.node: row.holds for row in report.rows if row.name == name}


def test_each_drive_is_silenced_and_checked_and_what_fails_at_one_hides_no_other(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    report, wire, _ = preflown(monkeypatch, override=("homed",))
    assert (report.holds, report.guarding, report.overridden) == (True, "life", ("homed",))
    assert told_of(report, "node number") == dict.fromkeys(FILE.nodes, True)
    assert told_of(report, "second master") == {0: True}
    assert told_of(report, "mapping") == dict.fromkeys(FILE.nodes, True)
    assert "homed" not in {row.name for row in report.rows}
    # Pre-operational to each (CiA 301, 7.2.8.2.1.3).
    assert wire.sent == [Frame(0x000, bytes([0x80, node])) for node in FILE.nodes]
    for silent in FILE.nodes:
        for drive, row in ((Told(silent=0x1000), "present"), (Told({(0x1000, 0): None}), "objects")):
            report, _, _ = preflown(monkeypatch, {silent: drive})
            assert [(item.node, item.name) for item in report.rows if not item.holds] == [(silent, row)]
            assert all(told_of(report, "mapping").get(node) for node in FILE.nodes if node != silent)
    with pytest.raises(BusError, match="the bus takes no frames: off"):
        preflown(monkeypatch, problem="off.")


def test_two_devices_with_one_number_end_the_pre_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    report, _, drives = preflown(monkeypatch, serials={2: [5, 6]})
    assert told_of(report, "node number") == {node: node != 2 for node in FILE.nodes}
    assert all(not drive.written for drive in drives.values())
    assert {row.name for row in report.rows} == {"second master", "node number"}


def test_all_drives_are_guarded_as_the_first_can_be(monkeypatch: pytest.MonkeyPatch) -> None:
    first, *others = FILE.nodes
    both = dict.fromkeys(GUARDING_OBJECTS, 0)
    by_heartbeat = {key: None if key[0] in (0x100C, 0x100D) else 0 for key in GUARDING_OBJECTS}
    report, _, drives = preflown(monkeypatch, {first: Told(by_heartbeat), **{node: Told(both) for node in others}})
    assert (report.holds, report.guarding) == (True, "heartbeat")
    assert all((0x1017, 0) in {item[:2] for item in drive.written} for drive in drives.values())
    # One that can do the other kind alone is refused.
    report, _, _ = preflown(monkeypatch, {first: Told(both)})
    assert told_of(report, "guarding") == {first: True, **dict.fromkeys(others, False)}
    # Where the first has none, the next decides.
    none = dict.fromkeys(GUARDING_OBJECTS, None)
    report, _, _ = preflown(monkeypatch, {first: Told(none)})
    assert report.guarding == "life"
    assert told_of(report, "guarding") == {node: node != first for node in FILE.nodes}


@pytest.mark.parametrize("mark", [HOMED_MARK, HOMED_MARK + 1, 0, -HOMED_MARK])
def test_a_zero_is_known_by_its_mark_alone(mark: int, monkeypatch: pytest.MonkeyPatch) -> None:
    report, _, _ = preflown(monkeypatch, {2: Told({(0x607C, 0): mark})}, homed=True)
    assert told_of(report, "homed") == {node: node != 2 or mark == HOMED_MARK for node in FILE.nodes}
    assert {row.found for row in report.rows if row.name == "homed" and not row.holds} <= {"no"}


@pytest.mark.parametrize(("kind", "node"), [("can", 77), ("serial", 0)])
def test_a_sensor_on_the_bus_is_started_and_told_by_its_number(
    kind: str, node: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(_preflight, "look_at", lambda *args: seen.append(args) or Tilt(0.1, -0.2))
    file, sensor = replace(FILE, sensor_kind=kind, sensor_node=77), SimpleNamespace(problem="it smokes")
    report, wire, _ = preflown(monkeypatch, file=file, sensor=sensor)
    assert [(row.node, row.holds, row.found) for row in report.rows if row.name == "inclinometer"] == [
        (node, True, "pitch 5.73, roll -11.46 deg")
    ]
    # Operational (CiA 301, 7.2.8.2.1.1), and two seconds to say something.
    assert (wire.sent[len(FILE.nodes) :] == [Frame(0x000, bytes([0x01, 77]))]) is (kind == "can")
    assert seen == [(sensor, wire, _preflight.LOOK)]
    monkeypatch.setattr(_preflight, "look_at", lambda *_: None)
    report, _, _ = preflown(monkeypatch, file=file, sensor=sensor)
    assert [row.advice for row in report.rows if row.name == "inclinometer"] == ["it smokes"]
    report, _, _ = preflown(monkeypatch, file=file, sensor=SimpleNamespace(problem=""))
    advice = "`node` of [sensor]" if kind == "can" else "plugged in"
    assert all(advice in row.advice for row in report.rows if row.name == "inclinometer")


# -- the report -------------------------------------------------------------------------------------------------------


def test_what_is_known_of_the_robot_is_told_and_that_nothing_watches_unknown_directions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(_preflight, "limits_said", lambda *_: ("a", "b"))
    for weights, watched in ((((1.0, -1.0),), True), ((), False)):
        file: Any = SimpleNamespace(moves=_cart(), limits=None, nodes=(4, 7), weights=weights, load=0.314, bit_rate=5e5)
        rows = Report()
        _preflight._tell_robot(file, rows)
        told = [(row.node, row.name, row.found) for row in rows.rows]
        assert told == [
            (0, "robot", _cart().label()), (4, "set-points", "a"), (7, "set-points", "b"),
            *([] if watched else [(0, "diverged", "not watched: the robot's directions are to be identified")]),
            (0, "bus load", "31 % of 500000 bit/s at worst"),
        ]  # fmt: skip
        assert rows.holds


def test_one_row_that_fails_refuses_unless_it_is_let_pass_by_name() -> None:
    rows = Report(("firmware",))
    rows.add(1, "present", "x", True, "advice")
    rows.require()
    assert rows.holds
    rows.add(2, "firmware", "old", False, "update")
    assert rows.holds
    rows.require()
    rows.add(3, "state", "FAULT", False, "reset.")
    rows.add(0, "second master", "a SYNC", False, "stop.")
    assert not rows.holds
    with pytest.raises(CheckFailedError, match=r"^node 3: state: FAULT\. reset\. \(2 checks failed in all\) Nothing"):
        rows.require()
    assert rows.table()["holds"] is False
    assert [row["advice"] for row in rows.table()["rows"]] == ["", "update", "reset.", "stop."]


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        (Frame(0x000, b"\1\1"), "an NMT command"), (Frame(0x080, b""), "a SYNC"), (Frame(0x600, b""), ""),
        (Frame(0x601, b""), "an SDO request to node 1"), (Frame(0x67F, b""), "an SDO request to node 127"),
        (Frame(0x680, b""), ""), (Frame(0x701, b"", remote=True), "a guarding request to node 1"),
        (Frame(0x77F, b"", remote=True), "a guarding request to node 127"), (Frame(0x701, b"\5"), ""),
        (Frame(0x77F, b"\5"), "a master's heartbeat"), (Frame(0x081, bytes(8)), ""), (Frame(0x581, bytes(8)), ""),
        (Frame(0x080, b"", error=True), ""),
    ],
)  # fmt: skip
def test_a_frame_that_only_a_master_sends_is_told(frame: Frame, told: str) -> None:
    assert foreign_master([Frame(0x181, bytes(8)), frame]) == told


def test_another_master_is_named_and_nothing_else_is_asked_of_the_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_preflight, "listen", lambda *_: "a SYNC")
    link: Any = SimpleNamespace()  # it can send nothing
    (row,) = _preflight.preflight(link, FILE).table()["rows"]
    assert (row["check"], row["found"], row["holds"]) == ("second master", "a SYNC", False)


def test_set_points_of_others_are_those_to_our_nodes() -> None:
    assert set_points_of_others([Frame(0x203, bytes(6))], [1, 2, 3]) == "set-points to node 3"
    for frame in (Frame(0x204, bytes(6)), Frame(0x303, bytes(6)), Frame(0x203, bytes(6), error=True)):
        assert set_points_of_others([frame], [1, 2, 3]) == ""


@pytest.mark.parametrize(
    ("tilt", "holds"),
    [(None, False), (Tilt(0.1, -0.2), True), (Tilt(0.1, -0.2, valid=False), False), (Tilt(math.nan, 0.0), False),
     (Tilt(0.0, math.nan), False), (Tilt(math.inf, 0.0), False), (Tilt(FILE.sensor_angle, 0.0), True),
     (Tilt(0.0, -FILE.sensor_angle), True), (Tilt(0.0, FILE.sensor_angle * 1.001), False),
     (Tilt(-FILE.sensor_angle * 1.001, 0.0), False)],
)  # fmt: skip
def test_a_sensor_must_give_an_angle_that_the_neck_can_have(
    tilt: Tilt | None, holds: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_preflight, "look_at", lambda *_: tilt)
    rows, link = Report(), SimpleNamespace(send=lambda _: None)
    _preflight._check_sensor(link, FILE, SimpleNamespace(), rows)  # pyright: ignore[reportArgumentType]
    assert [row.holds for row in rows.rows] == [holds]
    assert bool(rows.rows[0].advice) is not holds


def test_a_drive_that_may_have_power_is_not_stopped_and_one_in_fault_not_reset() -> None:
    require_stopped({1: "DISABLED", 2: "READY", 3: "FAULT", 4: "SWITCHED_ON"})
    for state in ("ENABLED", "QUICK_STOP", "REACTION", "no answer", "UNKNOWN"):
        with pytest.raises(CheckFailedError, match=f"node 2: {state}"):
            require_stopped({1: "DISABLED", 2: state})
    require_reset({1: "DISABLED", 2: "READY"})
    for state in ("FAULT", "no answer"):
        with pytest.raises(CheckFailedError, match=f"node 2: {state}"):
            require_reset({1: "DISABLED", 2: state})


def test_stop_and_reset_write_the_control_word_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """CiA 402: 6040h has no subindex; a rising edge of bit 7 resets a fault."""
    drives = {entry.node: Told({(0x6041, 0): 0x0250}) for entry in FILE.drives}
    sent: list[Frame] = []
    link = SimpleNamespace(now=0.0, send=sent.extend)
    link.receive = lambda seconds: setattr(link, "now", link.now + seconds)
    monkeypatch.setattr(_stop, "Objects", lambda _, node: drives[node])
    monkeypatch.setattr(_stop, "require_alone", lambda _: None)
    monkeypatch.setattr(_stop, "require_bus", lambda _: None)
    off = dict.fromkeys(drives, "DISABLED")
    assert _stop.reset(link, FILE) == off  # pyright: ignore[reportArgumentType]
    assert [drive.written for drive in drives.values()] == [[(0x6040, 0, word) for word in (0, 0x80, 0)]] * len(drives)
    assert not sent
    # 20 ms after each word.
    assert link.now == pytest.approx(len(drives) * 3 * 0.02)
    link.now = 0.0
    assert _stop.stop(link, FILE) == off  # pyright: ignore[reportArgumentType]
    assert all(drive.written[3:] == [(0x6040, 0, 0)] for drive in drives.values())
    # An expedited download of two bytes: quick stop, twice to each.
    told = bytes([0x2B, 0x40, 0x60, 0, 0x02, 0, 0, 0])
    assert sent == 2 * [Frame(0x600 + node, told) for node in drives]
    # A quick stop has half a second before the voltage goes.
    assert link.now == pytest.approx(0.5)


def test_a_drive_without_an_answer_is_none_that_is_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """At a stop, at a reset and when its guarding is ended; the others are spoken to all the same."""
    drives = {entry.node: Told({(0x6041, 0): 0x0250, (0x6040, 0): 0}) for entry in FILE.drives}
    link = SimpleNamespace(now=0.0, send=lambda _: None)
    link.receive = lambda seconds: setattr(link, "now", link.now + seconds)
    for name in ("require_alone", "require_bus"):
        monkeypatch.setattr(_stop, name, lambda _: None)
    monkeypatch.setattr(_stop, "Objects", lambda _, node: drives[node])
    monkeypatch.setattr(_stop, "GuardedLink", lambda *args: guarded.append(args) or link)
    guarded: list[Any] = []
    link_: Any = link
    for silent, drive in drives.items():
        drive.silent = 0x6040
        expected = {node: "no answer" if node == silent else "DISABLED" for node in drives}
        assert _stop.stop(link_, FILE) == _stop.reset(link_, FILE) == expected
        drive.silent = 0x6041
        assert _stop.stop(link_, FILE) == _stop.reset(link_, FILE) == expected
        assert _stop.disarm(link_, FILE, "life", ()) == {silent: "no answer"}
        drive.silent = 0x100C
        assert _stop.disarm(link_, FILE, "life", ()) == {silent: "no answer"}
        drive.silent = None
        assert _stop.disarm(link_, FILE, "life", ()) == {}
        for word, state in ((0x0227, "ENABLED"), (0x0208, "FAULT"), (0x0207, "QUICK_STOP"), (0x020F, "REACTION"),
                            (0x0225, "UNKNOWN"), (0x0200, ""), (0x0221, ""), (0x0233, "")):  # fmt: skip
            drive.table[0x6041, 0] = word
            assert _stop.disarm(link_, FILE, "life", ()) == ({silent: f"it is in {state}"} if state else {})
        drive.table[0x6041, 0] = 0x0250
    assert {args[2] for args in guarded} == {FILE.guard_cycles * FILE.cycle}


def test_a_wait_takes_its_time_however_the_frames_come() -> None:
    for chunk in (0.03, 1.0, 0.1):
        link = SimpleNamespace(now=2.0)
        link.receive = lambda seconds, link=link, chunk=chunk: setattr(link, "now", link.now + min(seconds, chunk))
        _stop.wait(link, 0.1)  # pyright: ignore[reportArgumentType]
        assert link.now == pytest.approx(2.1)


def test_a_sample_is_logged_once_with_the_set_points_that_were_sent_to_its_end() -> None:
    """A set-point that a limit moves within a sample is complete with the last cycle of it."""
    logged: list[dict[str, float]] = []
    told = SimpleNamespace(
        file=SimpleNamespace(moves=NECK), log=SimpleNamespace(signals=logged.append), folder=None, link=None
    )
    log = SignalLog(3, session=told)  # pyright: ignore[reportArgumentType]
    master = SimpleNamespace(
        positions=(0.0,) * 3, tensions=(0.0,) * 3, tilt=None, supervisor=SimpleNamespace(phase=Phase.RUNNING),
        settings=SimpleNamespace(sample_cycles=4),
    )  # fmt: skip
    for cycle in range(10):
        master.index, master.setpoints = cycle // 4, (0.1 * cycle,) * 3
        log(0.005 * cycle, (), (), None, master)  # pyright: ignore[reportArgumentType]
    assert [row["motor_setpoint_1"] for row in logged] == [0.1 * 3, 0.1 * 7]
    assert log.rows == 2
    # Each with the number of its run; alone it is the first.
    assert [row["run"] for row in logged] == [1.0, 1.0]
    logged.clear()
    numbered = SignalLog(3, run=np.array([4, 5, 6]), session=told)  # pyright: ignore[reportArgumentType]
    for cycle in range(12):
        master.index = cycle // 4
        numbered(0.005 * cycle, (), (), None, master)  # pyright: ignore[reportArgumentType]
    assert [row["run"] for row in logged] == [4.0, 5.0, 6.0]


def test_rows_are_kept_in_the_folder_of_the_session_and_without_one_where_temporary_files_are(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    places: list[Path | None] = []
    monkeypatch.setattr(_pilot, "Rows", lambda _columns, _motors, folder: places.append(folder))
    told: Any = SimpleNamespace(file=SimpleNamespace(moves=NECK), log=None, folder=tmp_path, link=None)
    SignalLog(3)
    SignalLog(3, session=told)
    assert places == [None, tmp_path]


# -- certificates -----------------------------------------------------------------------------------------------------


def _again(monkeypatch: pytest.MonkeyPatch, trace: dict[str, list[Any]], signals: dict[str, Any]) -> float:
    time = np.arange(4) * 0.02

    class Result(dict):
        sample_time = 0.02

        def angle(self, name: str) -> Any:
            return self[name]

    found = Result({name: np.array(values, float) for name, values in signals.items()})
    found.time = time  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setattr(_certified, "_run_for", lambda *_: found)
    robot = SimpleNamespace(own=lambda name: name, outputs=SimpleNamespace(names=("pitch",)))
    certificate: Any = SimpleNamespace(path="c.json", contents={"trace": trace})
    return require_same_again(SimpleNamespace(robot=robot), certificate)  # pyright: ignore[reportArgumentType]


def test_a_run_again_is_the_certified_one_row_by_row(monkeypatch: pytest.MonkeyPatch) -> None:
    trace = {"row": [0, 2, 3], "pitch": [0.0, None, 0.3], "motor_setpoint_1": [1.0, 2.0, 3.0]}
    same = {"pitch": [0.0, 9.0, math.nan, 0.3], "motor_setpoint_1": [1.0, 9.0, 2.0, 3.0]}
    assert _again(monkeypatch, trace, same) == pytest.approx(0.08)
    nearly = {**same, "motor_setpoint_1": [1.0 + 0.99e-4, 9.0, 2.0 - 0.99e-4, 3.0]}
    _again(monkeypatch, trace, nearly)
    for name, row, value in (
        ("motor_setpoint_1", 0, 1.0 + 1.01e-4), ("motor_setpoint_1", 2, 2.0 - 1.01e-4), ("pitch", 3, 0.31),
        ("motor_setpoint_1", 3, math.nan), ("pitch", 0, math.nan), ("pitch", 0, math.inf), ("pitch", 2, 0.0),
    ):  # fmt: skip
        other = {key: list(values) for key, values in same.items()}
        other[name][row] = value
        with pytest.raises(CheckFailedError, match=rf"`{name}` is .* at t = {0.02 * row:.2f} s"):
            _again(monkeypatch, trace, other)
    for certified in (math.nan, None, math.inf):
        with pytest.raises(CheckFailedError, match="`pitch` is"):
            _again(monkeypatch, {**trace, "pitch": [certified, None, 0.3]}, same)
    # Rows that the time was not enough for are not compared; no rows at all certify nothing.
    _again(monkeypatch, {**trace, "row": [0, 2, 7]}, same)
    for nothing in ({}, {"row": []}, None):
        with pytest.raises(CheckFailedError, match="keeps no rows"):
            _again(monkeypatch, nothing, same)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("bound", ["min", "max"])
def test_a_requirement_is_as_strict_up_to_the_default_itself(bound: str) -> None:
    stricter, looser = (2.1, 1.9) if bound == "min" else (1.9, 2.1)
    row = {"bound": bound, "limit": 2.0, "holds": True}
    assert _as_strict(row, bound, 2.0)
    assert _as_strict(row | {"limit": stricter}, bound, 2.0)
    for change in ({"limit": looser}, {"limit": math.nan}, {"limit": None}, {"limit": "2"}, {"holds": False},
                   {"holds": None}, {"bound": "max" if bound == "min" else "min"}):  # fmt: skip
        assert not _as_strict(row | change, bound, 2.0)
    assert not _as_strict(row, bound, math.nan)
    assert _as_strict(row | {"bound": "below"}, bound, 2.0) is (bound == "max")


def _cart() -> Robot:
    return Robot.from_dict({
        "name": "cart", "time_constant_s": 2.0, "directions": {"kind": "matrix", "matrix": [[1.0]]},
        "motors": {"names": ["drive"], "unit": "V", "nominal": 3.0},
        "outputs": {"names": ["place"], "unit": "mm", "nominal": 4.0},
    })  # fmt: skip


def test_a_certificate_of_another_robot_is_refused() -> None:
    def of(contents: dict[str, Any]) -> Any:
        return SimpleNamespace(path="c.json", contents=contents)

    _certified._require_robot(of({}), NECK)
    _certified._require_robot(of({"robot": {"hash": NECK.hash}}), NECK)
    for robot in ({"hash": "0" * 64}, {"hash": None}, {}):
        with pytest.raises(CheckFailedError, match="is of the robot with the hash"):
            _certified._require_robot(of({"robot": robot}), NECK)


@pytest.mark.parametrize("other", [None, "verify", "simulate"])
def test_both_certificates_must_be_of_the_robot_that_the_drives_move(
    other: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    nearly = NECK.hash[:-1] + ("1" if NECK.hash[-1] == "0" else "0")

    def covering(kind: str, *_: Any) -> Any:
        contents: dict[str, Any] = {"duration_s": 5.0, "robot": {"hash": nearly if kind == other else NECK.hash}}
        return SimpleNamespace(path=f"{kind}.json", contents=contents)

    monkeypatch.setattr(_certified, "_covering", covering)
    monkeypatch.setattr(_certified, "_require_minimum", lambda *_: None)
    loop = SimpleNamespace(duration=5.0, controller=SimpleNamespace(sample_time=0.02))
    setup: Any = SimpleNamespace(files={}, loop=loop)
    with pytest.raises(CheckFailedError, match=f"{other}.json: is of the robot") if other else nullcontext():
        found = _certified.require_certified(setup, Path("c.npz"))
        assert found is not None
        assert [item.path for item in found] == ["verify.json", "simulate.json"]


def test_all_that_acts_in_a_run_is_covered_and_the_plant_is_hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    covered: dict[str, list[Path]] = {}

    def covering(kind: str, given: Any, item: Path, files: list[Path]) -> Any:
        del given, item
        covered[kind] = files
        return SimpleNamespace(path=kind, contents={"duration_s": 5.0, "robot": {"hash": NECK.hash}})

    monkeypatch.setattr(_certified, "_covering", covering)
    monkeypatch.setattr(_certified, "_require_minimum", lambda *_: None)
    roles = ("loop", "plant", "controller", "observer", "filter", "reference", "drives")
    files = {role: (f"{role}.file", "") for role in roles}
    loop = SimpleNamespace(duration=5.0, controller=SimpleNamespace(sample_time=0.02))
    setup: Any = SimpleNamespace(files=files, loop=loop)
    own, drives = Path("mine.npz"), Path("lab/drives.toml")
    others = {Path(f"{role}.file") for role in roles if role not in ("plant", "controller")}
    for given in (None, drives):
        _certified.require_certified(setup, own, drives=given)
        assert covered["verify"] == [own]
        assert set(covered["simulate"]) == {own, *others} | ({given} if given else set())


def test_arming_asks_for_the_limits_that_verify_stretched_to_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """The scale in the certificate counts, 1 where it says none; a metric that the robot has not is not asked for."""
    asked: list[Any] = []
    monkeypatch.setattr(
        _certified, "_why_not_shown", lambda _, metric, defaults: asked.append((metric, defaults)) or ""
    )

    def limits(robot: Robot, **contents: Any) -> dict[str, float]:
        asked.clear()
        _certified._require_minimum(SimpleNamespace(path="c", contents=contents, rows=[]), robot)  # pyright: ignore[reportArgumentType]
        return {metric: defaults[metric].limit for metric, defaults in asked}

    plain = limits(NECK)
    assert set(plain) == set(_certified.ARMING)
    for scale, time, size in (({}, 1.0, 1.0), ({"time": 3.0}, 3.0, 1.0), ({"size": 5.0}, 1.0, 5.0)):
        found = limits(NECK, scale=scale)
        assert found["axes.delay_margin_ms"] == pytest.approx(time * plain["axes.delay_margin_ms"])
        assert found["step.load_rms_deg"] == pytest.approx(size * plain["step.load_rms_deg"])
        assert found["axes.gain_margin"] == plain["axes.gain_margin"]
    cart = _cart()
    assert set(limits(cart)) == {metric.replace("_deg", "_mm") for metric in plain} - {"sim.slack_s"}


def test_draws_must_stand_for_nine_of_ten_plants(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_certified, "_why_not_shown", lambda *_: "")
    for content, enough in ((0.9, True), (0.95, True), (math.nextafter(0.9, 0.0), False), (math.nan, False)):
        found: Any = SimpleNamespace(path="c", contents={"draws": [
            {"failed": [], "content": 0.99}, {"failed": [], "content": content}]}, rows=[])  # fmt: skip
        if enough:
            _certified._require_minimum(found, NECK)
            continue
        with pytest.raises(CheckFailedError, match=r"its draws stand for .* at least 90 % are needed"):
            _certified._require_minimum(found, NECK)


def test_a_run_again_takes_its_first_row_and_then_as_many_as_there_is_time_for(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, steps = [100.0], list[int]()

    class Run:
        def __init__(self, length: Any) -> None:
            self.length = length
            steps.clear()

        def __enter__(self) -> Run:
            return self

        def __exit__(self, *_: object) -> None: ...

        def advance(self, rows: int) -> bool:
            # Compilation takes long, and does not count.
            clock[0] += 0.5 * rows if steps else 60.0
            steps.append(rows)
            return sum(steps) >= self.length

        def result(self) -> int:
            return sum(steps)

    monkeypatch.setattr(_certified, "LoopRun", Run)
    monkeypatch.setattr(_certified.time, "perf_counter", lambda: clock[0])
    for length, seconds, expected in (
        (1000, 12.0, [1, 10, 10, 10]),
        (1, 12.0, [1]),
        (1000, 0.0, [1]),
        (11, 12.0, [1, 10]),
    ):
        assert _certified._run_for(length, seconds) == sum(expected)  # pyright: ignore
        assert steps == expected


# -- the loop on the bus ----------------------------------------------------------------------------------------------


class Led:
    """A master that counts what it is told."""

    def __init__(self, cycles: int = 3) -> None:
        self.settings: Any = SimpleNamespace(bus=SimpleNamespace(cycle=0.02))
        self.told, self.cycles, self.events = list[Any](), cycles, list[Any]()
        self.counts = dict.fromkeys(("left", "operator", "not_off", "loop_failed"), 0)
        self.supervisor: Any = SimpleNamespace(fault=None, rehome=False, revoke=self.told.append)
        self.starved, self.tensions, self.cycle = False, (1.0, 2.0, 3.0), 7
        self.bus: Any = SimpleNamespace(signs_of_life=lambda: ("sign",))

    def stop(self, why: str) -> None:
        self.told.append(("stop", why))

    def leave(self, why: str) -> None:
        self.told.append(("leave", why))

    @property
    def finished(self) -> bool:
        return self.cycles == 0

    @property
    def sample_due(self) -> bool:
        return self.cycles % 2 == 1

    def step(self, now: float, frames: Any, tilt: Any) -> list[Any]:
        self.cycles -= 1
        self.told.append((round(now, 6), frames, tilt))
        return [self.cycles]


def test_an_operator_stops_or_leaves_or_neither() -> None:
    for ask, told in ((Ask.STOP, [("stop", "asked to")]), (Ask.LEAVE, [("leave", "asked to")]), (None, [])):
        master: Any = Led()
        _bus_loop._ask(master, ask)
        assert master.told == told


@pytest.mark.parametrize(
    ("states", "off"),
    [({1: "DISABLED", 2: "DISABLED"}, True), ({1: "DISABLED", 2: "ENABLED"}, False),
     ({1: "ENABLED", 2: "DISABLED"}, False),
     ({1: "no answer", 2: "DISABLED"}, False), (OSError("gone"), False)],
    ids=str,
)  # fmt: skip
def test_after_an_error_the_drives_are_fed_only_if_all_are_off(
    states: Any, off: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(link: Any, file: Any) -> dict[int, str]:
        assert (link, file) == ("guarded", FILE)
        if isinstance(states, Exception):
            raise states
        return states

    monkeypatch.setattr(_bus_loop, "stop", stop)
    given: list[Any] = []
    monkeypatch.setattr(_bus_loop, "GuardedLink", lambda *args: given.append(args) or "guarded")
    link: Any = object()
    assert _bus_loop._emergency_stop(link, FILE, Led()) is off  # pyright: ignore[reportArgumentType]
    assert given == [(link, ("sign",), FILE.guard_cycles * FILE.cycle)]


@pytest.mark.parametrize("faulted", [False, True])
@pytest.mark.parametrize("left", [{}, {2: "it is in ENABLED"}, OSError("gone")], ids=str)
def test_a_drive_that_is_not_off_ends_a_run_that_looked_done(
    left: Any, faulted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def disarm(link: Any, file: Any, guarding: str, signs: Any) -> dict[int, str]:
        assert (guarding, signs) == ("life", ("sign",))
        if isinstance(left, Exception):
            raise left
        return left

    monkeypatch.setattr(_bus_loop, "disarm", disarm)
    master: Any = Led()
    master.supervisor.fault = "earlier" if faulted else None
    found = _bus_loop._switch_off(SimpleNamespace(now=3.0), FILE, "life", master, ("sign",))  # pyright: ignore[reportArgumentType]
    assert found is (left if isinstance(left, Exception) else None)
    named = [] if faulted else list(FILE.nodes) if isinstance(left, Exception) else list(left)
    assert [(event.name, event.node, event.time) for event in master.events] == [
        ("not_off", node, 3.0) for node in named
    ]
    assert master.told == master.events
    assert master.counts["not_off"] == len(named)


def test_the_end_of_a_run_says_who_ended_it_and_raises_what_did() -> None:
    for counts, left in (((0, 0), False), ((1, 0), True), ((0, 1), True), ((1, 1), True)):
        master: Any = Led()
        master.counts.update(zip(("left", "operator"), counts, strict=True))
        end = RunEnd(master, CycleTimes(0.02), 1.0)
        assert end.left is left
        end.require()
    with pytest.raises(OSError, match="gone"):
        RunEnd(master, CycleTimes(0.02), 1.0, error=OSError("gone")).require()


def test_in_real_time_each_cycle_reads_asks_steps_sends_and_keeps_its_pace(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [10.0]
    monkeypatch.setattr(_bus_loop.time, "sleep", lambda rest: clock.__setitem__(0, clock[0] + rest))

    class Line:
        def __init__(self) -> None:
            self.sent = list[Any]()

        @property
        def now(self) -> float:
            return clock[0]

        def receive(self, seconds: float) -> list[str]:
            assert seconds == 0.0
            return ["frame"]

        def send(self, frames: Any) -> None:
            self.sent.append(frames)
            # The third cycle stalls for four periods.
            clock[0] += 0.09 if len(self.sent) == 3 else 0.004

    seen: list[Any] = []
    sensor = SimpleNamespace(read=lambda _, frames: ("tilt", frames), take=lambda frames: seen.append(("take", frames)))
    master: Any = Led(6)
    session: Any = SimpleNamespace(sensor=sensor, operator=lambda: None if master.cycles else Ask.STOP,
                                   watches=(lambda *args: seen.append(("watch", args[2], args[3])),))  # fmt: skip
    times, cycles = CycleTimes(0.02), list[float]()
    notifier: Any = SimpleNamespace(cycle=lambda now, _: cycles.append(round(now, 6)))
    line: Any = Line()
    _bus_loop._in_real_time(session, line, master, times, notifier)
    tilt = ("tilt", ["frame"])
    # After the stall the next comes at once, another half a period later: the lost ones are not made up for.
    assert master.told == [
        (10.0, ["frame"], None), (10.02, ["frame"], tilt), (10.04, ["frame"], None), (10.13, ["frame"], tilt),
        (10.14, ["frame"], None), (10.16, ["frame"], tilt),
    ]  # fmt: skip
    assert cycles == [now for now, _, _ in master.told]
    assert line.sent == [[k] for k in (5, 4, 3, 2, 1, 0)]
    assert seen[:3] == [("take", ["frame"]), ("watch", [5], None), ("watch", [4], tilt)]
    assert (times.count, times.longest_step, times.longest_period) == pytest.approx((5, 0.09, 0.09))


def test_the_keyboard_is_the_operator_where_none_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    opened, ran = list[str](), list[Any]()

    class Keys:
        def __enter__(self) -> Keys:
            opened.append("keyboard")
            return self

        def __exit__(self, *_: object) -> None:
            opened.append("closed")

    monkeypatch.setattr(_bus_loop, "Keyboard", Keys)
    monkeypatch.setattr(_bus_loop, "steady", nullcontext)
    monkeypatch.setattr(_bus_loop, "_run_session", lambda session, *_: ran.append((session.operator, *opened)))
    other: Any = SimpleNamespace()
    for simulated, operator in ((False, None), (False, other), (True, None)):
        opened.clear()
        link: Any = object.__new__(VirtualLink) if simulated else other
        session = Session(link=link, file=FILE, operator=operator)
        _bus_loop.run_session(session, other, sample_time=0.02, most=1.0)
    keys, given, alone = ran
    assert isinstance(keys[0], Keys)
    assert keys[1:] == ("keyboard",)
    assert given == (other,)
    assert alone == (None,)


def test_an_operator_is_asked_in_every_cycle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_bus_loop.time, "sleep", lambda _: None)
    asks = iter([None, Ask.LEAVE, Ask.STOP])
    master: Any = Led(3)
    sensor = SimpleNamespace(read=lambda *_: None, take=lambda *_: None)
    session: Any = SimpleNamespace(sensor=sensor, operator=lambda: next(asks), watches=())
    line: Any = SimpleNamespace(now=1.0, receive=lambda _: [], send=lambda _: None)
    notifier: Any = SimpleNamespace(cycle=lambda *_: None)
    _bus_loop._in_real_time(session, line, master, CycleTimes(0.02), notifier)
    assert [item for item in master.told if isinstance(item[0], str)] == [("leave", "asked to"), ("stop", "asked to")]
    # In virtual time as well, where a pace makes the wall clock wait.
    waited: list[float] = []
    monkeypatch.setattr(_bus_loop.time, "sleep", waited.append)
    monkeypatch.setattr(_bus_loop.time, "perf_counter", lambda: 100.0)

    class Run:
        def __init__(self, link: Any, _: Any, *, watches: Any) -> None:
            self.link, self.watches = link, watches

        def run(self, most: float) -> None:
            for _ in range(3):
                self.link.now += self.link.cycle
                for watch in self.watches:
                    watch(self.link.now, [], [], None, None)
            seen.append(most)

    seen: list[Any] = []
    monkeypatch.setattr(_bus_loop, "VirtualRun", Run)
    asks, master = iter([Ask.LEAVE, None, Ask.STOP]), Led()  # pyright: ignore[reportAssignmentType]
    session = SimpleNamespace(operator=lambda: next(asks), pace=2.0, watches=(lambda *_: seen.append("watch"),))
    link: Any = SimpleNamespace(now=5.0, cycle=0.02)
    _bus_loop._in_virtual_time(session, link, master, times := CycleTimes(0.02), 9.0)
    assert master.told == [("leave", "asked to"), ("stop", "asked to")]
    assert waited == pytest.approx([0.02, 0.03, 0.04])
    assert (times.count, seen) == (2, ["watch"] * 3 + [9.0])
    assert times.longest_step == 0.0  # there is no real time to be measured


@pytest.mark.parametrize("failure", [None, OSError("gone"), KeyboardInterrupt()], ids=str)
@pytest.mark.parametrize("fed", [True, False])
def test_whatever_ends_a_run_the_drives_are_switched_off(
    failure: BaseException | None, fed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signs of life go on while they are switched off only if all are off already, or the master was never starved."""
    master: Any = Led()
    master.start, master.starved = (lambda: master.told.append("start")), not fed
    master.supervisor.phase = Phase.RUNNING
    calls: list[Any] = []

    def loop(*_: Any) -> None:
        if failure is not None:
            raise failure

    checked = SimpleNamespace(require=lambda: calls.append("required"), guarding="life", late_modes=[2])
    for name, value in {
        "preflight": lambda *_, **given: calls.append(given) or checked, "Master": lambda *_: master,
        "_in_real_time": loop,
        "_emergency_stop": lambda *_: calls.append("stop") or fed,
        "_switch_off": lambda *args: calls.append(args[-1]) or "failed",
    }.items():  # fmt: skip
        monkeypatch.setattr(_bus_loop, name, value)
    waited: list[float] = []
    monkeypatch.setattr(_bus_loop.time, "sleep", waited.append)
    sent: list[Any] = []
    link: Any = SimpleNamespace(now=4.0, send=sent.extend, receive=lambda _: [], tap=None)
    sensor: Any = object()
    session = Session(file=FILE, link=link, sensor=sensor, override=("homed",))
    begun: list[Any] = []
    told: Any = SimpleNamespace(ready=lambda: calls.append("ready"))

    def run() -> RunEnd:
        return _bus_loop._run_session(session, Pilot(), 0.02, 9.0, begun.append, told)

    if isinstance(failure, KeyboardInterrupt):
        with pytest.raises(KeyboardInterrupt):
            run()
        assert calls[-1] == "stop"
        return
    end = run()
    assert calls[0] == {"override": ("homed",), "homed": True, "sensor": session.sensor}
    assert calls[1:] == ["required", "ready", *["stop"] * bool(failure), ("sign",) if fed else ()]
    assert waited == [0.1]
    assert end.error == (failure or "failed")
    assert begun == [master]
    assert "start" in master.told
    assert len(sent) == len(FILE.nodes)
    assert master.counts["loop_failed"] == bool(failure)
    blind = Session(file=FILE, link=link)
    with pytest.raises(SettingsError, match="need an inclinometer"):
        _bus_loop._run_session(blind, Pilot(), 0.02, 9.0, None, told)


def test_disturbances_of_a_loop_act_on_simulated_drives_and_set_points_are_the_controllers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: dict[str, float] = {}
    monkeypatch.setattr(_deploy, "LoopPilot", lambda *_: SimpleNamespace(sample_time=0.02))
    monkeypatch.setattr(_deploy, "simulated_plant", lambda *_, **__: SimpleNamespace(set=told.update))
    monkeypatch.setattr(_deploy, "VirtualLink", lambda virtual: virtual)
    monkeypatch.setattr(_deploy, "_run", lambda _deployed, _pilot, session, _report: session)
    loop = SimpleNamespace(plant_inputs={"payload": 0.5, "motor_setpoint_2": 1.0, "push_x": -2.0}, plant_parameters={})
    deployed: Any = SimpleNamespace(loop=loop, neck=None)
    _deploy.run_simulated(deployed, FILE)
    assert told == {"payload": 0.5, "push_x": -2.0}


def test_a_virtual_cycle_samples_steps_sends_and_lets_time_pass_and_a_host_that_hangs_steps_nothing() -> None:
    told: list[Any] = []
    link: Any = SimpleNamespace(now=0.0, newest=None, sampling=True, drain=lambda: ["in"],
                                send=lambda frames: told.append(("sent", frames)))  # fmt: skip

    def sample(now: float) -> None:
        assert link.sampling is False
        link.newest = f"tilt at {now:g}"

    link.neck = SimpleNamespace(sample=sample)
    link.pass_time = lambda: setattr(link, "now", link.now + 1.0)
    master: Any = SimpleNamespace(settings=SimpleNamespace(sample_cycles=3), sample_due=False)
    master.step = lambda *args: told.append(args) or ["out"]
    seen: list[Any] = []
    run = VirtualRun(link, master, watch=lambda run: seen.append(run.cycles),
                     watches=(lambda *args: seen.append(args[:4]),))  # fmt: skip
    # Sampled in every third cycle; the master reads it where it is due, once.
    for due, tilt in ((False, None), (True, "tilt at 0"), (True, None), (True, "tilt at 3")):
        told.clear()
        seen.clear()
        at, cycles = link.now, run.cycles
        master.sample_due = due
        run.step()
        assert told == [(at, ["in"], tilt), ("sent", ["out"])]
        assert seen == [(at, ["in"], ["out"], tilt), cycles]
        assert (link.now, run.cycles) == (at + 1.0, cycles + 1)
    told.clear()
    run.host_stopped = True
    run.step()
    assert (told, run.cycles) == ([("sent", ())], 5)


def test_the_neck_of_a_loop_is_its_plant_with_the_loops_own_values() -> None:
    paper = NeckParameters.paper()
    values = {name: getattr(paper, name) for name in NeckParameters.names()}
    ports = [SimpleNamespace(name=name, start=value) for name, value in values.items()]
    given: dict[str, Any] = {"unknown": 1.0, "pretension": 1.5 * paper.pretension, "noise_seed": 7.0}

    def loop(robot: Robot, ports: list[Any], *, block: bool = True, **own: Any) -> Any:
        plant = SimpleNamespace(block=SimpleNamespace(parameters=ports)) if block else SimpleNamespace(parameters=ports)
        return SimpleNamespace(plant=plant, robot=robot, plant_parameters=own)

    for block in (True, False):
        assert _deploy.neck_of(loop(NECK, ports, block=block)) == paper
        found = _deploy.neck_of(loop(NECK, ports, block=block, **given))
        assert found == paper.replace(pretension=1.5 * paper.pretension)
    assert _deploy.neck_of(loop(NECK, ports[:-1])) is _deploy.neck_of(loop(NECK, [])) is None
    # Tendons of another robot stand where its file says, and are no parameters of its plant.
    plain = [port for port in ports if not port.name.startswith("tendon_angle")]
    assert _deploy.neck_of(loop(NECK, plain)) is None
    assert _deploy.neck_of(loop(Robot.preset("trunk4"), plain)) == paper
    assert [_deploy.noise_seed(loop(NECK, ports, **own)) for own in ({}, given)] == [0, 7]


def test_each_fiftieth_sample_reports_what_is_done_and_each_goes_into_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    logged, told = list[Any](), list[float]()
    log = SimpleNamespace(take=lambda _now, master, _truth: master.index, finish=lambda _: (None, None, ("n",)))
    monkeypatch.setattr(_deploy, "RunLog", lambda *_, **__: log)

    def ran(session: Session, *_: Any, **__: Any) -> Any:
        for index, runs in ((0, True), (0, False), (1, True), (50, True), (100, False), (150, True), (250, True)):
            for watch in session.watches:
                watch(0.0, (), (), None, SimpleNamespace(index=index, ran=runs))  # pyright: ignore[reportArgumentType]
        master = SimpleNamespace(supervisor=SimpleNamespace(phase="done", fault=None, rehome=False), counts={"left": 1},
                                 events=[], cycle=9, settings=SimpleNamespace(bus=CYCLE))  # fmt: skip
        return SimpleNamespace(master=master, wall_time=1.0, times=None, terminated=True, error=None)

    monkeypatch.setattr(_deploy, "run_session", ran)
    closed: list[int] = []
    pilot: Any = SimpleNamespace(sample_time=0.02, close=lambda: closed.append(1))
    deployed: Any = SimpleNamespace(loop=SimpleNamespace(duration=4.0), notes=("m",))
    session: Any = Session(file=FILE, link=None, log=SimpleNamespace(signals=logged.append, path=Path("a/b")))  # pyright: ignore[reportArgumentType]
    found = _deploy._run(deployed, pilot, session, told.append)
    assert told == [0.0, 0.25, 0.75, 1.0]
    assert logged == [0, 1, 50, 150, 250]
    assert (found.notes, found.counts, found.cycles, found.cycle) == (("m", "n"), {"left": 1}, 9, CYCLE.cycle)
    assert (found.terminated, found.simulated, closed) == (True, False, [1])


def test_the_end_of_a_run_in_numbers() -> None:
    master: Any = Led()
    master.supervisor.phase = Phase.DONE
    found = RunEnd(master, CycleTimes(0.02), 0.7).table()
    # Seven cycles of 20 ms in 0.7 s.
    assert found["real_time_factor"] == pytest.approx(0.2)
    assert (found["cycles"], found["cycle_s"], found["phase"], found["fault"]) == (7, 0.02, "done", None)
    assert math.isfinite(RunEnd(master, CycleTimes(0.02), 0.0).table()["real_time_factor"])


@pytest.mark.parametrize("phase", list(Phase))
def test_tensions_of_a_run_are_those_while_the_drives_had_power(phase: Phase, monkeypatch: pytest.MonkeyPatch) -> None:
    master: Any = Led()
    master.start, master.supervisor.phase = (lambda: None), phase
    for name, value in {
        "preflight": lambda *_, **__: SimpleNamespace(require=lambda: None, guarding="life", late_modes=[]),
        "Master": lambda *_: master, "_switch_off": lambda *_: None,
        "_in_real_time": lambda session, *_: [watch(0.0, (), (), None, master) for watch in session.watches],
    }.items():  # fmt: skip
        monkeypatch.setattr(_bus_loop, name, value)
    monkeypatch.setattr(_bus_loop.time, "sleep", lambda _: None)
    link: Any = SimpleNamespace(now=4.0, send=lambda _: None, receive=lambda _: [], tap=None)
    session = Session(file=FILE, link=link, sensor=object(), operator=SimpleNamespace(terminated=True))  # pyright: ignore[reportArgumentType]
    notifier: Any = SimpleNamespace(ready=lambda: None)
    end = _bus_loop._run_session(session, Pilot(), 0.02, 9.0, None, notifier)
    assert end.tensions == ((1.0, 2.0, 3.0) if phase in ACTIVE else (0.0, 0.0, 0.0))
    assert end.terminated


# -- pilots -----------------------------------------------------------------------------------------------------------


def test_signals_are_played_row_by_row_and_ways_are_smooth() -> None:
    rows = np.arange(6.0).reshape(2, 3)
    pilot = SignalPilot(rows)
    measured: Any = SimpleNamespace(index=1)
    assert pilot.step(measured) == (3.0, 4.0, 5.0)
    assert [pilot.is_finished(k) for k in (0, 1, 2)] == [False, False, True]
    way = raised_cosine(4)
    np.testing.assert_allclose(way, [0.5 - 0.5 * math.cos(k * math.pi / 4) for k in (1, 2, 3, 4)], rtol=1e-12)


def _plant(*outputs: str) -> Any:
    return Ports("plant", [f"motor_setpoint_{j}" for j in (1, 2, 3)], list(outputs))


def _loop(**changes: Any) -> Loop:
    asked = ["pitch_reference", "roll_reference", "pitch", "roll"]
    told = ("pitch", "roll", "motor_position_1", "motor_position_3", "measurement_valid", "roll_rate")
    settings = {"plant": _plant(*told),
                "controller": Ports("controller", asked, [f"motor_setpoint_{j}" for j in (1, 2, 3)]),
                "reference": lambda t: (t, -t, 0.0), "duration": 1.0, **changes}  # fmt: skip
    return Loop(**settings)


def test_a_measurement_goes_to_the_plant_s_outputs_each_to_its_own() -> None:
    pilot = LoopPilot(_loop())
    outputs = np.full(6, 9.0)
    for fresh in (True, False):
        tilt = Tilt(0.1, -0.2, 0.3, math.nan)
        pilot._measure(Measurement(0, tilt, fresh, (1.0, 2.0, 3.0)), outputs)
        assert outputs.tolist() == [0.1, -0.2, 1.0, 3.0, float(fresh), 0.0]
    assert [pilot.is_finished(index) for index in (49, 50)] == [False, True]


def test_a_loop_that_drives_cannot_run_is_refused() -> None:
    with pytest.raises(SettingsError, match="sequential"):
        LoopPilot(_loop(order="jacobi"))
    for time in (0.04, 0.02 * 1.001, 0.02 * 0.999):
        slow = Ports("controller", ["pitch"], [f"motor_setpoint_{j}" for j in (1, 2, 3)])
        slow.sample_time = time
        with pytest.raises(SettingsError, match=rf"need one sample time; it has .*{time:g} s"):
            LoopPilot(_loop(controller=slow))
    names = [f"motor_setpoint_{j}" for j in (1, 2, 3)]
    between = Ports("part", names[:1], names)
    settings = {"controller": Ports("controller", ["pitch"], names[:1]), "others": {"limiter": between},
                "connections": {f"plant.{name}": f"limiter.{name}" for name in names}}  # fmt: skip
    with pytest.raises(SettingsError, match=r"does not give three motor set-points: motor_setpoint_1\."):
        LoopPilot(_loop(**settings))


def test_a_pilot_is_warmed_by_one_step_at_rest_and_starts_all_parts_but_the_plant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started: list[Any] = []
    monkeypatch.setattr(
        Ports, "start", lambda part, *args: started.append((part.role, *args)) or np.zeros(len(part.outputs))
    )
    asked: list[Measurement] = []
    pilot = LoopPilot(_loop(controller_parameters={"gain": 2.0}))
    monkeypatch.setattr(pilot, "step", asked.append)
    pilot.warm()
    assert started == [("controller", 0.0, {"gain": 2.0})]
    (rest,) = asked
    assert (rest.index, rest.fresh, rest.positions, rest.tilt.values) == (0, True, (0.0, 0.0, 0.0), (0.0, 0.0))
    closed: list[str] = []
    monkeypatch.setattr(Loop, "close", lambda _: closed.append("closed"))
    pilot.close()
    assert closed == ["closed"]
    assert (pilot.slot("controller", "nothing"), pilot.slot("nobody", "pitch")) == (None, None)


def test_what_is_measured_beats_what_the_plant_would_be() -> None:
    """An output that a plant has both as it is and as measured is written to both; a rate to its own."""
    pilot = LoopPilot(_loop(plant=_plant("pitch", "pitch_measured", "roll", "roll_rate_measured", "motor_position_2")))
    outputs = np.full(5, 9.0)
    pilot._measure(Measurement(0, Tilt(0.1, -0.2, 0.3, 0.4), True, (1.0, 2.0, 3.0)), outputs)
    assert outputs.tolist() == [0.1, 0.1, -0.2, 0.4, 2.0]
    pilot._measure(Measurement(0, Tilt(math.inf, -math.inf, 0.3, math.nan), True, (1.0, 2.0, 3.0)), outputs)
    assert outputs.tolist() == [0.0, 0.0, 0.0, 0.0, 2.0]


# -- the master -------------------------------------------------------------------------------------------------------


class Pilot:
    """Raises in `start`, or returns what it is told."""

    def __init__(self, answer: Any = (0.0, 0.0, 0.0), *, start: Exception | None = None) -> None:
        self.answer, self.problem = answer, start

    def start(self) -> None:
        if self.problem is not None:
            raise self.problem

    def step(self, measured: Measurement) -> Any:
        assert measured.index == -1
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def is_finished(self, index: int) -> bool:
        return index < -1


def _master(pilot: Pilot) -> Master:
    master = Master(MasterSettings(counts_per_radian=(1000.0,) * 3), pilot)
    master.supervisor.phase = Phase.RUNNING
    master._gate.last = Tilt(0.0, 0.0)
    return master


def test_a_pilot_that_cannot_start_stops_the_drives() -> None:
    calm = _master(Pilot())
    calm._begin()
    assert calm.supervisor.phase is Phase.RUNNING
    for problem in (ValueError("no"), RuntimeError("x"), OSError()):
        master = _master(Pilot(start=problem))
        master._begin()
        assert master.counts["controller_failed"] == 1
        assert master.supervisor.phase is Phase.STOPPING


@pytest.mark.parametrize(
    "answer",
    [(math.nan, 0.0, 0.0), (0.0, 0.0, math.inf), (0.0, -math.inf, 0.0), (0.0, 0.0), (0.0,) * 4, RuntimeError("x")],
    ids=str,
)
def test_set_points_that_are_no_numbers_or_of_another_count_stop_the_drives(answer: Any) -> None:
    master, events = _master(Pilot(answer)), list[Event]()
    master._consult(0.0, True, events)
    assert master.counts["controller_failed"] == 1
    assert master.supervisor.phase is Phase.STOPPING
    assert master.wanted == (0.0, 0.0, 0.0)


def test_a_pilot_that_is_late_holds_and_one_in_time_is_followed() -> None:
    master, events = _master(Pilot(None)), list[Event]()
    master._consult(0.0, True, events)
    assert (master._missing, master.supervisor.phase) == (1, Phase.RUNNING)
    master.pilot = Pilot((1.0, 2.0, 3.0))
    master._consult(0.0, True, events)
    assert (master._missing, master.wanted) == (0, (1.0, 2.0, 3.0))


def test_without_a_set_point_the_last_one_holds_and_the_fifth_cycle_is_one_too_many() -> None:
    late: Any = SimpleNamespace(step=lambda _: None, is_finished=lambda _: False)
    master, told = _master(late), list[str]()
    for cycle in range(6):
        events: list[Event] = []
        master._run(0.01 * cycle, cycle % 2 == 0, True, events)
        told += [event.name for event in events]
        assert master.setpoints == (0.0, 0.0, 0.0)
    assert told == ["setpoint_missing"] * 4 + ["setpoint_lost"] * 2


@pytest.mark.parametrize(
    ("code", "register", "name"),
    [(0x8130, 0x11, "emergency"), (0x8130, 0, "emergency"), (0x1000, 0, "emergency"), (0, 0x81, ""), (0, 0, "")],
)
def test_an_emergency_counts_by_its_code_whatever_its_register(code: int, register: int, name: str) -> None:
    bus = Fieldbus(MasterSettings(counts_per_radian=(1.0,) * 3).bus)
    node = bus.drives[1].node
    events = bus.receive(0.5, [Frame(0x080 + node, code.to_bytes(2, "little") + bytes([register]) + bytes(5))])
    found = [event for event in events if event.name in ("emergency", "drive_limit")]
    assert [event.name for event in found] == [name] * bool(name)
    assert all(event.node == node for event in found)
    assert bus.drives[1].emergencies == [(0.5, code, register)]
    assert bus.drives[0].emergencies == []


def test_the_mode_is_taken_only_by_a_drive_that_was_asked() -> None:
    bus = Fieldbus(MasterSettings(counts_per_radian=(1.0,) * 3).bus)
    taken, refused = b"\x60\x60\x60\0\0\0\0\0", b"\x80\x60\x60\0\0\0\0\0"
    for mode, data, then in (("asked", taken, "taken"), ("asked", refused, "asked"), ("missing", taken, "missing")):
        view = bus.drives[1]
        view.mode = mode
        bus._answer(0.0, view, data, [])
        assert view.mode == then


@pytest.mark.parametrize("phase", [Phase.RAMP_IN, Phase.RAMP_OUT, Phase.RETREAT])
def test_a_ramp_that_does_not_arrive_in_its_time_is_told(phase: Phase) -> None:
    """30 s; without a sensor the way from the farthest set-point: 6 rad at 1 rad/s, one to settle and one more."""
    most = 8.0 if phase is Phase.RETREAT else 30.0
    for after, told in ((most - 0.01, []), (most + 0.01, ["ramp_timeout"])):
        master, events = _master(Pilot()), list[Event]()
        master.supervisor.phase, master.supervisor.since, master.setpoints = phase, 100.0, (0.0, 5.0, 0.0)
        master._ramp(100.0 + after, events)
        assert [event.name for event in events] == told


@pytest.mark.parametrize("motor", [0, 1, 2])
def test_a_ramp_arrives_where_every_motor_is_at_rest_long_enough_and_at_a_sample(motor: int) -> None:
    ramps = MasterSettings(counts_per_radian=(1.0,) * 3).ramps
    for position, there in ((0.999 * ramps.tolerance, True), (-0.999 * ramps.tolerance, True), (ramps.tolerance, False),
                            (-1.001 * ramps.tolerance, False), (math.nan, False)):  # fmt: skip
        master = _master(Pilot())
        master.supervisor.phase = Phase.RAMP_IN
        positions = [0.0, 0.0, 0.0]
        positions[motor] = position
        master.positions = tuple(positions)
        for now in (50.0, 50.0 + ramps.settle - 0.001):
            for master.cycle in (1, 0):
                master._ramp(now, [])
                assert master.supervisor.phase is Phase.RAMP_IN
        # Two cycles make a sample: the run starts with one.
        master._ramp(50.0 + ramps.settle, [])
        assert master.supervisor.phase is Phase.RAMP_IN
        master.cycle = 1
        master._ramp(50.0 + ramps.settle, [])
        assert (master.supervisor.phase is Phase.RUNNING) is there
    # What leaves its rest waits again, from when it is back.
    master = _master(Pilot())
    master.supervisor.phase, master.cycle = Phase.RAMP_IN, 1
    for now, position in ((50.0, 0.0), (50.1, 1.0), (50.2, 0.0), (50.0 + ramps.settle, 0.0)):
        master.positions = tuple(position * (k == motor) for k in range(3))
        master._ramp(now, [])
        assert master.supervisor.phase is Phase.RAMP_IN
    master._ramp(50.2 + ramps.settle, [])
    assert master.supervisor.phase is Phase.RUNNING


def test_a_run_begins_without_a_missing_set_point_and_an_error_has_its_time() -> None:
    master = _master(Pilot(start=ValueError("no")))
    master._missing, master._index, master._now = 3, 7, 42.0
    master.setpoints = (1.0, 2.0, 3.0)
    master._begin()
    assert (master._missing, master._index, master.wanted) == (0, -1, (1.0, 2.0, 3.0))
    assert master.supervisor.fault is not None
    assert (master.supervisor.fault.name, master.supervisor.fault.time) == ("controller_failed", 42.0)


@pytest.mark.parametrize("motor", [-1, 0, 2])
@pytest.mark.parametrize("at", ["cycle", "sample", ""])
def test_what_the_charts_find_is_told_of_its_drive(motor: int, at: str) -> None:
    found = SimpleNamespace(name="friction_changed", motor=motor, detail="x")
    asked: list[Any] = []
    charts = SimpleNamespace(
        cycle=lambda *given: asked.append(given) or (found if at == "cycle" else None),
        sample=lambda *given: asked.append(given) or (found if at == "sample" else None), rests="",
    )  # fmt: skip
    watches = Watches(WatchSettings(), LimitSettings())
    watches._plausible = charts  # pyright: ignore[reportAttributeAccessIssue]
    for due, sample in ((False, None), (True, None), (True, Tilt(0.1, 0.2, 0.3, 0.4))):
        events: list[Event] = []
        asked.clear()
        watches.plausible(1.0, (4, 5, 6), (1.0,), (2.0,), (3.0,), events, due=due, sample=sample, reference=(9.0,))
        told = at == "cycle" or (at == "sample" and due)
        expected = [("friction_changed", 0 if motor < 0 else (4, 5, 6)[motor], "x")] * told
        assert [(event.name, event.node, event.detail) for event in events] == expected
        seen = [((1.0,), (2.0,), (3.0,))]
        if due and at != "cycle":
            seen.append(((2.0,), None, (), (9.0,)) if sample is None else ((2.0,), (0.1, 0.2), (0.3, 0.4), (9.0,)))  # pyright: ignore[reportArgumentType]
        assert asked == seen
    charts.rests = "at its limit"
    watches.plausible(1.0, (4, 5, 6), (1.0,), (2.0,), (3.0,), events := [], due=True, sample=None, reference=())
    assert ("not_watched" in [event.name for event in events]) is (at != "cycle")


def test_a_drive_that_never_answers_is_missed_from_the_first_step_on() -> None:
    master = _master(Pilot())
    wait = master.settings.bus.answer_time
    master._timing(20.0)
    assert [view.answered for view in master.bus.drives] == [20.0] * 3
    for now, missed in ((20.0 + wait - 0.001, 0), (20.0 + wait + 0.001, 3)):
        events: list[Event] = []
        master.bus._watch(now, events)
        assert [event.name for event in events].count("heartbeat_missing") == missed


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_set_point_beyond_the_range_goes_to_its_near_end(sign: float) -> None:
    limiter = Limiter(LimitSettings(position=6.0), 0.01)
    for _ in range(2000):
        limiter.step(sign * 100.0, 1.0)
    assert limiter.value == pytest.approx(sign * 6.0)
    assert limiter.clamped == "position"


def test_a_short_emergency_is_malformed() -> None:
    bus = Fieldbus(MasterSettings(counts_per_radian=(1.0,) * 3).bus)
    node = bus.drives[0].node
    events = bus.receive(0.5, [Frame(0x080 + node, b"\x30\x81")])
    assert [(event.name, event.node) for event in events if event.name != "tpdo_missing"] == [("frame_length", node)]
    assert bus.drives[0].state is DriveState.UNKNOWN
    assert NodeState.OPERATIONAL is not bus.drives[0].nmt


CYCLE = MasterSettings(counts_per_radian=(1.0,)).bus


@pytest.mark.parametrize(
    ("gap", "name"),
    [(1.0, ""), (1.499, ""), (1.501, "late_cycle"), (4.99, "late_cycle"),
     (5.0 + 1e-6, "stalled"), (0.0, "clock"), (-1.0, "clock"), (math.nan, "clock"), (1e-6, "")],
)  # fmt: skip
def test_the_time_between_two_steps(gap: float, name: str) -> None:
    found = timing(10.0 + gap * CYCLE.cycle, 10.0, CYCLE)
    assert [event.name for event in found] == [name] * bool(name)
    assert timing(10.0, None, CYCLE) == []


@pytest.mark.parametrize("motor", [0, 1, 2])
def test_each_motor_and_tendon_is_watched_up_to_its_limit(motor: int) -> None:
    watch, limits = WatchSettings(), LimitSettings()

    def seen(gap: float, tension: float, *, signs: bool = False) -> set[tuple[str, int]]:
        watches, events = Watches(watch, limits), list[Event]()
        P, F = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
        P[motor], F[motor] = gap, tension
        for k in range(40):
            if signs:
                watches.signs(0.01 * k, (1, 2, 3), F, events)
            else:
                watches.motors(0.01 * k, P, (0.0, 0.0, 0.0), (1, 2, 3), F, events)
        return {(event.name, event.node) for event in events}

    node = motor + 1
    for sign in (-1.0, 1.0):
        assert seen(sign * watch.following, 1.0) == set()
        assert seen(sign * watch.following * 1.001, 1.0) == {("following", node)}
        assert seen(0.0, sign * limits.tension) == set()
        assert seen(0.0, sign * limits.tension * 1.001) == {("tension", node)}
    assert seen(0.0, -watch.pushed, signs=True) == set()
    assert seen(0.0, -watch.pushed * 1.001, signs=True) == {("pushed", node)}


def test_the_gate_takes_what_may_be_and_nothing_else() -> None:
    def passed(*samples: Tilt | None, step: float = 0.02) -> tuple[list[bool], list[str]]:
        gate, events = Gate(1.2), list[Event]()
        return [gate.step(step * k, sample, events) for k, sample in enumerate(samples)], [e.name for e in events]

    assert passed(Tilt(0.0, 0.0), Tilt(0.01, 0.0)) == ([True, True], [])
    for bad in (Tilt(math.nan, 0.0), Tilt(0.0, math.inf), Tilt(1.21, 0.0), Tilt(0.0, -1.21), Tilt(0.5, 0.0)):
        assert passed(Tilt(0.0, 0.0), bad) == ([True, False], ["sample_discarded"])
    assert passed(Tilt(1.2, 0.0)) == ([True], [])
    assert passed(Tilt(0.0, 0.0), Tilt(0.01, 0.0, valid=False)) == ([True, False], [])
    far = [Tilt(math.nan, 0.01 * k) for k in range(3)]
    assert passed(Tilt(0.0, 0.0), *far)[1].count("sensor_bad") == 1
    assert "sensor_bad" not in passed(Tilt(0.0, 0.0), *far[:-1])[1]
    same = passed(*[Tilt(0.1, 0.0)] * 20)
    assert (same[0], same[1]) == ([True] * 19 + [False], ["sensor_frozen"])
    gone = 4
    assert passed(Tilt(0.0, 0.0), *[None] * (gone - 1))[1] == []
    assert passed(Tilt(0.0, 0.0), *[None] * gone)[1] == ["sensor_lost"]


@pytest.mark.parametrize("phase", list(Phase))
def test_a_request_from_outside_has_the_time_of_the_last_step_and_reacts_by_the_phase(phase: Phase) -> None:
    for now in (None, 42.0):
        for act, reason in (("stop", "pressed"), ("leave", "asked"), ("start", ""), ("finish", "")):
            master = _master(Pilot())
            master.supervisor.phase, master._now = phase, now
            getattr(master, act)(*[reason] * bool(reason))
            assert master.requests == [(act, reason)]
            moving, before = phase in (Phase.RAMP_IN, Phase.RUNNING), phase in (Phase.IDLE, Phase.ENABLING)
            name = {"stop": "operator", "leave": "left" if moving else "operator" if before else ""}.get(act, "")
            assert [(event.name, event.node, event.time, event.detail) for event in master.events] == [
                (name, 0, now or 0.0, reason)
            ] * bool(name)
            assert master.counts.total() == bool(name)
            signals = {"start": [Signal.START], "finish": [Signal.FINISH], "leave": [Signal.FINISH] * moving}
            assert master._asked == signals.get(act, [])


@pytest.mark.parametrize("motor", [0, 1, 2])
def test_a_limit_of_any_motor_is_told_of_the_run_and_lasts_for_its_time(motor: int) -> None:
    master, told = _master(Pilot()), list[Event]()
    wanted = [0.0] * 3
    wanted[motor] = 100.0
    for cycle in range(32):
        events: list[Event] = []
        master._limit(0.01 * cycle, wanted, events, count=False)
        assert events == []
        master._limit(0.01 * cycle, wanted, events, count=True)
        assert (events[0].name, events[0].node, events[0].time) == ("clamped", 0, 0.01 * cycle)
        assert events[0].detail in ("position", "speed", "acceleration")
        told += events[1:]
    assert {(event.name, event.node) for event in told} == {("clamp_persistent", 0)}
    assert round(told[0].time / 0.01) == 29  # 0.3 s of 10 ms
    assert master.setpoints[motor] > 0.0
    assert [value for k, value in enumerate(master.setpoints) if k != motor] == [0.0, 0.0]


def test_time_within_the_limits_is_taken_from_that_beyond_them() -> None:
    master, far, near = _master(Pilot()), [100.0] * 3, [0.0] * 3
    # 0.28 s beyond, then long enough within to fall by 0.18 s, of which ten times as much is needed.
    for wanted, cycles, told in ((far, 28, 0), (near, 180, 0), (far, 19, 0), (far, 3, 1)):
        events: list[Event] = []
        for _ in range(cycles):
            for limiter in master._limiters:
                limiter.reset(0.0)
            master._limit(0.0, wanted, events, count=True)
        assert ("clamp_persistent" in [event.name for event in events]) is bool(told)


@pytest.mark.parametrize("at", [-1, 0, 1, 2])
def test_drives_are_enabled_one_after_the_other_each_in_its_time(at: int) -> None:
    """The run waits for a sample of the sensor once all are; one that does not come is named."""
    for sample in (Tilt(0.0, 0.0), None):
        master = _master(Pilot())
        master.supervisor.phase, master._gate.last = Phase.ENABLING, sample
        events: list[Event] = []
        for k, view in enumerate(master.bus.drives):
            view.state, view.fresh = (DriveState.ENABLED if k != at else DriveState.SWITCHED_ON), True
        for cycle in range(5):
            master._enable(7.0 + 0.01 * cycle, events)
        assert events == []
        assert (master.supervisor.phase is Phase.RAMP_IN) is (at < 0 and sample is not None)
        if at >= 0:
            assert master._enabling == at
            # A second from when its turn came: with the cycle in which the one before followed.
            due = 8.0 + 0.01 * max(at - 1, 0)
            master._enable(due - 1e-6, events)
            assert events == []
            master._enable(due + 1e-3, events)
            assert [(event.name, event.node) for event in events] == [("enable_timeout", master.bus.drives[at].node)]


def test_a_successful_end_is_taken_back_by_the_first_event_after_it() -> None:
    master = _master(Pilot())
    master.supervisor.phase = Phase.DONE
    first, second = Event(1.0, "not_off", 1), Event(2.0, "not_off", 2)
    for event in (first, second):
        master.supervisor.revoke(event)
        assert (master.supervisor.phase, master.supervisor.fault) == (Phase.STOPPED, first)


@pytest.mark.parametrize("ends", [0, 3, math.inf])
def test_a_simulated_run_is_over_when_its_master_is_done_and_two_minutes_after_its_loop_at_the_latest(
    ends: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Ends:
        @property
        def finished(self) -> bool:
            return run.cycles >= ends

    def step(self: VirtualRun) -> None:
        self.cycles += 1

    monkeypatch.setattr(VirtualRun, "step", step)
    run = VirtualRun(SimpleNamespace(cycle=0.5), Ends())  # pyright: ignore[reportArgumentType]
    run.run(10.0)
    assert run.cycles == min(ends, (10.0 + 120.0) / 0.5)
