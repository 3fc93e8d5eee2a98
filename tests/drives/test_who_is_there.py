"""Who is on the bus: scan and pre-flight against two devices with one number, a short queue, and other guarding."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from softneck.cli._main import run
from softneck.core import CheckFailedError
from softneck.drives import DrivesFile, default_drives, preflight, reset, scan, simulated_neck
from softneck.drives.bus._link import BusError, VirtualLink, reason
from softneck.drives.bus._sdo import Objects, SdoError
from softneck.drives.commissioning._jog import jog_pilot
from softneck.drives.master import Frame
from softneck.drives.running import _preflight
from softneck.drives.running._bus_loop import Session, run_session
from softneck.drives.running._preflight import devices_at, listen, several_devices
from softneck.drives.running._stop import wait
from softneck.drives.simulated._profiles import PROFILES, Profile, ds402
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.plant import NeckParameters

from .bench import FAST


def linked(file: DrivesFile, quirks: DriveQuirks | None = None) -> VirtualLink:
    return VirtualLink(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, quirks=quirks))


def with_twin() -> VirtualLink:
    """Two drives with number 2, of serial numbers 11 and 12."""
    link = linked(default_drives(), DriveQuirks(twin=2))
    link.neck.drives[1].axis.values[(0x1018, 4)] = 11
    link.neck.twins[0].axis.values[(0x1018, 4)] = 12
    return link


def test_scan_names_two_devices_with_one_number() -> None:
    found = {item["node"]: item["serials"] for item in scan(with_twin())}
    assert found == {1: [1001], 2: [11, 12], 3: [1003]}


def test_the_pre_flight_refuses_two_devices_with_one_number_before_it_writes() -> None:
    link, written = with_twin(), list[Frame]()
    link.tap = lambda _now, from_master, frame: (
        written.append(frame) if from_master and frame.identifier > 0x600 and frame.data[0] & 0xE0 == 0x20 else None
    )
    report = preflight(link, default_drives(), override=("identity",))
    with pytest.raises(CheckFailedError, match=r"node 2: node number: 2 devices answer \(serial numbers 11, 12\)"):
        report.require()
    assert written == []


def test_scan_of_two_devices_with_one_number_is_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("softneck.drives.running._preflight.devices_at", lambda _link, nodes: {nodes[0]: [11, None]})
    assert run(["drives", "commission", "--only", "scan", "--simulated", "--json"]) == 1
    said = capsys.readouterr()
    assert json.loads(said.out)["nodes"][0]["serials"] == [11, None]
    assert "node 1: 2 devices answer (serial numbers 11, not told)" in said.err


@pytest.mark.parametrize(
    "theirs", [Frame(0x080), Frame(0x203, b"\x0f\0\0\0\0\0"), Frame(0x705, remote=True)], ids=["sync", "rpdo", "guard"]
)
def test_scan_and_reset_listen_first_and_send_nothing_into_the_run_of_another_master(theirs: Frame) -> None:
    for act in (lambda link: scan(link), lambda link: reset(link, default_drives())):
        link, sent = linked(default_drives()), list[Frame]()
        link.tap = lambda _now, from_master, frame, sent=sent: sent.append(frame) if from_master else None
        link.inject.append(theirs)
        with pytest.raises(
            CheckFailedError, match=r"another master is on the bus \(.*\); stop it first\. Nothing was sent"
        ):
            act(link)
        assert sent == []
        # Alone, both speak.
        act(link)
        assert sent


class Stranger(VirtualLink):
    """Another SDO client reads as well: what its server answers precedes each answer to us."""

    def __init__(self, link: VirtualLink, foreign: bytes) -> None:
        super().__init__(link.neck)
        self.foreign = foreign

    def receive(self, timeout: float) -> list[Frame]:
        frames = super().receive(timeout)
        ours = [frame for frame in frames if frame.identifier == 0x582]
        return [*([Frame(0x582, self.foreign)] if ours else []), *frames]


# An abort of 6085h, a value of 6085h, a value of another subindex of what is read, a segment that nobody asked for.
@pytest.mark.parametrize("foreign", ["8085600011000906", "43856000ffffffff", "4300100511223344", "0011223344556677"])
def test_an_answer_about_another_object_is_not_ours(foreign: str) -> None:
    link = Stranger(linked(default_drives()), bytes.fromhex(foreign))
    objects = Objects(link, 2)
    assert objects.read(0x1000) == Objects(linked(default_drives()), 2).read(0x1000)
    objects.write(0x6065, 0, 1234)
    assert objects.read(0x6065) == 1234
    # Segments of a long value do not name their object (CiA 301): those of two clients cannot be told apart.
    if foreign[:2] != "00":
        assert objects.read_text(0x1008) == Objects(linked(default_drives()), 2).read_text(0x1008)


class ShortQueue(VirtualLink):
    """An adapter with the queue of can0: 10 frames, one leaves in each 2 ms or when somebody answers."""

    def __init__(self, file: DrivesFile) -> None:
        super().__init__(linked(file).neck)
        self.queued = self.most = 0

    def send(self, frames: Sequence[Frame]) -> None:
        self.queued += len(frames)
        self.most = max(self.most, self.queued)
        if self.queued > 10:
            self.problem = reason(OSError(105, "No buffer space available"))
            return
        super().send(frames)
        if self._inbox:
            self.queued = 0

    def pass_time(self) -> None:
        self.queued = max(0, self.queued - 5)
        super().pass_time()


def test_scan_fits_the_queue_of_an_adapter() -> None:
    link = ShortQueue(default_drives())
    assert [item["node"] for item in scan(link)] == [1, 2, 3]
    assert link.most <= 10


def test_a_full_queue_is_told_with_its_cause() -> None:
    assert reason(OSError(105, "No buffer space available")).startswith(
        "No buffer space available. Nobody acknowledges"
    )


# -- the requests of a scan, one by one -------------------------------------------------------------------------------


class Line:
    """A bus where time passes while somebody waits; `answer` gives (delay [s], frame) for each frame that is sent."""

    def __init__(self, answer: Callable[[Frame], Iterable[tuple[float, Frame]]] = lambda _: ()) -> None:
        self.now, self.problem, self.answer = 0.0, "", answer
        self.sent: list[tuple[float, Frame]] = []
        self.coming: list[tuple[float, Frame]] = []

    def send(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self.sent.append((self.now, frame))
            self.coming += [(self.now + delay, answer) for delay, answer in self.answer(frame)]

    def receive(self, timeout: float) -> list[Frame]:
        assert timeout >= 0.0
        until = self.now + timeout
        first = min((at for at, _ in self.coming), default=until)
        self.now = min(max(self.now, first), until)
        frames = [frame for at, frame in self.coming if at <= self.now]
        self.coming = [item for item in self.coming if item[0] > self.now]
        return frames


# All four bytes of a number differ.
KIND = 0x8A020192


def told(node: int, value: int = KIND, index: int = 0x1000, sub: int = 0, command: int = 0x43) -> Frame:
    """Return an answer to the request of an object (CiA 301, 7.2.4.3.6)."""
    return Frame(0x580 + node, bytes([command, index & 0xFF, index >> 8, sub]) + value.to_bytes(4, "little"))


def scanned(line: Line, monkeypatch: pytest.MonkeyPatch, **how: int) -> list[Any]:
    monkeypatch.setattr(_preflight, "_identity", lambda _link, objects, kind: (objects.node, kind))
    return scan(line, **how)


@pytest.mark.parametrize(
    ("rate", "pause"), [(1_000_000, 2e-3), (250_000, 2e-3), (125_000, 3 * 135 / 125e3), (20_000, 3 * 135 / 20e3)]
)
def test_a_scan_asks_each_number_once_as_fast_as_an_absent_device_allows(
    rate: int, pause: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second of listening, three frames of 135 bits or 2 ms for each of 126 numbers, 0.2 s for the last answers."""
    line = Line()
    assert scanned(line, monkeypatch, bit_rate=rate) == []
    assert [frame for _, frame in line.sent] == [
        Frame(0x600 + node, bytes([0x40, 0x00, 0x10, 0, 0, 0, 0, 0])) for node in range(1, 127)
    ]
    assert [at for at, _ in line.sent] == pytest.approx([1.0 + k * pause for k in range(126)])
    assert line.now == pytest.approx(1.0 + 126 * pause + 0.2)


