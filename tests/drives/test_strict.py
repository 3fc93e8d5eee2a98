"""Simulated drives as strict as drives are: transfers, PDO types, error objects and answers that take their time.

Each quirk can be switched; python-canopen's client, which others wrote, is the second opinion on the transfers.
"""

from __future__ import annotations

import queue
import struct
from typing import Any

import pytest
from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

from softneck.drives.master import Phase
from softneck.drives.simulated import SimulatedNeck, SimulatedSettings
from softneck.drives.simulated._node import CanFrame
from softneck.drives.simulated._quirks import DriveQuirks
from softneck.drives.simulated._sdo import SdoServer
from softneck.plant import NeckParameters

from .bench import Bench
from .pairwise import all_pairs, covering, pairs_of
from .scenarios import SCENARIOS


def neck(profile: str = "ipos2015", **quirks: Any) -> SimulatedNeck:
    return SimulatedNeck(NeckParameters.paper(), SimulatedSettings(profile=profile, quirks=DriveQuirks(**quirks)))


class Direct:
    """What canopen's client needs of a network: each frame goes to an SDO server, answers into the client's queue."""

    def __init__(self, server: SdoServer) -> None:
        self.server = server
        self.client = SdoClient(0x601, 0x581, ObjectDictionary())
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


def server(memory: Memory) -> SdoServer:
    return SdoServer(memory.read, memory.write, lambda *_: len(memory.content))


# -- transfers --------------------------------------------------------------------------------------------------------


@given(content=st.binary(min_size=1, max_size=600))
def test_what_a_foreign_client_uploads_is_what_is_there(content: bytes) -> None:
    assert Direct(server(Memory(content))).client.upload(0x1008, 0) == content


@given(content=st.binary(min_size=1, max_size=4), said=st.booleans())
def test_what_a_foreign_client_downloads_is_there(content: bytes, said: bool) -> None:
    memory = Memory(bytes(len(content)))
    client = Direct(server(memory)).client
    if said:
        client.download(0x6081, 0, content)
    else:
        client.request_response(struct.pack("<BHB4s", 0x22, 0x6081, 0, content))
    assert memory.content == content


def test_what_is_longer_than_any_object_is_refused() -> None:
    direct = Direct(server(Memory(b"a long text")))
    for block in (False, True):
        with (
            pytest.raises(SdoAbortedError, match="0x05040001"),
            direct.client.open(0x1008, 0, "wb", size=9, block_transfer=block) as stream,
        ):
            stream.write(b"too long ")  # pyright: ignore[reportArgumentType]


@given(frames=st.lists(st.binary(min_size=8, max_size=8), max_size=30))
def test_no_order_of_requests_confuses_a_server(frames: list[bytes]) -> None:
    memory = Memory(b"a text of more than seven bytes")
    serving = server(memory)
    for frame in frames:
        assert all(len(answer) == 8 for answer in serving.answers(frame))
    # An abort of the client ends whatever ran; then all is as at first.
    serving.answers(struct.pack("<B7x", 0x80))
    memory.content = b"after"
    assert Direct(serving).client.upload(0x1008, 0) == b"after"


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
    direct = Direct(SdoServer(drive.axis.read, drive._write, drive.axis.size))
    with pytest.raises(SdoAbortedError) as refused:
        direct.client.download(index, subindex, data)
    assert refused.value.code == code


# -- PDOs and error objects -------------------------------------------------------------------------------------------


class Talk:
    """Drive 1, operational, with a TPDO of the status word."""

    def __init__(self, kind: int) -> None:
        self.virtual, self.now = neck(), 0.0
        drive = self.drive = self.virtual.drives[0]
        for index, subindex, data in (
            (0x1800, 1, struct.pack("<I", 0x80000181)), (0x1A00, 0, b"\0"),
            (0x1A00, 1, struct.pack("<I", 0x60410010)), (0x1A00, 0, b"\1"), (0x1800, 2, bytes([kind])),
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


def test_a_type_255_tells_what_changed_and_only_that() -> None:
    talk = Talk(255)
    # What is there first is a change, and was told at t = 0.
    assert talk.told(0.1) == []
    words = iter(range(1000))
    talk.drive._transmit_pdos[0].actions[0] = lambda: next(words)
    assert len(talk.told(0.1)) == 100


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
    "mode_when": ("always", "off", "enabled"),
    "write_only": (False, True),
    "profile": ("ipos2015", "ds402"),
}


def test_every_pair_stands_in_the_covering_array() -> None:
    rows = covering({"fault": tuple(SCENARIOS), **SWITCHES})
    assert all_pairs({"fault": tuple(SCENARIOS), **SWITCHES}) == set().union(*map(pairs_of, rows))
    # At least a row for each fault with each of the three latencies; all products would be 36 for each.
    assert 3 * len(SCENARIOS) <= len(rows) <= 4 * len(SCENARIOS)


def play(row: dict[str, Any]) -> None:
    scenario = SCENARIOS[row["fault"]]
    quirks = DriveQuirks(sdo_latency=row["sdo_latency"], mode_when=row["mode_when"], write_only=row["write_only"])
    bench = Bench(off=scenario.others_off, change=scenario.change, profile=row["profile"], quirks=quirks).start()
    assert bench.phase is Phase.RUNNING
    scenario.play(bench)


ROWS = covering({"fault": tuple(SCENARIOS), **SWITCHES})


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row["fault"])
def test_the_master_passes_the_fault_table_under_all_pairs_of_switches(row: dict[str, Any]) -> None:
    play(row)
