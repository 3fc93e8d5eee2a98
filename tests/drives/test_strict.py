"""Simulated drives as strict as drives are: transfers, PDO types, error objects and a wire that takes its time.

Each habit can be switched; python-canopen's client, which others wrote, is the second opinion on the transfers.
"""

from __future__ import annotations

import queue
import struct
from typing import Any

import pytest
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

from softneck.drives.bus._sdo import load_eds
from softneck.drives.master import Phase
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings
from softneck.drives.simulated._frame import CanFrame
from softneck.drives.simulated._habits import WireHabits
from softneck.drives.simulated._sdo import SdoServer
from softneck.drives.simulated._wire import Wire, frame_bits
from softneck.plant import NeckParameters

from .bench import Bench
from .pairwise import all_pairs, covering, pairs_of
from .scenarios import SCENARIOS

IPOS = load_eds("ipos2015")


def neck(profile: str = "ipos2015", **habits: Any) -> SimulatedNeck:
    return SimulatedNeck(NeckParameters.paper(), SimulatedSettings(profile=profile, habits=WireHabits(**habits)))


class Direct:
    """What canopen's client needs of a network: each frame goes to an SDO server, answers into the client's queue."""

    def __init__(self, server: SdoServer) -> None:
        self.server = server
        self.client = SdoClient(0x601, 0x581, IPOS)
        self.client.RESPONSE_TIMEOUT = 0.0
        self.client.network = self  # pyright: ignore[reportAttributeAccessIssue]
        self.client.responses = queue.Queue()

    def send_message(self, _identifier: int, data: bytes, _remote: bool = False) -> None:
        for answer in self.server.answers(bytes(data)):
            self.client.responses.put(answer)


class Memory:
    """One object of any length."""

    def __init__(self, content: bytes = b"") -> None:
        self.content = content

    def read(self, _index: int, _subindex: int) -> bytes:
        return self.content

    def write(self, _index: int, _subindex: int, data: bytes) -> int:
        self.content = data
        return 0


# -- transfers --------------------------------------------------------------------------------------------------------


@given(content=st.binary(min_size=1, max_size=600), block=st.booleans())
def test_what_a_foreign_client_uploads_is_what_is_there(content: bytes, block: bool) -> None:
    direct = Direct(SdoServer(Memory(content).read, Memory().write))
    with direct.client.open(0x1008, 0, "rb", block_transfer=block) as stream:
        assert stream.read() == content


@given(content=st.binary(min_size=1, max_size=600), block=st.booleans(), said=st.booleans())
def test_what_a_foreign_client_downloads_is_there(content: bytes, block: bool, said: bool) -> None:
    memory = Memory()
    direct = Direct(SdoServer(memory.read, memory.write))
    # canopen's own block transfer needs the size: without one it cannot tell which frame is the last.
    size = len(content) if said or block else None
    with direct.client.open(0x1008, 0, "wb", size=size, block_transfer=block, force_segment=True) as stream:
        stream.write(content)  # pyright: ignore[reportArgumentType]
    assert memory.content == content


def test_plain_servers_refuse_what_small_drives_refuse() -> None:
    direct = Direct(SdoServer(Memory(b"a long text").read, Memory().write, plain=True))
    assert direct.client.upload(0x1008, 0) == b"a long text"
    for block in (False, True):
        with (
            pytest.raises(SdoAbortedError, match="0x05040001"),
            direct.client.open(0x1008, 0, "wb", size=9, block_transfer=block) as stream,
        ):
            stream.write(b"too long ")  # pyright: ignore[reportArgumentType]


@given(frames=st.lists(st.binary(min_size=8, max_size=8), max_size=30))
def test_no_order_of_requests_confuses_a_server(frames: list[bytes]) -> None:
    memory = Memory(b"a text of more than seven bytes")
    server = SdoServer(memory.read, memory.write)
    for frame in frames:
        assert all(len(answer) == 8 for answer in server.answers(frame))
    # An abort of the client ends whatever ran; then all is as at first.
    server.answers(struct.pack("<B7x", 0x80))
    server.answers(struct.pack("<B7x", 0x80))
    memory.content = b"after"
    assert Direct(server).client.upload(0x1008, 0) == b"after"


