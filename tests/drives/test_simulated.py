"""The simulated drives by themselves, spoken to with raw frames: what a manual says, without the master."""

from __future__ import annotations

import math
import signal
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.drives.simulated import SimulatedDrive, SimulatedNeck, SimulatedSettings
from softneck.drives.simulated.__main__ import signals
from softneck.drives.simulated._node import CanFrame
from softneck.plant import NeckParameters

CPR = 1539 / 65 * 2048 / (2 * math.pi)
SPEED = 65536 * 1e-3 * CPR  # units of 1 rad/s at a slow loop of 1 ms


def neck(profile: str = "ipos2015", *, homed: bool = True) -> SimulatedNeck:
    return SimulatedNeck(NeckParameters.paper(), SimulatedSettings(profile=profile, homed=homed))


class Talk:
    """Raw SDO and NMT with drive 1."""

    def __init__(self, virtual: SimulatedNeck) -> None:
        self.neck, self.now = virtual, 0.0
        self.said: list[CanFrame] = []
        self.frames(())

    def frames(self, frames: tuple[CanFrame, ...]) -> list[CanFrame]:
        answers = self.neck.run(frames, self.now)
        self.said += answers
        return answers

    def pass_time(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            self.neck.move()
            self.now += 0.01
            self.frames(())

    def write(self, index: int, subindex: int, value: int, size: int) -> int:
        """Return the abort code, 0 for none."""
        data = (value & ((1 << 8 * size) - 1)).to_bytes(size, "little").ljust(4, b"\0")
        command = 0x23 | ((4 - size) << 2)
        answer = self.frames((CanFrame(0x601, struct.pack("<BHB", command, index, subindex) + data),))[0]
        return int.from_bytes(answer.data[4:], "little") if answer.data[0] == 0x80 else 0

    def read(self, index: int, subindex: int = 0) -> int:
        answer = self.frames((CanFrame(0x601, struct.pack("<BHB4x", 0x40, index, subindex)),))[0]
        size = 4 - ((answer.data[0] >> 2) & 3)
        return int.from_bytes(answer.data[4 : 4 + size], "little", signed=True)

    def enable(self, mode: int) -> None:
        self.write(0x6060, 0, mode, 1)
        for word in (0x06, 0x07, 0x0F):
            self.write(0x6040, 0, word, 2)

    @property
    def drive(self) -> SimulatedDrive:
        return self.neck.drives[0]


def ready(profile: str = "ipos2015") -> Talk:
    talk = Talk(neck(profile))
    unit = SPEED if profile == "ipos2015" else CPR
    for index, value in ((0x6081, 2 * unit), (0x6083, 20 * unit * (1e-3 if profile == "ipos2015" else 1)),
                         (0x6085, 200 * unit * (1e-3 if profile == "ipos2015" else 1))):  # fmt: skip
        talk.write(index, 0, round(value), 4)
    if profile == "ipos2015":
        talk.write(0x207F, 0, 98, 2)
    else:
        talk.write(0x6073, 0, 498, 2)
    return talk


@pytest.mark.parametrize("profile", ["ipos2015", "ds402"])
def test_mode_1_moves_along_its_profile(profile: str) -> None:
    talk = ready(profile)
    talk.enable(1)
    start = talk.read(0x6064)
    talk.write(0x607A, 0, start + round(CPR), 4)
    talk.write(0x6040, 0, 0x1F, 2)
    talk.pass_time(0.3)
    # 2 rad/s after 0.1 s of 20 rad/s^2: 0.1 rad of acceleration, 0.4 rad at speed.
    assert (talk.drive.axis.motion[7] - start) / CPR == pytest.approx(0.5, abs=0.02)
    talk.pass_time(1.5)
    assert talk.read(0x6064) == pytest.approx(start + CPR, abs=0.02 * CPR)
    assert talk.read(0x6041) & 0x0400


@pytest.mark.parametrize("profile", ["ipos2015", "ds402"])
def test_mode_3_turns_at_the_speed_that_it_is_given(profile: str) -> None:
    talk = ready(profile)
    talk.enable(3)
    unit = SPEED if profile == "ipos2015" else CPR
    talk.write(0x60FF, 0, round(-1.0 * unit), 4)
    talk.pass_time(0.5)
    before = talk.read(0x6064)
    talk.pass_time(0.2)
    assert (talk.read(0x6064) - before) / CPR / 0.2 == pytest.approx(-1.0, abs=0.05)
    assert talk.read(0x606C) / unit == pytest.approx(-1.0, abs=0.05)


def test_the_mode_display_shows_8_only_when_enabled() -> None:
    talk = ready()
    talk.write(0x6060, 0, 8, 1)
    assert talk.read(0x6061) == 0
    talk.enable(8)
    assert talk.read(0x6061) == 8


def test_a_reset_loses_the_zero_and_says_so() -> None:
    talk = ready()
    assert talk.read(0x607C) == 1
    talk.frames((CanFrame(0x000, b"\x81\x01"),))
    assert CanFrame(0x701, b"\0") in talk.said
    assert talk.read(0x607C) == 0
    assert not talk.drive.axis.homed


@pytest.mark.parametrize(("option", "state"), [(0, 0x27), (1, 0x08), (2, 0x40), (3, 0x07)])
def test_6007h_decides_what_a_lost_master_means(option: int, state: int) -> None:
    talk = ready()
    for index, value, size in ((0x100C, 20, 2), (0x100D, 5, 1), (0x6007, option, 2), (0x605A, 6, 2)):
        assert talk.write(index, 0, value, size) == 0
    talk.enable(8)
    answer = talk.frames((CanFrame(0x701, b"", True),))
    assert answer[0].identifier == 0x701
    talk.pass_time(0.08)
    assert talk.drive.axis.state == 0x27
    talk.pass_time(0.32)
    assert talk.drive.axis.state == state
    assert next(frame for frame in talk.said if frame.identifier == 0x81).data[:2] == b"\x30\x81"


def test_a_stale_control_word_enables_again_after_6007h_3_and_605Ah_6_but_not_after_1() -> None:
    """Why the master writes 6007h = 1: the found danger of the other choice, shown."""
    states = {}
    for option in (1, 3):
        talk = ready()
        for index, value, size in ((0x100C, 20, 2), (0x100D, 5, 1), (0x6007, option, 2), (0x605A, 6, 2)):
            talk.write(index, 0, value, size)
        talk.enable(8)
        talk.frames((CanFrame(0x701, b"", True),))
        talk.pass_time(0.4)
        talk.write(0x6040, 0, 0x0F, 2)
        states[option] = talk.drive.axis.state
    assert states == {1: 0x08, 3: 0x27}


def test_guarding_answers_toggle_and_heartbeats_exclude_them() -> None:
    talk = ready()
    request = (CanFrame(0x701, b"", True),)
    assert [talk.frames(request)[0].data[0] >> 7 for _ in range(4)] == [0, 1, 0, 1]
    talk.write(0x1017, 0, 50, 2)
    assert talk.frames(request) == []
    talk.said.clear()
    talk.pass_time(1.0)
    assert len([frame for frame in talk.said if frame.identifier == 0x701]) == pytest.approx(20, abs=1)


def test_a_heartbeat_consumer_guards_too() -> None:
    talk = ready("ds402")
    talk.write(0x1016, 1, (127 << 16) | 100, 4)
    talk.write(0x6007, 0, 1, 2)
    talk.enable(8)
    for _ in range(20):
        talk.frames((CanFrame(0x77F, b"\x05"),))
        talk.pass_time(0.05)
    assert talk.drive.axis.state == 0x27
    talk.pass_time(0.2)
    assert talk.drive.axis.state == 0x08
    assert Talk(neck()).write(0x1016, 1, 1, 4) == 0x06020000


def test_mappings_change_only_while_their_pdo_is_off() -> None:
    talk = ready()
    assert talk.write(0x1600, 1, 0x60400010, 4) == 0
    assert talk.write(0x1600, 0, 1, 1) == 0
    assert talk.write(0x1400, 1, 0x201, 4) == 0
    assert talk.write(0x1600, 0, 0, 1) == 0x08000022
    assert talk.write(0x1A00, 1, 0x12340010, 4) == 0
    assert talk.write(0x1A00, 0, 1, 1) == 0x06090030


def test_texts_come_in_segments() -> None:
    talk = ready()
    first = talk.frames((CanFrame(0x601, struct.pack("<BHB4x", 0x40, 0x1008, 0)),))[0]
    size, text, toggle = int.from_bytes(first.data[4:], "little"), b"", 0
    while True:
        part = talk.frames((CanFrame(0x601, bytes([0x60 | toggle << 4, 0, 0, 0, 0, 0, 0, 0])),))[0]
        text += part.data[1 : 8 - ((part.data[0] >> 1) & 7)]
        toggle ^= 1
        if part.data[0] & 1:
            break
    assert text.decode() == "iPOS3604 MX-CAN (simulated)"
    assert size == len(text)


def test_tendons_pull_a_drive_without_power() -> None:
    virtual = neck()
    for _ in range(100):
        virtual.move()
    # The pretension of 3.25 N turns a winch against the 0.004 N m of its gear until 0.53 N are left.
    assert all(virtual.motion[i][24] < -1000 for i in range(3))


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(
    frames=st.lists(
        st.builds(CanFrame, st.sampled_from([0, 0x80, 0x201, 0x301, 0x601, 0x701, 0x7FF]), st.binary(max_size=8),
                  st.booleans()),
        max_size=8,
    )
)  # fmt: skip
def test_no_frame_crashes_a_drive(frames: list[CanFrame]) -> None:
    talk = ready()
    talk.frames(tuple(frames))
    talk.pass_time(0.01)
    assert math.isfinite(talk.drive.axis.motion[24])


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="needs SIGUSR1")
def test_signals_and_unplugged_sensor_can_be_practised() -> None:
    virtual = neck()
    before = signal.getsignal(signal.SIGUSR1)
    with signals(virtual):
        for pressed in (True, False):
            signal.raise_signal(signal.SIGUSR1)
            signal.raise_signal(signal.SIGUSR2)
            assert [drive.axis.enable_input for drive in virtual.drives] == [not pressed] * 3
            assert virtual.sensor == ("silent" if pressed else "works")
    assert signal.getsignal(signal.SIGUSR1) is before


