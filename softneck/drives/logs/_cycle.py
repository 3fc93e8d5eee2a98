"""One logged cycle of the master: its inputs, decisions and frames, as text that reads back to the bit."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from ..master import Frame, Master
from ..master._cia402 import state_of
from ..master._fieldbus import node_state
from ..master._gate import Reading, sample_of
from ..master._master import Measurement, Motors, Pilot, reference_of

# A call of the pilot and its result: ("start", None), ("finished", bool), ("step", set-points or None) and, for a loop,
# ("reference", reference), or (name, "Error: text") for an exception.
Answer = tuple[str, Any]


class Cycle(NamedTuple):
    """Inputs and outputs of one step of the master.

    Attributes:
        time: of the step [s], monotonic.
        received: received frames in order.
        tilt: the inclinometer's sample, None if missing.
        taken: requests from outside since the step before: (start, finish, leave or stop; reason).
        answers: of the pilot in this step.
        sent: sent frames.
        phase: after the step.
        positions, setpoints, tensions: of the motors [rad], [rad], [N].
    """

    time: float
    received: tuple[Frame, ...]
    tilt: Reading | None
    taken: tuple[tuple[str, str], ...]
    answers: tuple[Answer, ...]
    sent: tuple[Frame, ...]
    phase: str
    positions: Motors
    setpoints: Motors
    tensions: Motors


class LoggedPilot:
    """Wrapper of a pilot that stores its answers until `take`."""

    def __init__(self, pilot: Pilot) -> None:
        """Wrap `pilot`."""
        self._pilot = pilot
        self._answers: list[Answer] = []

    def start(self) -> None:
        """Start a new run of the pilot."""
        self._call_or_record("start", self._pilot.start)

    def step(self, measured: Measurement) -> Motors | None:
        """Return the set-points of the pilot."""
        return self._call_or_record("step", lambda: self._pilot.step(measured))

    def is_finished(self, index: int) -> bool:
        """Return whether the pilot has finished."""
        return self._call_or_record("finished", lambda: self._pilot.is_finished(index))

    def _call_or_record(self, what: str, ask: Callable[[], Any]) -> Any:
        try:
            answer = ask()
        except Exception as error:
            self._answers.append((what, f"{type(error).__name__}: {error}"))
            raise
        self._answers.append((what, answer))
        return answer

    @property
    def reference(self) -> tuple[float, ...]:
        """The reference of the pilot; pilots without a loop have none, and none is stored."""
        reference = reference_of(self._pilot)
        if reference:
            self._answers.append(("reference", reference))
        return reference

    def take(self) -> tuple[Answer, ...]:
        """Return the answers since the last call."""
        answers = tuple(self._answers)
        self._answers.clear()
        return answers


def cycle_of(
    master: Master,
    pilot: LoggedPilot,
    now: float,
    received: Sequence[Frame],
    tilt: Reading | None,
    sent: Sequence[Frame],
) -> Cycle:
    """Return the last step of `master`."""
    return Cycle(
        now, tuple(received), tilt, master.taken, pilot.take(), tuple(sent), str(master.supervisor.phase),
        master.positions, master.setpoints, master.tensions,
    )  # fmt: skip


def encode_cycle(cycle: Cycle) -> dict[str, Any]:
    """Return JSON values of a cycle, without empty entries; numbers that are not finite become texts."""
    table: dict[str, Any] = {
        "time": cycle.time,
        "phase": cycle.phase,
        "received": [frame_text(frame) for frame in cycle.received],
        "sent": [frame_text(frame) for frame in cycle.sent],
        "positions": _numbers(cycle.positions),
        "setpoints": _numbers(cycle.setpoints),
        "tensions": _numbers(cycle.tensions),
    }
    if cycle.tilt is not None:
        table["tilt"] = [*_numbers((*cycle.tilt.values, *cycle.tilt.rates)), cycle.tilt.valid]
    if cycle.taken:
        table["taken"] = [list(pair) for pair in cycle.taken]
    if cycle.answers:
        table["answers"] = [
            [what, _numbers(value) if isinstance(value, tuple) else value] for what, value in cycle.answers
        ]
    return table


def decode_cycle(table: dict[str, Any]) -> Cycle:
    """Return the cycle of a table from `encode_cycle`. Raises KeyError, TypeError, ValueError: not such a table."""
    tilt = table.get("tilt")
    return Cycle(
        float(table["time"]),
        tuple(frame_of(text) for text in table["received"]),
        None if tilt is None else _tilt(tilt),
        tuple((str(what), str(why)) for what, why in table.get("taken", ())),
        tuple(
            (str(what), _motors(value) if isinstance(value, list) else value)
            for what, value in table.get("answers", ())
        ),
        tuple(frame_of(text) for text in table["sent"]),
        str(table["phase"]),
        _motors(table["positions"]),
        _motors(table["setpoints"]),
        _motors(table["tensions"]),
    )


def frame_text(frame: Frame) -> str:
    """Return a text such as `201#0f00a1b2c3d4`; after `#`, R marks a remote request and X an error of the adapter."""
    kind = ("R" if frame.remote else "") + ("X" if frame.error else "")
    return f"{frame.identifier:03X}#{kind}{frame.data.hex()}"


def frame_of(text: str) -> Frame:
    """Return the frame of a text from `frame_text`. Raises ValueError: not such a text."""
    number, _, data = text.partition("#")
    digits = data.lstrip("RX")
    kind = data[: len(data) - len(digits)]
    return Frame(int(number, 16), bytes.fromhex(digits), "R" in kind, "X" in kind)


def _numbers(values: Sequence[float]) -> list[Any]:
    return [float(value) if math.isfinite(value) else repr(float(value)) for value in values]


def _motors(values: Sequence[Any]) -> Motors:
    return tuple(float(value) for value in values)


def _tilt(values: Sequence[Any]) -> Reading:
    """Return the sample that was logged as values, rates and validity."""
    *numbers, valid = values
    count = len(numbers) // 2
    return sample_of(_motors(numbers[:count]), _motors(numbers[count:]), valid=bool(valid))


_NMT = {1: "start", 2: "stop", 128: "pre-operational", 129: "reset", 130: "reset communication"}


def meaning(frame: Frame) -> str:
    """Return one frame in words and bytes, for softneck's PDO mapping."""
    text = _words(frame)
    bytes_ = "remote request" if frame.remote else frame.data.hex(" ") or "no data"
    return f"{text} [{bytes_}]"


