"""Writing of the log of a run: frames and all data for a replay, in a thread beside the control loop."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from softneck import __version__
from softneck.core import OutputFileError, SettingsError, file_hash, refuse_existing

from ..master import Event, Frame, Master, MasterSettings
from ..master._gate import Reading
from ._cycle import Cycle, LoggedPilot, cycle_of, encode_cycle, frame_text

RUN_LOG = ".mcap"
LOG_VERSION = 2
METADATA = "softneck.run"
# Period of flushes to the operating system [s]: the data that a killed process may lose, besides one chunk.
_FLUSH_S = 0.25
# Uncompressed bytes in one chunk: a cycle has 400 or more, so that a chunk is filled in less than 1 s at 20 Hz.
_CHUNK_BYTES = 8192
# Length of the queue before the loop drops cycles: 200 s at 100 Hz.
_QUEUE_LENGTH = 20_000


def _schema(**kinds: Any) -> dict[str, Any]:
    """Return the JSON schema of a table: name -> type, a list of one for an array, a dict for a table in it."""

    def of(kind: Any) -> dict[str, Any]:
        if isinstance(kind, dict):
            return _schema(**kind)
        return {"type": "array", "items": {"type": kind[0]}} if isinstance(kind, list) else {"type": kind}

    return {"type": "object", "properties": {name: of(kind) for name, kind in kinds.items()}}


_SCHEMAS: dict[str, dict[str, Any]] = {
    "softneck.Cycle": _schema(time="number", phase="string", received=["string"], sent=["string"],
                              positions=["number"], setpoints=["number"], tensions=["number"]),
    # Frames outside all cycles: of the pre-flight, of `zero`, of the end.
    "softneck.Frame": _schema(time="number", sent="boolean", frame="string"),
    "softneck.Signals": {"type": "object", "additionalProperties": {"type": "number"}},
    # A well-known schema: Foxglove shows it in its log panel.
    "foxglove.Log": _schema(timestamp={"sec": "integer", "nsec": "integer"}, level="integer", message="string",
                            name="string"),
}  # fmt: skip
_TOPICS = {"/cycle": "softneck.Cycle", "/frames": "softneck.Frame", "/signals": "softneck.Signals",
           "/events": "foxglove.Log"}  # fmt: skip


class _Entry(NamedTuple):
    frames: list[tuple[float, bool, Frame]]
    cycle: Cycle | None = None
    signals: Mapping[str, float] | None = None
    events: tuple[Event, ...] = ()
    time: float = 0.0


def partial(path: Path) -> Path:
    """Return the path of an unfinished log."""
    return path.with_name(f"{path.stem}.part{path.suffix}")


def require_log_path(path: Path, *, force: bool = False) -> None:
    """Raise an error if `RunLogger` cannot write to `path`.

    Raises SettingsError: another ending than `.mcap`; OutputFileError: the file exists.
    """
    if path.suffix.lower() != RUN_LOG:
        raise SettingsError(f"{path}: a log ends in {RUN_LOG}.")
    for taken in (path, partial(path)):
        refuse_existing(taken, force=force)


def run_facts(
    settings: MasterSettings, files: Mapping[str, str | Path], *, simulated: bool, **more: Any
) -> dict[str, Any]:
    """Return the facts of a run for its log: the master's settings, and the files by hash."""
    told = dataclasses.asdict(settings) | {"bus": dataclasses.asdict(settings.bus) | {"off": sorted(settings.bus.off)}}
    return {
        "softneck": __version__,
        # Logs of a neck have no `channels`, as in earlier versions.
        "settings": {key: value for key, value in told.items() if value is not None},
        "simulated": simulated,
        "files": {role: {"path": str(Path(path).resolve()), "sha256": file_hash(path)} for role, path in files.items()},
        **more,
    }