def test_an_expedited_write_without_size_takes_that_of_the_object() -> None:
    virtual = neck()
    virtual.run((), 0.0)
    answer = virtual.run([CanFrame(0x601, struct.pack("<BHBI", 0x22, 0x6007, 0, 1))], 0.0)
    assert answer == [CanFrame(0x581, struct.pack("<BHB4x", 0x60, 0x6007, 0))]
    assert virtual.drives[0].axis.values[(0x6007, 0)] == 1


@pytest.mark.parametrize(
    ("index", "subindex", "data", "code"),
    [
        (0x6041, 0, b"\0\0", 0x06010002),  # read only
        (0x1234, 0, b"\0", 0x06020000),  # no such object
        (0x1018, 9, b"\0", 0x06090011),  # no such entry
        (0x6060, 0, b"\7", 0x06090030),  # mode 7, PT and PVT: these drives do not have it here
        (0x6060, 0, b"\7\0", 0x06070010),  # of another length
        (0x1800, 2, b"\xf1", 0x06090030),  # TPDO type 241 is reserved
        (0x1003, 0, b"\1", 0x06090030),  # a history is cleared, not written
    ],
)
def test_each_refusal_has_its_code(index: int, subindex: int, data: bytes, code: int) -> None:
    drive = neck().drives[0]
    direct = Direct(SdoServer(drive.axis.read, drive._write))
    with pytest.raises(SdoAbortedError) as refused:
        direct.client.download(index, subindex, data)
    assert refused.value.code == code


# -- PDOs and error objects -------------------------------------------------------------------------------------------


class Talk:
    """Drive 1, operational, with a TPDO of the status word."""

    def __init__(self, kind: int, *, inhibit: int = 0, timer: int = 0) -> None:
        self.virtual, self.now = neck(), 0.0
        drive = self.drive = self.virtual.drives[0]
        for index, subindex, data in (
            (0x1800, 1, struct.pack("<I", 0x80000181)), (0x1A00, 0, b"\0"),
            (0x1A00, 1, struct.pack("<I", 0x60410010)), (0x1A00, 0, b"\1"), (0x1800, 2, bytes([kind])),
            (0x1800, 3, struct.pack("<H", inhibit)), (0x1800, 5, struct.pack("<H", timer)),
            (0x1800, 1, struct.pack("<I", 0x181)),
        ):  # fmt: skip
            assert drive._write(index, subindex, data) == 0
        self.say(CanFrame(0x000, b"\x01\x00"))

    def say(self, *frames: CanFrame) -> list[CanFrame]:
        return [frame for frame in self.virtual.run(frames, self.now) if frame.identifier in (0x181, 0x81)]

    def told(self, seconds: float) -> list[float]:
        """When the TPDO came, ms by ms."""
        moments = []
        for _ in range(round(seconds * 1000)):
            self.now += 0.001
            if self.say():
                moments.append(round(self.now, 3))
        return moments


@pytest.mark.parametrize("kind", [1, 252, 253, 255])
def test_a_remote_request_is_answered_by_all_types_unless_it_is_forbidden(kind: int) -> None:
    talk, ask = Talk(kind), CanFrame(0x181, b"", True)
    talk.say(CanFrame(0x80, b""))
    answers = talk.say(ask)
    assert [frame.identifier for frame in answers] == [0x181]
    talk.drive._write(0x1800, 1, struct.pack("<I", 0x40000181))  # no remote requests (CiA 301, table 70)
    talk.say()  # what is sent because of a change
    assert talk.say(ask) == []


