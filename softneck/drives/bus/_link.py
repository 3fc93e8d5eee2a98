"""Links that carry frames: simulated drives in virtual time, or a bus of python-can."""

from __future__ import annotations

import contextlib
import errno
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

from softneck.core import SettingsError, SoftneckError

from ..master import Frame
from ..master._fieldbus import BUS_OFF
from ..master._gate import Reading
from ..simulated._drives import SimulatedDrives
from ..simulated._node import CanFrame

# Interfaces whose far end is a program on this machine: no drive can be behind them.
HARMLESS = ("virtual", "udp_multicast")


class BusError(SoftneckError):
    """A bus cannot be opened or does not work; the message names bus and reason."""


class Link(Protocol):
    """Sends and receives frames; its clock is monotonic."""

    @property
    def problem(self) -> str:
        """Why frames no longer pass, "" while they do."""
        ...

    @property
    def now(self) -> float:
        """Time [s]."""
        ...

    def send(self, frames: Sequence[Frame]) -> None:
        """Send `frames` now."""
        ...

    def receive(self, timeout: float) -> list[Frame]:
        """Return the received frames; wait for at most `timeout` [s] if there are none."""
        ...


class VirtualLink:
    """The bus to simulated drives in virtual time, which advances while the master waits.

    Attributes:
        neck: what hangs on it: the virtual neck with its drives, or springs in the place of another robot.
        cut: no frame passes.
        tap: called with (time, from_master, frame) for each frame that is on the wire.
        lose: returns whether a frame is lost: (from_master, frame).
        inject: frames of somebody else, delivered to both sides with the next exchange.
        sampling: whether the link samples the inclinometer as time passes; else its caller does.
    """

    def __init__(self, neck: SimulatedDrives) -> None:
        """Begin at t = 0."""
        self.neck = neck
        self.cycle = neck.settings.cycle
        self._step = 0
        self._inbox: deque[Frame] = deque()
        self.cut = False
        self.problem = ""
        self.tap: Callable[[float, bool, Frame], None] | None = None
        self.lose: Callable[[bool, Frame], bool] | None = None
        self.inject: list[Frame] = []
        self.sampling = True
        self._samples = max(1, round(neck.settings.sample_time / self.cycle))

    @property
    def now(self) -> float:
        """Virtual time [s]."""
        return self._step * self.cycle

    def send(self, frames: Sequence[Frame]) -> None:
        """Deliver at once; answers can be received at once."""
        kept = [frame for frame in frames if self._passes(True, frame)]
        for frame in self.inject:
            kept.append(frame)
            self._inbox.append(frame)
        self.inject.clear()
        now = self.now
        answers = self.neck.run([CanFrame(frame[0], frame[1], frame[2]) for frame in kept], now)
        for answer in answers:
            frame = Frame(answer[0], answer[1], answer[2])
            if self._passes(False, frame):
                self._inbox.append(frame)

    @property
    def newest(self) -> Reading:
        """The sensor's newest sample, as the master takes it."""
        return Reading(*self.neck.newest[1:])

    def pass_time(self) -> None:
        """Advance one cycle: drives, neck, and the frames that the drives send by themselves."""
        self.neck.move()
        self._step += 1
        if self.sampling and self._step % self._samples == 0:
            self.neck.sample(self.now)

    def receive(self, timeout: float) -> list[Frame]:
        """Return the received frames; if there are none, advance time until one comes or `timeout` [s] is over."""
        passed = 0.0
        # What rounding leaves of a time-out is a cycle too: whoever waits until it is over would wait for ever.
        while not self._inbox and (passed < timeout - 1e-9 or passed == 0.0 < timeout):
            self.pass_time()
            passed += self.cycle
            self.send(())
        return self.drain()

    def drain(self) -> list[Frame]:
        """Return the frames received so far."""
        frames = list(self._inbox)
        self._inbox.clear()
        return frames

    def _passes(self, from_master: bool, frame: Frame) -> bool:
        if self.cut or (self.lose is not None and self.lose(from_master, frame)):
            return False
        if self.tap is not None:
            self.tap(self.now, from_master, frame)
        return True


class CanLink:
    """A bus of python-can; frames of our own that come back are dropped.

    Attributes:
        tap: called with (time, from_master, frame) for each frame that was sent or came.
        problem: what the bus last refused a frame with, "" if it never did.
    """

    def __init__(self, bus: Any, name: str, *, echoes: bool = False) -> None:
        """Use the open `bus`; `echoes` if it returns the frames sent by this process, as UDP multicast does."""
        self._bus, self.name = bus, name
        self._sent: deque[tuple[int, bytes, bool]] | None = deque(maxlen=4096) if echoes else None
        self.problem = ""
        self.tap: Callable[[float, bool, Frame], None] | None = None

    @property
    def now(self) -> float:
        """Monotonic time [s]: no jump of the wall clock moves it."""
        return time.monotonic()

    def send(self, frames: Sequence[Frame]) -> None:
        """Send all frames; report a bus that refuses to the master as bus-off."""
        import can

        for frame in frames:
            message = can.Message(
                arbitration_id=frame.identifier,
                data=None if frame.remote else frame.data,
                dlc=1 if frame.remote else None,
                is_remote_frame=frame.remote,
                is_extended_id=False,
            )
            try:
                self._bus.send(message, timeout=0.0)
            except (can.CanError, OSError) as error:
                self.problem = reason(error)
                return
            if self.tap is not None:
                self.tap(self.now, True, frame)
            if self._sent is not None:
                self._sent.append((frame.identifier, b"" if frame.remote else frame.data, frame.remote))

    def receive(self, timeout: float) -> list[Frame]:
        """Return all that is there, waiting for the first one for at most `timeout` [s]."""
        import can

        frames: list[Frame] = []
        if self.problem:
            frames.append(BUS_OFF)
        try:
            # Between asking for the time and here a deadline may pass; a negative wait is an error to some interfaces.
            message = self._next(max(0.0, timeout))
            while message is not None:
                frame = self._frame(message)
                if frame is not None:
                    frames.append(frame)
                message = self._next(0.0)
        except (can.CanError, OSError) as error:
            self.problem = reason(error)
            frames.append(BUS_OFF)
        if self.tap is not None and frames:
            now = self.now
            for frame in frames:
                self.tap(now, False, frame)
        return frames

    def _next(self, timeout: float) -> Any:
        # Not `recv`: python-can 4 measures what is left of its time-out on the wall clock, and one that is set back by
        # an hour meanwhile would let it wait for an hour. It does nothing else but filter, and no filter is set here.
        message, _ = self._bus._recv_internal(timeout=timeout)
        return message

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()

    def _frame(self, message: Any) -> Frame | None:
        if message.is_error_frame:
            # SocketCAN error class "bus-off" (linux/can/error.h: CAN_ERR_BUSOFF, 40h).
            return BUS_OFF if message.arbitration_id & 0x40 else Frame(0, b"", error=True)
        if message.is_extended_id:
            return None
        data = b"" if message.is_remote_frame else bytes(message.data)
        key = (message.arbitration_id, data, message.is_remote_frame)
        if self._sent is not None and key in self._sent:
            self._sent.remove(key)
            return None
        return Frame(*key)