def test_a_scan_waits_for_an_answer_no_longer_than_it_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(lambda frame: [(0.0, told(frame.identifier - 0x600))])
    assert scanned(line, monkeypatch) == [(node, KIND) for node in range(1, 127)]
    assert {at for at, _ in line.sent} == {1.0}
    # A bus that frames no longer leave is told at the first request, or at the end.
    line = Line(lambda _: setattr(line, "problem", "x.") or [])
    with pytest.raises(BusError, match=r"^the bus takes no frames: x\. Nothing was moved\.$"):
        scan(line)
    assert len(line.sent) == 1
    line = Line()
    line.receive = lambda timeout: (
        setattr(line, "problem", "late." * (len(line.sent) == 126)) or Line.receive(line, timeout)
    )
    with pytest.raises(BusError, match=r"late\."):
        scan(line)


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        (told(7), KIND), (told(7, 0x06020000, command=0x80), 0x06020000), (told(7, index=0x1001), None),
        (told(7, index=0x1100), None), (told(7, sub=1), None), (told(7)._replace(data=told(7).data[:7]), None),
        (told(7)._replace(error=True), None), (told(0), None), (told(127), None), (told(-0x80), None),
    ],
)  # fmt: skip
@pytest.mark.parametrize(("delay", "late"), [(0.0, False), (0.15, False), (0.5, True)])
def test_a_scan_takes_the_answers_to_its_own_request_alone(
    answer: Frame, kind: int | None, delay: float, late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for asked in (7, 126):
        line = Line(lambda frame, asked=asked: [(delay, answer)] * (frame.identifier == 0x600 + asked))
        missed = kind is None or late
        assert scanned(line, monkeypatch) == ([] if missed else [(7, kind)])


def test_a_late_answer_is_waited_for_whoever_answered_before(monkeypatch: pytest.MonkeyPatch) -> None:
    for first in (1, 2, 125):
        line = Line(lambda frame, first=first: [(0.0, told(first))] if frame.identifier == 0x600 + first
                    else [(0.19, told(126))] * (frame.identifier == 0x67E))  # fmt: skip
        assert scanned(line, monkeypatch) == [(first, KIND), (126, KIND)]


def test_devices_are_told_apart_by_their_serial_numbers_within_their_time() -> None:
    def answer(frame: Frame) -> list[tuple[float, Frame]]:
        assert frame.data == bytes([0x40, 0x18, 0x10, 4, 0, 0, 0, 0])
        node = frame.identifier - 0x600
        serial = [
            (after, told(node, 0xA0B0C000 + 10 * node + k, 0x1018, 4)) for k, after in enumerate((0.0, 0.19, 0.21))
        ]
        return [*serial, (0.1, told(9, 1, 0x1018, 4)), (0.1, told(node, 5, 0x1018, 3))]

    line = Line(answer)
    # What came before it asked is no answer.
    line.coming = [(0.0, told(2, 99, 0x1018, 4))]
    assert devices_at(line, [2, 3]) == {node: [0xA0B0C000 + 10 * node + k for k in (0, 1)] for node in (2, 3)}
    assert line.now == pytest.approx(0.2)
    refused = Line(lambda frame: [(0.0, told(frame.identifier - 0x600, 0x06090011, 0x1018, 4, command=0x80))])
    assert devices_at(refused, [2]) == {2: [None]}
    assert [several_devices(found) for found in ([], [1], [1, None])] == [
        "", "", "2 devices answer (serial numbers 1, not told)",
    ]  # fmt: skip


def test_an_identity_is_what_each_object_says_and_none_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_preflight, "devices_at", lambda _link, nodes: {nodes[0]: [99]})
    table = {(0x1018, 1): 11, (0x1018, 2): 12, (0x1018, 3): 13, (0x1018, 4): 14, (0x6041, 0): 0x0250}
    texts = {0x1008: "F-Axis", 0x100A: "F514"}

    class Objects:
        node = 5

        def read(self, index: int, sub: int = 0) -> int:
            if (index, sub) not in table:
                raise SdoError("not there")
            return table[index, sub]

        def read_text(self, index: int) -> str:
            if index not in texts:
                raise SdoError("not there")
            return texts[index]

    link: Any = None
    objects: Any = Objects()
    full = {"node": 5, "device_type": 0x20192, "drive": True, "serials": [99], "vendor": 11, "product": 12,
            "revision": 13, "serial": 14, "name": "F-Axis", "firmware": "F514", "state": "DISABLED"}  # fmt: skip
    assert _preflight._identity(link, objects, 0x20192) == full
    assert _preflight._identity(link, objects, 0x20191)["drive"] is False
    table.clear()
    texts.clear()
    known = {"node", "device_type", "drive", "serials"}
    assert _preflight._identity(link, objects, 0x20192) == {k: v if k in known else None for k, v in full.items()}