def test_type_252_answers_with_what_it_had_at_the_last_sync_and_253_with_what_it_has() -> None:
    ask, words = CanFrame(0x181, b"", True), {}
    for kind in (252, 253):
        talk = Talk(kind)
        assert talk.say(CanFrame(0x80, b"")) == [], "neither comes with SYNC"
        before = talk.say(ask)[0].data
        talk.drive.axis.trip(0x4310)
        words[kind] = (before, [frame.data for frame in talk.say(ask) if frame.identifier == 0x181][-1])
        talk.say(CanFrame(0x80, b""))
        assert talk.say(ask)[-1].data != before, "the next SYNC samples again"
    assert words[252][0] == words[252][1]
    assert words[253][0] != words[253][1]


def test_the_event_timer_sends_without_a_change_and_only_then() -> None:
    # What is there first is a change, and was told at t = 0.
    assert Talk(255).told(0.5) == []
    assert Talk(255, timer=50).told(0.5) == [pytest.approx(0.05 * k) for k in range(1, 11)]


def test_the_inhibit_time_lies_between_two_that_changed() -> None:
    free, slow = Talk(255), Talk(255, inhibit=200)  # of 0.1 ms
    for talk in (free, slow):
        words = iter(range(1000))
        talk.drive._transmit_pdos[0].actions[0] = lambda words=words: next(words)
    assert len(free.told(0.1)) == 100
    assert slow.told(0.1) == [pytest.approx(0.02 * k) for k in range(1, 6)]


def test_the_history_holds_the_newest_error_first_and_zero_clears_it() -> None:
    talk = Talk(1)
    axis = talk.drive.axis
    axis.emergencies.extend([(0x3210, 4), (0x4310, 8)])
    talk.say()
    values = [axis.values[(0x1003, place)] for place in range(3)]
    assert values == [2, 0x4310, 0x3210]
    assert talk.drive._write(0x1003, 0, b"\0") == 0
    axis.emergencies.append((0x8130, 16))
    talk.say()
    assert [axis.values[(0x1003, place)] for place in range(2)] == [1, 0x8130]


def test_emergencies_and_sync_follow_their_identifiers() -> None:
    talk = Talk(1)
    axis = talk.drive.axis
    assert (axis.values[(0x1014, 0)], axis.values[(0x1200, 1)], axis.values[(0x1200, 2)]) == (0x81, 0x601, 0x581)
    assert talk.drive._write(0x1014, 0, struct.pack("<I", 0x80000081)) == 0
    axis.trip(0x4310)
    assert [frame.identifier for frame in talk.say()] == [], "an emergency that is switched off is not sent"
    assert talk.drive._write(0x1005, 0, struct.pack("<I", 0x70)) == 0
    assert talk.say(CanFrame(0x80, b"")) == []
    assert [frame.identifier for frame in talk.say(CanFrame(0x70, b""))] == [0x181]


def test_the_lab_s_registers_say_that_a_fault_holds() -> None:
    axis = Talk(1).drive.axis
    assert (axis.read(0x2000, 0), axis.read(0x2002, 0)) == (b"\0\0", b"\0\0")
    axis.trip(0x8611)
    assert axis.read(0x2000, 0) != b"\0\0"


# -- the wire ---------------------------------------------------------------------------------------------------------


def test_a_frame_of_eight_bytes_takes_135_bits_at_most() -> None:
    """Davis et al. 2007, table 1: 135 bit times for 8 bytes; 55 for none."""
    assert [frame_bits(CanFrame(1, bytes(n))) for n in (0, 8)] == [55, 135]


frames = st.builds(CanFrame, st.integers(0x181, 0x77F), st.binary(max_size=8))
saying = st.lists(st.lists(frames, max_size=6), min_size=3, max_size=3)
bursts = st.lists(st.tuples(st.floats(0.0, 0.02), saying), max_size=20)