@contextlib.contextmanager
def open_bus(text: str, *, bit_rate: int = 1_000_000) -> Iterator[CanLink]:
    """Yield the bus `INTERFACE:CHANNEL`, such as `socketcan:can0`.

    Raises:
        SettingsError: no INTERFACE:CHANNEL.
        BusError: it cannot be opened; the line says why.
    """
    import can

    interface, colon, channel = text.partition(":")
    if not colon or not interface or not channel:
        raise SettingsError(f"--bus takes INTERFACE:CHANNEL, such as socketcan:can0; got `{text}`.")
    if interface not in can.interfaces.BACKENDS:
        raise SettingsError(f"--bus {text}: python-can has no interface `{interface}`; try socketcan:can0.")
    # What python-can has to say of a bus that fails is in the exception; without a handler it would print it as well.
    logging.getLogger("can").addHandler(logging.NullHandler())
    options: dict[str, Any] = {} if interface in ("socketcan", *HARMLESS) else {"bitrate": bit_rate}
    try:
        bus = can.Bus(interface=interface, channel=channel, receive_own_messages=False, **options)
    except Exception as error:  # vendors' drivers that are missing raise what comes: NameError, AttributeError, ...
        raise BusError(f"bus {text} cannot be opened: {reason(error)} Nothing was sent.") from error
    link = CanLink(bus, text, echoes=interface == "udp_multicast")
    try:
        yield link
    finally:
        link.close()


class GuardedLink:
    """Sends signs of life whenever somebody waits on it for longer than their period.

    It has no thread: an owner that hangs waits on nothing, and the drives notice.
    """

    def __init__(self, link: Link, signs: Sequence[Frame], period: float) -> None:
        """Send `signs` over `link` every `period` [s], beginning with the first wait."""
        self._link, self._signs, self._period = link, signs, period
        self._due = link.now

    @property
    def now(self) -> float:
        """Time [s] of the link."""
        return self._link.now

    @property
    def problem(self) -> str:
        """Why frames no longer pass, "" while they do."""
        return self._link.problem

    def send(self, frames: Sequence[Frame]) -> None:
        """Send `frames` now."""
        self._link.send(frames)

    def receive(self, timeout: float) -> list[Frame]:
        """Return the received frames; wait for at most `timeout` [s] if there are none."""
        until = self.now + timeout
        while True:
            now = self.now
            if now >= self._due - 1e-9:
                self._link.send(self._signs)
                self._due = max(self._due, now) + self._period
            frames = self._link.receive(max(0.0, min(until, self._due) - now))
            if frames or self.now >= until:
                return frames


_ADVICE = {
    errno.EACCES: "Serial adapters belong to the group `dialout`: `sudo usermod -aG dialout $USER`, then log in again",
    errno.EPERM: "This user is not permitted; ask the administrator of the machine",
    errno.ENOENT: "Is it plugged in, is the name right? `ls /dev/serial/by-id` lists serial ports",
    errno.ENODEV: "`ip link show` lists the interfaces of this machine",
    errno.EBUSY: "Another program has it open; end that one",
    errno.EAFNOSUPPORT: "This kernel has no CAN: `sudo modprobe can-raw`, and `vcan` to practise",
    errno.ENETDOWN: "`sudo ip link set can0 up`, with the bit rate set before",
    errno.ENOBUFS: "Nobody acknowledges them: is a drive on, the bit rate right, the line terminated",
    errno.EIO: "Was it unplugged?",
}
# How operating system and libraries number an error within its text.
_NUMBERS = re.compile(r"\[Errno (\d+)\] ?")


def reason(error: BaseException) -> str:
    """Return `error` as one sentence, with advice for a known error number.

    Libraries wrap the operating system's errors and keep the number in the text only.
    """
    text = " ".join(str(error).split()) or type(error).__name__
    number = error.errno if isinstance(error, OSError) else None
    found = _NUMBERS.findall(text)
    if number is None and found:
        number = int(found[-1])
    advice = _ADVICE.get(number or 0, "")
    text = _NUMBERS.sub("", text).rstrip(".")
    return f"{text}. {advice}." if advice else f"{text}."
