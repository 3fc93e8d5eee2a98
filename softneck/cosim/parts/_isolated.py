"""An FMU in a process of its own, so that a crash or a hang ends one run and not the program.

The child is `python -m softneck.cosim.parts._isolated IN OUT` with two inherited file descriptors.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import IO, Any

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    OutputFileError,
    SettingsError,
    SoftneckError,
    Vector,
    require_positive,
)
from softneck.loop import EndedError

from ._fmu_part import FmuError, FmuPart

_ERRORS: dict[str, type[SoftneckError]] = {
    kind.__name__: kind for kind in (FmuError, EndedError, DataError, FileFormatError, OutputFileError, SettingsError)
}
# The import of softneck in the child and the FMU's loading take a second or two on a busy machine.
_START_TIMEOUT_S = 60.0


class IsolatedPart:
    """An FMU as a part like `FmuPart`, run by a child process that lives until `close`.

    Attributes:
        path, inputs, outputs, parameters, sample_time, role, native_names, units: as in `FmuPart`.
        timeout: longest wait for one step [s].
    """

    def __init__(
        self,
        path: str | Path,
        *,
        role: str | None = None,
        sample_time: float | None = None,
        names: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
        timeout: float = 10.0,
    ) -> None:
        """Read the FMU's description; `start` starts the child. Arguments and errors are those of `FmuPart`."""
        require_positive("timeout", timeout, "s")
        described = FmuPart(path, role=role, sample_time=sample_time, names=names, units=units)
        self.annotated_robot = described.annotated_robot
        self.path, self.role, self.sample_time = described.path, described.role, described.sample_time
        self.inputs, self.outputs, self.parameters = described.inputs, described.outputs, described.parameters
        self.native_names, self.units, self.timeout = described.native_names, described.units, timeout
        self._settings = {
            "path": str(self.path), "role": self.role, "sample_time": self.sample_time,
            "names": dict(names or {}), "units": dict(units or {}),
        }  # fmt: skip
        self._child: _Child | None = None

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Start a run as `FmuPart.start`; raise FmuError also if the FMU crashed or hung."""
        if self._child is None:
            self._child = _Child()
            self._request(json.dumps(self._settings).encode(), "while loading", _START_TIMEOUT_S)
        plain = {name: float(value) for name, value in parameters.items()}
        message = b"S" + struct.pack("<d", time) + json.dumps(plain).encode()
        return np.frombuffer(self._request(message, "at the start", _START_TIMEOUT_S)).copy()

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step as `FmuPart.advance`; raise FmuError also if the FMU crashed or hung."""
        message = b"A" + np.concatenate([[time], inputs]).astype("<f8").tobytes()
        return np.frombuffer(self._request(message, f"in the step from t = {time:g} s", self.timeout)).copy()

    def close(self) -> None:
        """End the child process."""
        child, self._child = self._child, None
        if child is not None:
            child.end(self.timeout)

    def _request(self, message: bytes, when: str, timeout: float) -> bytes:
        child = self._child
        if child is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        try:
            child.requests.send_bytes(message)
            if not child.answers.poll(timeout):
                self._kill()
                raise FmuError(f"{self.path}: hung {when}: no answer within {timeout:g} s; its process was ended.")
            answer = child.answers.recv_bytes()
        except (EOFError, OSError) as error:
            how = child.death()
            self._kill()
            raise FmuError(f"{self.path}: crashed {when}: its process {how}.") from error
        if answer[:1] == b"-":
            kind, text = json.loads(answer[1:])
            raise _ERRORS.get(kind, FmuError)(text)
        return answer[1:]

    def _kill(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.process.kill()
            child.end(1.0)


class _Child:
    """The process with its two pipes, its temporary folder and its stderr."""

    def __init__(self) -> None:
        (requests_out, requests_in), (answers_out, answers_in) = os.pipe(), os.pipe()
        self.requests = Connection(requests_in, readable=False)
        self.answers = Connection(answers_out, writable=False)
        self.folder = tempfile.mkdtemp(prefix="softneck-child-")
        self.stderr: IO[Any] = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "softneck.cosim.parts._isolated", str(requests_out), str(answers_in)],
                pass_fds=(requests_out, answers_in), stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=self.stderr,
                # The unpacked FMU is removed with the folder, however the process ends.
                env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "TMPDIR": self.folder},
            )  # fmt: skip
        finally:
            os.close(requests_out)
            os.close(answers_in)

    def death(self) -> str:
        """Return how the process ended, and the last line that it wrote."""
        code = self.process.wait(timeout=5.0)
        self.stderr.seek(0)
        lines = self.stderr.read().decode("utf-8", "replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"exited with code {code}"
        return f"{how} ({last})" if last else how

    def end(self, patience: float) -> None:
        """Close the pipes, wait for the process, and kill it if it does not end."""
        self.requests.close()
        try:
            self.process.wait(timeout=patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.answers.close()
        self.stderr.close()
        shutil.rmtree(self.folder, ignore_errors=True)


def main(arguments: list[str]) -> None:
    """Serve one FMU until the pipe closes."""
    requests, answers = (Connection(int(text)) for text in arguments)
    part: FmuPart | None = None
    while True:
        try:
            message = requests.recv_bytes()
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
    part.close()
    return b""


if __name__ == "__main__":
    main(sys.argv[1:])