def _words(frame: Frame) -> str:
    base, node, data = frame.identifier & 0x780, frame.identifier & 0x7F, frame.data
    if frame.error:
        return "bus-off" if data == b"off" else "error on the bus"
    if frame.identifier == 0 and len(data) == 2:
        return f"NMT {_NMT.get(data[0], data[0])} to {'all' if data[1] == 0 else f'node {data[1]}'}"
    if frame.identifier == 0x80:
        return "SYNC"
    if base == 0x80 and len(data) >= 3:
        return f"emergency {int.from_bytes(data[:2], 'little'):04X}h of node {node}"
    if base == 0x200 and len(data) == 6:
        word, target = struct.unpack("<Hi", data)
        return f"to node {node}: control word {word:04X}h, target {target} counts"
    if base == 0x180 and len(data) == 8:
        word, counts, current = struct.unpack("<Hih", data)
        return f"from node {node}: {state_of(word).name}, {counts} counts, current {current}"
    if base in (0x580, 0x600) and len(data) == 8:
        index, subindex = struct.unpack_from("<HB", data, 1)
        return f"SDO {'to' if base == 0x600 else 'from'} node {node}: {index:04X}h:{subindex}"
    if base == 0x700:
        if frame.remote:
            return f"guarding of node {node}"
        return f"node {node} is {node_state(data[0]).name}" if len(data) == 1 else f"guarding of node {node}"
    return f"{frame.identifier:03X}h"
