"""The cyclic traffic, frame by frame: what is read, what is missed and when, and what is sent."""

from __future__ import annotations

import struct

from softneck.drives.master import Frame
from softneck.drives.master._cia402 import DriveState, Goal
from softneck.drives.master._fieldbus import BUS_OFF, BusSettings, Fieldbus, NodeState

T = 0.01
OFF = (Goal.OFF,) * 3


def tpdo(node: int, *, word: int = 0x1637, counts: int = 0, current: int = 0) -> Frame:
    return Frame(0x180 + node, struct.pack("<Hih", word, counts, current))


def play(
    bus: Fieldbus, cycles: int, *, nodes: tuple[int, ...] = (1, 2, 3), first: int = 0
) -> list[tuple[int, str, int]]:
    """Let `nodes` answer for some cycles; return (cycle, name, node) of what was told."""
    told = []
    for k in range(first, first + cycles):
        told += [(k, event.name, event.node) for event in bus.receive(k * T, [tpdo(node) for node in nodes])]
        bus.send(OFF, (0, 0, 0))
    return told


def test_a_position_is_read_with_its_sign_and_its_bytes() -> None:
    bus = Fieldbus(BusSettings())
    # CiA 301 sends the lowest byte first: status word, position (32 bits), current (16 bits).
    bus.receive(0.0, [Frame(0x182, bytes([0x27, 0x06, 0xFE, 0xFF, 0xFF, 0xFF, 0x9C, 0xFF]))])
    view = bus.drives[1]
    assert (view.word, view.state, view.counts, view.current) == (0x0627, DriveState.ENABLED, -2, -100)
    assert (view.fresh, view.heard, view.silent) == (True, True, 0)
    assert not bus.drives[0].fresh
    assert not bus.drives[0].heard
    bus.receive(T, [])
    assert not view.fresh
    assert view.silent == 1


def test_what_is_not_eight_bytes_long_is_no_position() -> None:
    bus = Fieldbus(BusSettings())
    for size in (0, 7):
        events = bus.receive(0.0, [Frame(0x181, bytes(size))])
        assert [(event.name, event.node, event.detail) for event in events] == [
            ("frame_length", 1, f"TPDO of {size} byte(s)")
        ]
    assert not bus.drives[0].heard
    events = bus.receive(0.0, [Frame(0x081, bytes(2)), Frame(0x701, b""), Frame(0x701, bytes(2))])
    assert [(event.name, event.node) for event in events] == [("frame_length", 1)] * 3
    assert bus.drives[0].answered is None


def test_a_late_position_is_no_second_device_and_a_second_device_is_told_after_half_a_second() -> None:
    bus, told = Fieldbus(BusSettings()), []
    # Each fifth position comes one cycle late: as many as SYNCs, for ten seconds.
    for k in range(1000):
        frames = [tpdo(1), tpdo(3), *([tpdo(2)] * {3: 0, 4: 2}.get(k % 5, 1))]
        told += [(event.name, event.node) for event in bus.receive(k * T, frames)]
    assert set(told) == {("tpdo_twice", 2)}
    assert len(told) == 200
    bus, when = Fieldbus(BusSettings()), {}
    for k in range(60):
        for event in bus.receive(k * T, [tpdo(1), tpdo(2), tpdo(3), tpdo(3)]):
            when.setdefault((event.name, event.node), k)
    assert when == {("tpdo_twice", 3): 0, ("node_twice", 3): 49}


def test_a_drive_that_is_silent_is_told_after_five_cycles_and_then_each_hundred() -> None:
    bus = Fieldbus(BusSettings())
    assert play(bus, 3) == []
    told = play(bus, 220, nodes=(1, 3), first=3)
    assert told == [(3 + 4, "tpdo_missing", 2), (3 + 99, "tpdo_missing", 2), (3 + 199, "tpdo_missing", 2)]
    assert bus.drives[1].silent == 220
    assert play(bus, 1, first=223) == []
    assert bus.drives[1].silent == 0