@pytest.mark.parametrize(("at", "heard"), [(0.0, True), (0.99, True), (1.01, False)])
@pytest.mark.parametrize(("frame", "foreign"), [(Frame(0x080), True), (Frame(0x201), True), (Frame(0x27E), True),
                                                (Frame(0x27F), False), (Frame(0x181), False)])  # fmt: skip
def test_one_listens_for_a_second_to_every_number(at: float, heard: bool, frame: Frame, foreign: bool) -> None:
    line = Line()
    line.coming = [(0.0, Frame(0x181)), (at, frame)]
    if heard and foreign:
        with pytest.raises(CheckFailedError, match="another master is on the bus"):
            _preflight.require_alone(line)
        return
    _preflight.require_alone(line)
    assert line.now == 1.0
    # The pre-flight listens for its own drives: other numbers are not its own.
    line = Line()
    line.coming = [(0.5, Frame(0x204))]
    assert listen(line, [1, 2, 3]) == ""
    line.coming = [(line.now + 0.5, Frame(0x203))]
    assert listen(line, [1, 2, 3]) == "set-points to node 3"


# -- guarding ---------------------------------------------------------------------------------------------------------


def without(*indices: int) -> Profile:
    profile = ds402()
    return replace(profile, items={key: item for key, item in profile.items.items() if key[0] not in indices})


