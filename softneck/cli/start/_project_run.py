"""Run the steps in the project's folder; finished steps are recognised by the hashes of their inputs."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import click

from softneck.core import (
    MOST_JSON,
    CheckFailedError,
    DataError,
    FileFormatError,
    OutputFileError,
    SettingsError,
    SoftneckError,
    core_count,
    file_hash,
    settings_text,
    take_core_until,
    write_text,
)

from ..shared._console import note
from . import _compile_ahead
from ._plan import STAGES, Step, Unmet

#: In the folder: finished steps with their inputs, commands and results.
FILE = "start.json"
_FORMAT_VERSION = 1


@dataclass(slots=True)
class ProjectRun:
    """The steps done in the working folder.

    `done`: key of a step -> its command, inputs (file -> SHA-256), whether it ended and held, its seconds. `answers`:
    the options beside the logs. `as_json`: print nothing but JSON. `ran`: keys of the steps of this call, in their
    order, each with whether it was done before. `begun`: key of a step -> its process, beside that of an earlier step.
    """

    done: dict[str, dict[str, Any]] = field(default_factory=dict)
    answers: dict[str, Any] = field(default_factory=dict)
    as_json: bool = False
    ran: dict[str, bool] = field(default_factory=dict)
    begun: dict[str, _Process] = field(default_factory=dict)

    @classmethod
    def read(cls, *, as_json: bool) -> ProjectRun:
        """Return the run of the working folder, a new one if there is none."""
        path = Path(FILE)
        if not path.is_file():
            return cls(as_json=as_json)
        try:
            content = json.loads(settings_text(path, MOST_JSON))
            steps = {str(key): dict(entry) for key, entry in content["steps"].items()}
            answers = dict(content["asked"])
            known = content["format"] == _FORMAT_VERSION and all(isinstance(e["reads"], dict) for e in steps.values())
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise FileFormatError(f"{path.resolve()}: is damaged; remove it to repeat all steps.") from error
        if not known:
            raise FileFormatError(f"{path.resolve()}: is of another version; remove it to repeat all steps.")
        return cls(steps, answers, as_json)

    def write(self) -> None:
        """Write the finished steps."""
        content = {"format": _FORMAT_VERSION, "asked": self.answers, "steps": self.done}
        write_text(FILE, json.dumps(content, indent=1) + "\n", force=True)

    def do(self, step: Step) -> None:
        """Run a step unless it is finished; its result is in `done`."""
        entry = self.done.get(step.key, {})
        reads = _hashes(step)
        same = entry.get("asked") == step.depends_on and entry.get("reads") == reads
        kept = self._is_done(step)
        self.ran[step.key] = kept
        self._tell(step, kept)
        if not kept:
            for other in step.beside:
                self._begin(other)
            if step.compiles:
                self._compile(step.compiles)
            begun = bool(same and entry and not entry.get("ended"))
            self.done[step.key] = {
                "command": step.shown,
                "asked": step.depends_on,
                "reads": reads,
                "makes": list(step.makes),
                "ended": False,
            }
            self.write()
            self._run(step, _words(step, begun=begun))
        said = self.done[step.key]
        if not said["holds"]:
            if step.unmet is Unmet.NO_MODEL:
                raise CheckFailedError(said["said"])
            if not self.as_json:
                note(f"does not hold: {said['said']}")
        elif said["said"]:
            note(f"continues without {step.makes[0]}: {said['said']}")

    def close(self) -> None:
        """End the steps that began and had no turn."""
        while self.begun:
            self.begun.popitem()[1].end()

    def _is_done(self, step: Step) -> bool:
        entry = self.done.get(step.key, {})
        same = entry.get("asked") == step.depends_on and entry.get("reads") == _hashes(step)
        return same and bool(entry.get("ended")) and all(Path(name).is_file() for name in step.makes)

    def _begin(self, step: Step) -> None:
        """Begin a step in a process of its own, if it is to be done and there is a core for it."""
        if step.key not in self.begun and not self._is_done(step) and core_count() > 1:
            words = ["-m", *step.command, *(["--json"] if self.as_json else [])]
            if step.command[0] == "python":
                words = [*step.command[1:]]
            self.begun[step.key] = _Process.of(words, step.makes, _hashes(step))

    def _compile(self, recordings: tuple[str, ...]) -> None:
        """Compile what later steps call in a process of its own, once, if there is a core for it."""
        known = "compile ahead" in self.begun or _compile_ahead.compiled_before().is_file()
        if not known and core_count() > 1:
            code = f"from {_compile_ahead.__name__} import compile_ahead; compile_ahead{recordings!r}"
            self.begun["compile ahead"] = _Process.of(["-c", code])

    def _was_begun(self, step: Step) -> bool:
        """Wait for a step that has begun and tell what it said; return whether it needs no other run.

        One that did not end well is run again, and tells of its error in the usual way.
        """
        if step.key not in self.begun:
            return False
        well = self.begun[step.key].finish(step, as_json=self.as_json)
        self.begun.pop(step.key).close()  # until then Ctrl-C ends it
        return well

    def _tell(self, step: Step, kept: bool) -> None:
        line = f"[{STAGES.index(step.stage) + 1}/{len(STAGES)}] {step.stage}{' (done before)' if kept else ''}"
        click.echo(f"\n{line}\n$ {step.shown}", err=self.as_json)

    def _run(self, step: Step, words: tuple[str, ...]) -> None:
        entry, begin, ended = self.done[step.key], _processor_time(), True
        entry |= {"holds": not step.finding, "said": step.finding}
        try:
            said = io.StringIO() if self.as_json else sys.stdout
            with _ctrl_c_ends(), contextlib.redirect_stdout(said):
                if not self._was_begun(step):
                    (_pytest if words[0] == "python" else _softneck)(words, as_json=self.as_json)
        except CheckFailedError as error:
            ended = False
            entry |= {"holds": False, "said": " ".join(filter(None, [step.finding, str(error)]))}
        except (DataError, SettingsError) as error:
            if step.unmet is not Unmet.DONE_WITHOUT:
                raise
            ended = False
            entry["said"] = str(error)
            for name in step.makes:  # files of an earlier call are of other recordings
                Path(name).unlink(missing_ok=True)
        lacking = [name for name in step.makes if not Path(name).is_file()]
        if lacking and ended:
            raise OutputFileError(f"{lacking[0]}: was not made by `{step.shown}`.")
        # Inputs are hashed again: a layout that an import proposed is one of them from now on.
        entry |= {"reads": _hashes(step), "ended": True,
                  "seconds": round(_processor_time() - begin, 2)}  # fmt: skip
        self.write()


@dataclass(frozen=True, slots=True)
class _Process:
    """A step in a process of its own: its files, the hashes of what it reads, and files with what it says."""

    running: subprocess.Popen[bytes]
    makes: tuple[str, ...]
    reads: dict[str, str]
    said: tuple[IO[bytes], IO[bytes]]

    @classmethod
    def of(cls, words: list[str], makes: tuple[str, ...] = (), reads: dict[str, str] | None = None) -> _Process:
        said = tempfile.TemporaryFile(), tempfile.TemporaryFile()  # noqa: SIM115 - until the step has its turn
        running = subprocess.Popen(
            [sys.executable, "-P", *words], stdin=subprocess.DEVNULL, stdout=said[0], stderr=said[1]
        )
        take_core_until(running.wait)
        return cls(running, makes, reads or {}, said)

    def finish(self, step: Step, *, as_json: bool) -> bool:
        """Wait until it ends, and print what it said; return whether it ended well on the files of now."""
        if self.running.wait() != 0 or self.reads != _hashes(step):
            return False
        for stream, err in zip(self.said, (False, True), strict=True):
            stream.seek(0)
            if err or not as_json:
                click.echo(stream.read(), nl=False, err=err)
        return True

    def end(self) -> None:
        """End it, and remove its files."""
        self.running.kill()
        self.running.wait()
        for name in self.makes:
            Path(name).unlink(missing_ok=True)
        self.close()

    def close(self) -> None:
        """Close the files with what it said."""
        for stream in self.said:
            stream.close()


def _processor_time() -> float:
    """Return the processor time of this process and its finished children [s]."""
    return sum(os.times()[:4])


def _hashes(step: Step) -> dict[str, str]:
    return {name: file_hash(name) if Path(name).is_file() else "" for name in step.reads}


def _words(step: Step, *, begun: bool) -> tuple[str, ...]:
    """Return the command's words; without `--force` to continue an interrupted run."""
    if not (begun and step.resumes and Path(step.resumes).is_file()):
        return step.command
    return tuple(word for word in step.command if word != "--force")


def _softneck(words: tuple[str, ...], *, as_json: bool) -> None:
    from .._main import group

    arguments = [*words[1:], *(["--json"] if as_json else [])]
    try:
        group.main(args=arguments, prog_name="softneck", standalone_mode=False)
    except click.ClickException as error:
        raise SoftneckError(error.format_message()) from error


def _pytest(words: tuple[str, ...], *, as_json: bool) -> None:
    done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True, check=False)
    if not as_json:
        click.echo(done.stdout, nl=False)
    last = (done.stdout.strip() or done.stderr.strip() or "no word").splitlines()[-1]
    if done.returncode == 1:
        raise CheckFailedError(f"a test of the closed loop failed: {last.strip('= ')}.")
    if done.returncode:
        raise SoftneckError(f"`{' '.join(words)}` ended with exit code {done.returncode}: {last}")


@contextlib.contextmanager
def _ctrl_c_ends() -> Iterator[None]:
    """Raise KeyboardInterrupt after Ctrl-C, although a training catches it and keeps its best."""
    usual = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(usual):
        yield
        return
    pressed: list[int] = []

    def on_interrupt(number: int, frame: Any) -> None:
        pressed.append(number)
        usual(number, frame)

    signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if pressed:
        raise KeyboardInterrupt