def test_a_dead_bus_is_told_from_the_third_cycle_on_and_only_after_it_lived() -> None:
    bus = Fieldbus(BusSettings(missing_cycles=1000))
    # Before every drive was heard nothing is known to be dead.
    assert play(bus, 10, nodes=(1, 2)) == []
    assert play(bus, 10, nodes=(), first=10) == []
    bus = Fieldbus(BusSettings(missing_cycles=1000))
    play(bus, 2)
    assert play(bus, 5, nodes=(), first=2) == [(k, "bus_silent", 0) for k in (4, 5, 6)]
    # One drive that answers is enough for the cable.
    assert play(bus, 5, nodes=(2,), first=7) == []


def test_the_first_cycle_knows_nothing_of_silence() -> None:
    bus = Fieldbus(BusSettings(silent_cycles=1, missing_cycles=1000))
    for view in bus.drives:
        view.heard = True
    assert bus.receive(0.0, []) == []


def test_the_adapter_that_is_gone_is_told_and_other_errors_of_it_are_not() -> None:
    bus = Fieldbus(BusSettings())
    events = bus.receive(0.0, [Frame(0x181, b"", error=True), BUS_OFF, tpdo(1)])
    assert [event.name for event in events] == ["bus_off"]
    # What comes after it in the same cycle is read all the same.
    assert bus.drives[0].fresh


def test_frames_that_only_a_master_sends_are_another_master() -> None:
    settings = BusSettings(nodes=(5, 6, 7), master=100)
    ours = [0x000, 0x080, 0x100, 0x700 + 100]
    ours += [base + node for base in (0x200, 0x300, 0x400, 0x500, 0x600) for node in settings.nodes]
    # Remote requests of what drives send are a master's too.
    for identifier in range(0x800):
        bus = Fieldbus(settings)
        # An empty frame of a drive has the wrong length, and is no master's.
        told = [event for event in bus.receive(0.0, [Frame(identifier, b"")]) if event.name != "frame_length"]
        assert [event.name for event in told] == (["second_master"] if identifier in ours else []), hex(identifier)
        assert all(event.detail == f"frame {identifier:03X}h, not sent by us" for event in told)
    drives = [base + node for base in (0x080, 0x180, 0x700) for node in settings.nodes]
    for identifier in range(0x800):
        bus = Fieldbus(settings)
        told = [(event.name, event.detail) for event in bus.receive(0.0, [Frame(identifier, b"", remote=True)])]
        assert [name for name, _ in told] == (["second_master"] if identifier in {*ours, *drives} else [])
        assert all(text == f"request {identifier:03X}h, not sent by us" for _, text in told)


def test_emergencies_are_told_with_what_they_say_and_limits_are_none() -> None:
    bus = Fieldbus(BusSettings())

    def told(code: int) -> list[tuple[str, int]]:
        frame = Frame(0x083, struct.pack("<HB5x", code, 0x21))
        return [(event.name, event.node) for event in bus.receive(0.5, [*map(tpdo, (1, 2, 3)), frame])]

    assert told(0x7305) == [("emergency", 3)]
    assert told(0xFF06) == told(0xFF07) == [("drive_limit", 3)]
    assert told(0xFF05) == told(0xFF08) == [("emergency", 3)]
    # Code 0 says that all is well again.
    assert told(0x0000) == []
    assert bus.drives[2].emergencies[0] == (0.5, 0x7305, 0x21)
    assert len(bus.drives[2].emergencies) == 6
    # Three bytes are enough, as some drives send them.
    assert bus.receive(0.5, [*map(tpdo, (1, 2, 3)), Frame(0x083, bytes([0x05, 0x73, 0x21]))])
    for _ in range(30):
        told(0x1000)
    # The last twenty are kept.
    assert [code for _, code, _ in bus.drives[2].emergencies] == [0x1000] * 20


def test_an_answer_with_the_old_toggle_bit_counts_as_none() -> None:
    bus = Fieldbus(BusSettings())
    view = bus.drives[0]
    bus.receive(0.0, [Frame(0x701, bytes([0x05]))])
    assert (view.answered, view.nmt) == (0.0, NodeState.OPERATIONAL)
    bus.receive(0.1, [Frame(0x701, bytes([0x05]))])
    assert view.answered == 0.0
    bus.receive(0.2, [Frame(0x701, bytes([0x85]))])
    assert view.answered == 0.2
    # A heartbeat has no toggle bit.
    beating = Fieldbus(BusSettings(guarding="heartbeat"))
    for now in (0.0, 0.1):
        beating.receive(now, [Frame(0x701, bytes([0x05]))])
    assert beating.drives[0].answered == 0.1