def test_a_drive_with_heartbeat_alone_is_accepted_and_guarded(monkeypatch: pytest.MonkeyPatch) -> None:
    """CiA 301 recommends heartbeat over life guarding, and newer drives have no 100Ch and 100Dh."""
    monkeypatch.setitem(PROFILES, "ds402", lambda: without(0x100C, 0x100D))
    file = replace(default_drives("ds402"), ramps=FAST)
    link = linked(file)
    report = preflight(link, file, homed=True)
    report.require()
    assert report.guarding == "heartbeat"
    ended = run_session(Session(file=file, link=link), jog_pilot(1, 0.1), sample_time=0.02, most=5.0)
    ended.require()
    # Its guarding is armed while it runs: a master that goes silent is noticed.
    preflight(link, file)
    link.send([Frame(0x77F, b"\x05")])
    wait(link, 0.3)
    assert [drive.axis.fault for drive in link.neck.drives] == [0x8130] * 3


@pytest.mark.parametrize(
    ("lacking", "wanted", "told"),
    [
        ((0x1016, 0x100C), "auto", r"no heartbeat guarding: it lacks 1016h and no life guarding: it lacks 100Ch"),
        ((0x1017, 0x100D), "auto", r"no heartbeat guarding: it lacks 1017h and no life guarding: it lacks 100Dh"),
        ((0x1016,), "heartbeat", r"no heartbeat guarding: it lacks 1016h\."),
        ((0x100C, 0x100D), "life", r"no life guarding: it lacks 100Ch, 100Dh\."),
    ],
)
def test_what_a_drive_lacks_to_be_guarded_is_named(
    monkeypatch: pytest.MonkeyPatch, lacking: tuple[int, ...], wanted: str, told: str
) -> None:
    monkeypatch.setitem(PROFILES, "ds402", lambda: without(*lacking))
    file = default_drives("ds402")
    file = replace(file, guarding=replace(file.guarding, kind=wanted))
    with pytest.raises(CheckFailedError, match=rf"node 1: guarding: {told}"):
        preflight(linked(file), file).require()
