"""An FMU in a process of its own, so that a crash or a hang ends one run and not the program."""

from __future__ import annotations

import os
import pickle
import shutil
import signal
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import SoftneckError, Vector, require_positive

from ._fmu_part import FmuError, FmuPart, naming_arguments

# The import of softneck in the child and the FMU's loading take a second or two on a busy machine.
_START_TIMEOUT_S = 60.0
_STDERR = "stderr"


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
            "path": self.path, "role": self.role, "sample_time": self.sample_time, "names": dict(names or {}),
            "units": dict(units or {}),
        }  # fmt: skip
        self._child: _Child | None = None

    def with_names(self, names: Mapping[str, str]) -> IsolatedPart:
        """Return the same part with other names for its variables, as `FmuPart.with_names`."""
        settings: Any = {"role": self.role, "sample_time": self.sample_time, "timeout": self.timeout}
        return IsolatedPart(self.path, **settings, **naming_arguments(self, names))

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Start a run as `FmuPart.start`; raise FmuError also if the FMU crashed or hung."""
        self._child = self._child or _Child(self._settings)
        plain = {name: float(value) for name, value in parameters.items()}
        return self._request("start", time, plain, "at the start", _START_TIMEOUT_S)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step as `FmuPart.advance`; raise FmuError also if the FMU crashed or hung."""
        row = inputs.astype(np.float64).tobytes()
        return self._request("advance", time, row, f"in the step from t = {time:g} s", self.timeout)

    def close(self) -> None:
        """End the child process."""
        child, self._child = self._child, None
        if child is not None:
            child.end(self.timeout)

    def _request(self, method: str, time: float, values: Any, when: str, timeout: float) -> Vector:
        child = self._child
        if child is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        try:
            child.pipe.send_bytes(pickle.dumps((method, time, values)))
            if not child.pipe.poll(timeout):
                self._kill()
                raise FmuError(f"{self.path}: hung {when}: no answer within {timeout:g} s; its process was ended.")
            answer = pickle.loads(child.pipe.recv_bytes())  # noqa: S301 - of our own process
        except (EOFError, OSError) as error:
            how = child.death()
            self._kill()
            raise FmuError(f"{self.path}: crashed {when}: its process {how}.") from error
        if isinstance(answer, SoftneckError):
            raise answer
        return np.frombuffer(answer).copy()

    def _kill(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            child.end(0.0)


class _Child:
    """The process with its pipe and its temporary folder: the unpacked FMU goes with it, however the process ends."""

    def __init__(self, settings: Mapping[str, Any]) -> None:
        from loky.backend import get_context

        # Neither forks threads nor imports the user's script again.
        context: Any = get_context("loky")
        self.folder = tempfile.mkdtemp(prefix="softneck-child-")
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, dict(settings), self.folder))
        try:
            self.process.start()
        finally:
            theirs.close()

    def death(self) -> str:
        """Return how the process ended, and the last line that it wrote."""
        self.process.join(5.0)
        code, file = self.process.exitcode, Path(self.folder, _STDERR)
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines() if file.is_file() else []
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        how = f"was ended by {signal.Signals(-code).name}" if (code or 0) < 0 else f"exited with code {code}"
        return f"{how} ({last})" if last else how

    def end(self, patience: float) -> None:
        """Close the pipe, wait for the process, and kill it if it does not end."""
        self.pipe.close()
        self.process.join(patience)
        if self.process.exitcode is None:
            os.kill(self.process.pid, signal.SIGKILL)  # loky's processes have no `kill`
            self.process.join()
        shutil.rmtree(self.folder, ignore_errors=True)


def _serve(pipe: Any, settings: Mapping[str, Any], folder: str) -> None:
    """Serve one FMU until the pipe closes; what it prints goes to a file."""
    tempfile.tempdir = folder
    for number, path in ((1, os.devnull), (2, str(Path(folder, _STDERR)))):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT, 0o600), number)
    part: FmuPart | None = None
    while True:
        try:
            method, time, values = pickle.loads(pipe.recv_bytes())  # noqa: S301
        except EOFError:
            break
        try:
            part = part or FmuPart(**settings)
            if method == "start":
                answer: Any = part.start(time, values).tobytes()
            else:
                answer = part.advance(time, np.frombuffer(values)).tobytes()
        except SoftneckError as error:
            answer = error
        pipe.send_bytes(pickle.dumps(answer))
    if part is not None:
        part.close()
