"""The other side of `IsolatedPart`: one FMU in a process of its own, told what to do over a pipe.

Run as `python -m softneck.cosim.parts._child IN OUT` with two inherited file descriptors.
"""

from __future__ import annotations

import json
import struct
import sys
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from softneck.core import SoftneckError

from ._fmu_part import FmuPart


def main(arguments: list[str]) -> None:
    """Serve one FMU until the pipe closes."""
    asked, answers = (Connection(int(text)) for text in arguments)
    part: FmuPart | None = None
    while True:
        try:
            message = asked.recv_bytes()
        except EOFError:
            break
        try:
            if part is None:
                part = FmuPart(**json.loads(message))
                reply = b""
            else:
                reply = _serve(part, message)
        except SoftneckError as error:
            answers.send_bytes(b"-" + json.dumps([type(error).__name__, str(error)]).encode())
        else:
            answers.send_bytes(b"+" + reply)
    if part is not None:
        part.close()


def _serve(part: FmuPart, message: bytes) -> bytes:
    what, rest = message[:1], message[1:]
    if what == b"A":
        values = np.frombuffer(rest, dtype="<f8")
        return part.advance(float(values[0]), values[1:]).tobytes()
    if what == b"S":
        (time,) = struct.unpack("<d", rest[:8])
        parameters: dict[str, Any] = json.loads(rest[8:])
        return part.start(time, parameters).tobytes()
    if what == b"G":
        return part.get_state()
    if what == b"P":
        part.set_state(rest)
        return b""
    part.close()
    return b""


if __name__ == "__main__":
    main(sys.argv[1:])
