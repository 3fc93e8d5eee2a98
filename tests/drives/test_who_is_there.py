"""Who is on the bus: scan and pre-flight against two devices with one number, a short queue, and other guarding."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import pytest

from softneck.cli._main import run
from softneck.core import CheckFailedError
from softneck.drives import DrivesFile, default_drives, preflight, reset, scan, simulated_neck
from softneck.drives.bus._link import VirtualLink, reason
from softneck.drives.bus._sdo import Objects
from softneck.drives.commissioning._jog import jog_pilot
from softneck.drives.master import Frame
from softneck.drives.running._bus_loop import Session, run_session
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