@given(bursts=bursts, rate=st.sampled_from([20_000.0, 125_000.0, 1e6]), held=st.integers(0, 5))
def test_no_wire_carries_more_than_its_rate_and_nothing_vanishes(
    bursts: list[tuple[float, list[list[CanFrame]]]], rate: float, held: int
) -> None:
    wire, now, sent, out = Wire(WireHabits(bitrate=rate, queue=held), 0.01), 0.0, 0, []
    for pause, said in bursts:
        now += pause
        sent += sum(map(len, said))
        came = wire.passed(now, (), said)
        out += came
        # One cycle's worth may come out at once.
        assert wire.bits <= rate * (now + 0.01) + 1e-6
    for _ in range(10_000):
        now += 0.01
        out += wire.passed(now, (), ((), (), ()))
    assert len(out) + sum(wire.lost.values()) == sent
    assert not held or not sum(wire.lost.values()) or sent > held


@given(said=saying)
def test_of_what_waits_the_lowest_identifier_goes_first(said: list[list[CanFrame]]) -> None:
    out = Wire(WireHabits(bitrate=1e6), 0.1).passed(0.0, (), said)
    waiting = [list(frames) for frames in said]
    for frame in out:
        heads = [queued[0] for queued in waiting if queued]
        assert frame.identifier == min(head.identifier for head in heads)
        next(queued for queued in waiting if queued and queued[0] == frame).pop(0)
    assert not any(waiting)


def test_a_full_queue_loses_frames_and_tells_it() -> None:
    virtual = neck(queue=2, bitrate=20_000.0)
    read = CanFrame(0x601, struct.pack("<BHB4x", 0x40, 0x6041, 0))
    answers = virtual.run([read] * 6, 0.0)
    for k in range(1, 30):
        answers += virtual.run((), 0.01 * k)
    emergencies = [struct.unpack("<H", frame.data[:2])[0] for frame in answers if frame.identifier == 0x81]
    assert emergencies == [0x8110]
    assert sum(frame.identifier == 0x581 for frame in answers) < 6


@pytest.mark.parametrize("latency", [0.001, 0.03, 0.05])
def test_an_sdo_answer_comes_after_its_latency_and_a_pdo_at_once(latency: float) -> None:
    virtual = neck(sdo_latency=latency)
    virtual.run((), 0.0)
    read = CanFrame(0x601, struct.pack("<BHB4x", 0x40, 0x6041, 0))
    assert virtual.run([read, CanFrame(0x701, b"", True)], 1.0) == [CanFrame(0x701, b"\x7f")]
    assert virtual.run((), 1.0 + latency - 1e-6) == []
    assert [frame.identifier for frame in virtual.run((), 1.0 + latency)] == [0x581]


# -- the master on all of it ------------------------------------------------------------------------------------------

SWITCHES: dict[str, tuple[Any, ...]] = {
    "sdo_latency": (0.0, 0.001, 0.05),
    "queue": (0, 4),
    "bitrate": (0.0, 500e3, 1e6),
    "plain_sdo": (False, True),
    "mode_when": ("always", "off", "enabled"),
    "quirks": ((), ("write_only", "one_abort", "plain_pdo")),
    "profile": ("ipos2015", "ds402"),
}


def test_every_pair_stands_in_the_covering_array() -> None:
    rows = covering({"fault": tuple(SCENARIOS), **SWITCHES})
    assert all_pairs({"fault": tuple(SCENARIOS), **SWITCHES}) == set().union(*map(pairs_of, rows))
    # At least a row for each fault with each of the three latencies; all products would be 432 for each.
    assert 3 * len(SCENARIOS) <= len(rows) <= 4 * len(SCENARIOS)


def play(row: dict[str, Any]) -> None:
    scenario = SCENARIOS[row["fault"]]
    named = ("sdo_latency", "queue", "bitrate", "plain_sdo", "mode_when")
    given: dict[str, Any] = {name: row[name] for name in named} | dict.fromkeys(row["quirks"], True)
    habits = WireHabits(**given)
    bench = Bench(off=scenario.others_off, change=scenario.change, profile=row["profile"], habits=habits).start()
    assert bench.phase is Phase.RUNNING
    scenario.play(bench)


ROWS = covering({"fault": tuple(SCENARIOS), **SWITCHES})


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["fault"])
def test_the_master_passes_the_fault_table_under_all_pairs_of_switches(row: dict[str, Any]) -> None:
    play(row)