@pytest.mark.parametrize(
    ("kind", "moves", "told"),
    [
        (1, True, list(range(30))),
        (10, True, [9, 19, 29]),
        (240, True, []),
        # With the SYNC after a change: the first value, and each of a control word that comes and goes.
        (0, False, [0]),
        (0, True, [0, 5, 6]),
        (255, False, []),
    ],
)
def test_a_tpdo_of_type_n_comes_with_each_nth_sync(kind: int, moves: bool, told: list[int]) -> None:
    """CiA 301, 7.5.2.35; type 10 came with each SYNC here, until a slave that others wrote did not."""
    talk = ready()
    for index, subindex, value, size in (
        (0x1800, 1, 0x80000181, 4), (0x1A00, 0, 0, 1), (0x1A00, 1, 0x60400010, 4), (0x1A00, 0, 1, 1),
        (0x1800, 2, kind, 1), (0x1800, 1, 0x181, 4),
    ):  # fmt: skip
        talk.write(index, subindex, value, size)
    talk.frames((CanFrame(0x000, b"\x01\x01"),))
    came = []
    for sync in range(30):
        if moves and sync in (5, 6):
            talk.write(0x6040, 0, 6 if sync == 5 else 0, 2)
        answers = talk.frames((CanFrame(0x080, b""),))
        came += [sync for frame in answers if frame.identifier == 0x181]
    assert came == told