class RunLogger:
    """Writer of the log of one run. The loop only puts references into a queue; a thread encodes them.

    A log has `.part` before its ending until the run is over; the log of a killed process can be read.
    `path`: of the log. `lost`: number of cycles dropped because the disk was too slow. `problem`: reason why writing
    ended, "" while it goes on. `described`: whether a run has started; before that there is no data for a replay.
    """

    def __init__(self, path: Path, *, force: bool = False, wait: bool = False, epoch: float = 0.0) -> None:
        """Open the file.

        `path`: of the log. `force`: replace an existing one. `wait`: whether the loop may wait for the disk, as in
        virtual time. `epoch`: wall-clock time [s] of t = 0 of the loop's clock; read once, so that jumps of the wall
        clock have no effect. Raises SettingsError: another ending than `.mcap`; OutputFileError: the file exists or
        cannot be written.
        """
        self.path = path
        require_log_path(path, force=force)
        self.lost, self.problem, self.described = 0, "", False
        self._wait, self._epoch = wait, epoch
        self._older: list[tuple[float, bool, Frame]] = []
        self._frames: list[tuple[float, bool, Frame]] = []
        self._row: Mapping[str, float] | None = None
        self._seen: Event | None = None
        self._queue: queue.Queue[_Entry | Mapping[str, Any] | None] = queue.Queue(_QUEUE_LENGTH)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream: BinaryIO = partial(path).open("wb")
        except OSError as error:
            raise OutputFileError(f"{path}: cannot be written: {error.strerror}. Choose another folder.") from error
        self._writer, self._channels = self._start_writer()
        self._thread = threading.Thread(target=self._write, name="softneck-log", daemon=True)
        self._thread.start()

    def describe(self, facts: Mapping[str, Any]) -> None:
        """Write the facts of the run; before the first cycle."""
        self.described = True
        self._put(_Entry(self._swap()))
        self._put(dict(facts))

    def frame(self, now: float, from_master: bool, frame: Frame) -> None:
        """Add one frame on the bus; it is written separately if it is outside all cycles."""
        self._frames.append((now, from_master, frame))
        if len(self._frames) >= 256:
            self._put(_Entry(self._swap()))

    def signals(self, row: Mapping[str, float] | None) -> None:
        """Add the row of a sample of the controller; it is written with the cycle."""
        self._row = row

    def watch(self, pilot: LoggedPilot) -> Callable[..., None]:
        """Return the callback for each step of a master with the pilot `pilot`."""

        def watch(
            now: float, received: Sequence[Frame], sent: Sequence[Frame], tilt: Reading | None, master: Master
        ) -> None:
            row, self._row = self._row, None
            cycle = cycle_of(master, pilot, now, received, tilt, sent)
            # A frame that is not in this cycle may be received in the next one.
            held = {id(frame) for frame in (*received, *sent)}
            more = [item for item in self._older if id(item[2]) not in held]
            self._older = [item for item in self._frames if id(item[2]) not in held]
            self._frames = []
            self._put(_Entry(more, cycle, row, self._news(master), now))

        return watch

    def _news(self, master: Master) -> tuple[Event, ...]:
        news = []
        for event in reversed(master.events):
            if event is self._seen:
                break
            news.append(event)
        if news:
            self._seen = news[0]
        return tuple(reversed(news))

    def __enter__(self) -> RunLogger:
        """Return the logger itself."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the log, also after an error."""
        self.close()

    def close(self) -> None:
        """Write the remaining entries and rename the file.

        Raises OutputFileError: the log is not complete; the message has the reason.
        """
        if not self._thread.is_alive() and self._stream.closed:
            return
        self._queue.put(_Entry(self._swap()))
        self._queue.put(None)
        self._thread.join()
        self._close_stream()
        if self.problem:
            raise OutputFileError(
                f"{partial(self.path)}: the log is not complete: {self.problem}. The run went on without it."
            )
        partial(self.path).replace(self.path)
        if self.lost:
            raise OutputFileError(f"{self.path}: {self.lost} cycle(s) were dropped: the disk did not keep up.")

    def _swap(self) -> list[tuple[float, bool, Frame]]:
        frames = [*self._older, *self._frames]
        self._older, self._frames = [], []
        return frames

    def _put(self, entry: _Entry | Mapping[str, Any]) -> None:
        if self._wait:
            self._queue.put(entry)
            return
        try:
            self._queue.put_nowait(entry)
        except queue.Full:
            self.lost += 1

    def _close_stream(self) -> None:
        try:
            self._stream.close()
        except OSError as error:
            # Buffered data does not fit on a full disk; closing again discards it.
            self.problem = self.problem or error.strerror or str(error)
            with contextlib.suppress(OSError):
                self._stream.close()

    def _write(self) -> None:
        flushed = time.monotonic()
        while True:
            try:
                entry = self._queue.get(timeout=_FLUSH_S)
            except queue.Empty:
                entry = _Entry([])
            if self.problem:
                if entry is None:
                    return
                continue
            try:
                if entry is None:
                    self._writer.finish()
                    return
                self._take(entry)
                if time.monotonic() - flushed >= _FLUSH_S:
                    self._stream.flush()
                    flushed = time.monotonic()
            except OSError as error:
                self.problem = error.strerror or str(error)
                if entry is None:
                    return

    def _start_writer(self) -> tuple[Any, dict[str, int]]:
        """Start an MCAP file of JSON messages in small compressed chunks; return its writer, and topic -> channel."""
        from mcap.writer import Writer

        writer = Writer(self._stream, chunk_size=_CHUNK_BYTES)
        writer.start(profile="", library=f"softneck {__version__}")
        schemas = {
            name: writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            for name, schema in _SCHEMAS.items()
        }
        channels = {topic: writer.register_channel(topic, "json", schemas[name]) for topic, name in _TOPICS.items()}
        return writer, channels

    def _take(self, entry: _Entry | Mapping[str, Any]) -> None:
        if not isinstance(entry, _Entry):
            self._writer.add_metadata(METADATA, {"version": str(LOG_VERSION), "facts": json.dumps(entry)})
            return
        for now, sent, frame in entry.frames:
            self._add("/frames", self._stamp(now), {"time": now, "sent": sent, "frame": frame_text(frame)})
        if entry.cycle is None:
            return
        stamp = self._stamp(entry.time)
        self._add("/cycle", stamp, encode_cycle(entry.cycle))
        if entry.signals is not None:
            # Missing numbers are left out, as JSON has no NaN.
            row = {name: value for name, value in entry.signals.items() if math.isfinite(value)}
            self._add("/signals", stamp, row)
        for event in entry.events:
            seconds, rest = divmod(stamp, 1_000_000_000)
            self._add("/events", stamp, {
                "timestamp": {"sec": seconds, "nsec": rest}, "level": 2 if event.rule.reaction == "count" else 4,
                "message": str(event), "name": event.name, "node": event.node,
            })  # fmt: skip

    def _add(self, topic: str, stamp: int, table: Mapping[str, Any]) -> None:
        data = json.dumps(table, separators=(",", ":"), allow_nan=False).encode()
        self._writer.add_message(self._channels[topic], stamp, data, stamp)

    def _stamp(self, now: float) -> int:
        return max(0, round((self._epoch + now) * 1e9))