def test_a_missing_answer_is_told_after_its_time_and_once_in_it() -> None:
    bus = Fieldbus(BusSettings(answer_time=0.25))
    bus.receive(0.0, [Frame(0x702, bytes([0x05]))])
    told = []
    for k in range(1, 61):
        # Half a millisecond beside the border, which rounding may put on either side.
        told += [k for event in bus.receive(k * T + 5e-4, []) if event.name == "heartbeat_missing"]
    assert told == [25, 51]


def test_what_a_node_says_of_itself_is_told() -> None:
    bus = Fieldbus(BusSettings())
    assert [event.name for event in bus.receive(0.0, [Frame(0x701, b"\0")])] == ["boot_up"]
    assert bus.drives[0].nmt is NodeState.PRE_OPERATIONAL
    # A boot-up message is no answer to guarding.
    assert bus.drives[0].answered is None
    assert [event.name for event in bus.receive(0.0, [Frame(0x701, b"\x04")])] == ["node_left"]
    assert bus.drives[0].nmt is NodeState.STOPPED
    assert bus.receive(0.0, [Frame(0x701, b"\x85")]) == []


def test_each_cycle_sends_set_points_sync_and_every_other_one_guarding() -> None:
    bus = Fieldbus(BusSettings(nodes=(4, 5, 6)))
    guards = [Frame(0x700 + node, b"\0", remote=True) for node in (4, 5, 6)]
    for k in range(6):
        sent = bus.send(OFF, (1, -2, 70000))
        assert sent[:3] == [
            Frame(0x200 + node, struct.pack("<Hi", 0, target))
            for node, target in zip((4, 5, 6), (1, -2, 70000), strict=True)
        ]
        assert sent[3] == Frame(0x080)
        assert sent[4:] == (guards if k % 2 == 0 else [])
    assert bus.send(OFF, (0, 0, 0), guard=False)[4:] == []
    beating = Fieldbus(BusSettings(guarding="heartbeat", guard_cycles=3, master=120))
    beats = [beating.send(OFF, (0, 0, 0))[4:] for _ in range(4)]
    assert beats == [[Frame(0x700 + 120, bytes([5]))], [], [], [Frame(0x700 + 120, bytes([5]))]]


def test_the_nodes_are_started_one_by_one() -> None:
    assert Fieldbus(BusSettings(nodes=(4, 5, 6))).start() == [Frame(0, bytes([1, node])) for node in (4, 5, 6)]


def test_a_drive_whose_mode_was_refused_is_asked_once_when_it_is_enabled_and_should_be() -> None:
    """6060h := 8 by SDO (CiA 301, 7.2.4.3.3), to that drive alone; the others go on as before."""
    order = bytes([0x2F, 0x60, 0x60, 0, 8, 0, 0, 0])
    for late in (1, 2, 3):
        bus = Fieldbus(BusSettings(late_modes=(late,)))
        assert [view.mode for view in bus.drives] == ["missing" if k == late else "taken" for k in (1, 2, 3)]

        def asked(goal: Goal, word: int, bus: Fieldbus = bus) -> list[Frame]:
            bus.receive(0.0, [tpdo(node, word=word) for node in (1, 2, 3)])
            return [frame for frame in bus.send((goal,) * 3, (0, 0, 0)) if frame.identifier >> 7 == 0x600 >> 7]

        assert asked(Goal.ENABLED, 0x0631) == asked(Goal.OFF, 0x0637) == []
        assert not bus.drives[late - 1].follows
        assert asked(Goal.ENABLED, 0x0637) == [Frame(0x600 + late, order)]
        assert asked(Goal.ENABLED, 0x0637) == []
        assert [view.follows for view in bus.drives] == [k != late for k in (1, 2, 3)]
        bus.receive(0.0, [tpdo(late, word=0x0637), Frame(0x580 + late, bytes([0x60, 0x60, 0x60, 0, 0, 0, 0, 0]))])
        assert bus.drives[late - 1].follows
