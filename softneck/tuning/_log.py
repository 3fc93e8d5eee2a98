"""What has been judged, on disk: one JSON file that is replaced as a whole, so that a search goes on where it was."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softneck.core import FileFormatError, OutputFileError, atomic_write
from softneck.core._budget import MOST_JSON, settings_text

from ._judge import Judgement

FILE = "evaluations.json"
_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Job:
    """One candidate at one level.

    Attributes:
        kind: of controller.
        settings: as JSON text with sorted keys.
        level: one of `LEVELS`.
    """

    kind: str
    settings: str
    level: str

    @classmethod
    def of(cls, kind: str, settings: Mapping[str, Any], level: str) -> Job:
        """Return the job of a candidate."""
        return cls(kind, json.dumps(dict(settings), sort_keys=True), level)


class Log:
    """All judgements so far, in the order in which they were asked for.

    Attributes:
        folder: of the search; None: nothing is written.
    """

    def __init__(self, folder: Path | None, digest: str, *, force: bool = False) -> None:
        """Begin, or go on with what is there of the same search.

        Raises:
            OutputFileError: the folder holds another search and `force` is not given.
        """
        self.folder, self._digest = folder, digest
        self._found: dict[Job, Judgement] = {}
        path = None if folder is None else folder / FILE
        there = path is not None and path.is_file()
        if path is None or not there:
            return
        content = _read(path)
        if content.get("digest") == digest:
            for row in content["evaluations"]:
                if row["error"]:
                    continue  # it is tried again: a later softneck may be able to
                self._found[Job(row["kind"], row["settings"], row["level"])] = Judgement(
                    {name: math.inf if value is None else float(value) for name, value in row["metrics"].items()}
                )
        elif not force:
            raise OutputFileError(
                f"{folder}: holds a search over other plants, requirements, kinds or seed; choose another folder, or "
                "--force replaces it."
            )

    def __len__(self) -> int:
        return len(self._found)

    def __contains__(self, job: Job) -> bool:
        return job in self._found

    def __getitem__(self, job: Job) -> Judgement:
        return self._found[job]

    def items(self) -> Iterator[tuple[Job, Judgement]]:
        """Return all jobs with what came of them."""
        return iter(self._found.items())

    def add(self, job: Job, judgement: Judgement) -> None:
        """Note what came of a job."""
        self._found[job] = judgement

    def write(self) -> None:
        """Write all of it; a reader sees the file before or the file after."""
        if self.folder is None:
            return
        rows = [
            {"kind": job.kind, "settings": job.settings, "level": job.level, "error": item.error,
             "metrics": {name: value if math.isfinite(value) else None for name, value in item.metrics.items()}}
            for job, item in self._found.items()
        ]  # fmt: skip
        text = json.dumps({"format": _FORMAT, "digest": self._digest, "evaluations": rows}, indent=1)
        with atomic_write(self.folder / FILE, force=True) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")


def _read(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(settings_text(path, MOST_JSON))
        if content["format"] != _FORMAT or not isinstance(content["evaluations"], list):
            raise ValueError("another format")
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise FileFormatError(f"{path}: is no log of a search that this softneck reads ({error}).") from error
    return content
