"""Reading of the log of a run: facts, cycles and signals, up to the end of a truncated file."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import DataError, FileFormatError, SettingsError, Vector, file_hash, require_size
from softneck.loop import LoopResult
from softneck.robot import Robot
from softneck.signals import LARGEST_RECORD, NECK, Recording, require_chunks

from ..master import Frame, MasterSettings
from ..master._fieldbus import BusSettings
from ..master._settings import ChannelSettings, LimitSettings, RampSettings, WatchSettings
from ..supervision._baseline import Baseline
from ._cycle import Cycle, decode_cycle, frame_of
from ._result import recording_of, signal_units
from ._rows import experiment_channels, experiment_recording, experiment_table, motion_at
from ._run_log import LOG_VERSION, METADATA

_PARTS: dict[str, type] = {
    "bus": BusSettings,
    "limits": LimitSettings,
    "watch": WatchSettings,
    "ramps": RampSettings,
    "channels": ChannelSettings,
    "baseline": Baseline,
}


@dataclass(frozen=True, slots=True, eq=False)
class LoggedRun:
    """The log of one run.

    Attributes:
        path: of the file.
        facts: those of `run_facts`.
        cycles: steps of the master in order.
        rows: one for each sample of the controller while it ran: signal -> value in SI.
        row_cycles: index in `cycles` of each row.
        events: (time [s], name, text).
        cut: reason why reading ended early, "" if the log is complete.
        outside: frames outside all cycles, of pre-flight and end: (time [s], whether the master sent it, frame).
    """

    path: Path
    facts: Mapping[str, Any]
    cycles: tuple[Cycle, ...]
    rows: tuple[Mapping[str, float], ...]
    events: tuple[tuple[float, str, str], ...]
    cut: str = ""
    row_cycles: tuple[int, ...] = ()
    outside: tuple[tuple[float, bool, Frame], ...] = ()

    def frames(self) -> list[tuple[float, bool, Frame]]:
        """Return all frames on the bus: (time [s], whether the master sent it, frame)."""
        cycles = [
            (cycle.time, sent, frame)
            for cycle in self.cycles
            for sent, frames in ((False, cycle.received), (True, cycle.sent))
            for frame in frames
        ]
        return sorted([*cycles, *self.outside], key=lambda item: item[0])

    def settings(self) -> MasterSettings:
        """Return the settings of the run's master.

        Raises FileFormatError: damaged settings, or those of another version.
        """
        try:
            table = dict(self.facts["settings"])
            parts = {name: kind(**_tuples(table.pop(name))) for name, kind in _PARTS.items() if name in table}
            return MasterSettings(**_tuples(table), **parts)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"{self.path}: its settings do not fit this softneck ({error}).") from error

    def signals(self) -> LoopResult:
        """Return the rows as signals, as in the result of the run."""
        rows = self._owned_rows()
        names = list(dict.fromkeys(name for row in rows for name in row))
        signals: dict[str, Vector] = {name: np.array([row.get(name, math.nan) for row in rows]) for name in names}
        step = self.sample_time
        return LoopResult(np.arange(len(self.rows)) * step, signals, signal_units(names), step, self.robot)

    def _owned_rows(self) -> list[dict[str, float]]:
        robot = self.robot
        return [{robot.own(name): value for name, value in row.items()} for row in self.rows]

    @property
    def robot(self) -> Robot:
        """The robot of the run; the neck if the log has none.

        Raises:
            FileFormatError: a damaged robot.
        """
        if "robot" not in self.facts:
            return NECK
        try:
            return Robot.from_dict(self.facts["robot"])
        except SettingsError as error:
            raise FileFormatError(f"{self.path}: its robot is damaged: {error}") from error

    @property
    def sample_time(self) -> float:
        """Sample time of the controller [s]."""
        settings = self.settings()
        return settings.sample_cycles * settings.bus.cycle

    def recording(self) -> Recording:
        """Return the run as a recording, the same as `softneck drives run -o` or `record -o` writes.

        Raises DataError: the controller did not run.
        """
        if len(self.rows) < 2:
            raise DataError(f"{self.path}: the controller did not run, so there is nothing to identify from.")
        times = np.array([cycle.time for cycle in self.cycles])
        robot = self.robot
        try:
            positions = np.array([cycle.positions for cycle in self.cycles]).reshape(-1, len(robot.motors.names))
        except ValueError as error:
            raise FileFormatError(f"{self.path}: holds positions of other motors than its robot's.") from error
        if "run" not in self.rows[0]:
            return recording_of(self.signals(), motion_at(times, positions, self.row_cycles)[1], robot)
        # A row of an experiment is logged in the last cycle of its sample.
        late = self.settings().sample_cycles - 1
        columns = experiment_channels(
            experiment_table(self._owned_rows(), robot),
            *motion_at(times, positions, [cycle - late for cycle in self.row_cycles]),
            robot,
        )
        run = np.array([row["run"] for row in self.rows])
        recording = experiment_recording(columns, run, self.sample_time, robot)
        if recording is None:
            raise DataError(f"{self.path}: holds no angles, so there is nothing to identify from.")
        return recording


def read_run_log(path: str | Path) -> LoggedRun:
    """Read a `.mcap` log of `softneck drives`; a truncated file is read up to its end.

    Raises:
        FileFormatError: no such file, not MCAP, or not a log of softneck.
    """
    from mcap.records import Channel, Message, Metadata
    from mcap.stream_reader import StreamReader

    source = Path(path)
    facts: dict[str, Any] | None = None
    topics: dict[int, str] = {}
    cycles: list[Cycle] = []
    rows: list[Mapping[str, float]] = []
    at: list[int] = []
    events: list[tuple[float, str, str]] = []
    outside: list[tuple[float, bool, Frame]] = []
    cut = ""
    try:
        require_size(source)
        require_chunks(source)
        with source.open("rb") as stream:
            for record in StreamReader(stream, record_size_limit=LARGEST_RECORD, validate_crcs=True).records:
                if isinstance(record, Metadata) and record.name == METADATA:
                    facts = _facts(source, record.metadata)
                elif isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    topic = topics.get(record.channel_id)
                    if topic == "/cycle":
                        cycles.append(decode_cycle(_table(record.data)))
                    elif topic == "/frames":
                        table = _table(record.data)
                        outside.append((float(table["time"]), bool(table["sent"]), frame_of(table["frame"])))
                    elif topic == "/signals":
                        rows.append({name: float(value) for name, value in _table(record.data).items()})
                        at.append(len(cycles) - 1)
                    elif topic == "/events":
                        table, moment = _table(record.data), cycles[-1].time if cycles else 0.0
                        events.append((moment, str(table.get("name")), str(table.get("message"))))
    except OSError as error:
        raise FileFormatError(f"{source}: cannot be read ({error.strerror}).") from error
    except FileFormatError:
        raise
    except _damage() as error:
        if facts is None:
            raise FileFormatError(f"{source}: is not a log of `softneck drives` ({_word(error)}).") from error
        cut = f"ends in the middle ({_word(error)})"
    if facts is None:
        raise FileFormatError(f"{source}: is MCAP, but not a log of `softneck drives`: it has no `{METADATA}`.")
    return LoggedRun(source, facts, tuple(cycles), tuple(rows), tuple(events), cut, tuple(at), tuple(outside))


def _facts(source: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    if metadata.get("version") != str(LOG_VERSION):
        raise FileFormatError(
            f"{source}: has log version {metadata.get('version')}; this softneck reads {LOG_VERSION}."
        )
    facts = json.loads(metadata["facts"])
    files = facts.get("files", {}) if isinstance(facts, dict) else None
    if not isinstance(files, dict) or not all(isinstance(entry, dict) for entry in files.values()):
        raise FileFormatError(f"{source}: its metadata are damaged.")
    return facts


def _table(data: bytes) -> dict[str, Any]:
    table = json.loads(data)
    if not isinstance(table, dict):
        raise ValueError("a message that is not a table")  # noqa: TRY004  (bad content, told with all other damage)
    return table


def _tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    values = {key: _tuple(value) for key, value in table.items()}
    return {key: frozenset(value) if key == "off" else value for key, value in values.items()}


def _tuple(value: Any) -> Any:
    return tuple(_tuple(item) for item in value) if isinstance(value, list) else value


def _damage() -> tuple[type[Exception], ...]:
    """Return the exceptions that damaged bytes cause in mcap's reader and decompressor, which share no base class."""
    import zstandard
    from mcap.exceptions import McapError

    return (
        McapError, zstandard.ZstdError, EOFError, ValueError, KeyError, TypeError, IndexError, RuntimeError,
        ArithmeticError, MemoryError, struct.error,
    )  # fmt: skip


def _word(error: BaseException) -> str:
    return " ".join(str(error).split())[:120] or type(error).__name__


def changed_files(log: LoggedRun) -> list[str]:
    """Return a line for each file of the run that is missing or has changed."""
    lines = []
    for role, entry in log.facts.get("files", {}).items():
        path = Path(str(entry.get("path")))
        if not path.is_file():
            lines.append(f"{role} {path} is gone")
        elif file_hash(path) != entry.get("sha256"):
            lines.append(f"{role} {path} was changed since the run")
    return lines
