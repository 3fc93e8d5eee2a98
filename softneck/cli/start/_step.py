"""One step of a sitting: a command, what it reads and what it makes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from enum import Enum

#: In the order of the work, as they are counted for the user.
STAGES = ("import", "robot", "quality", "identification", "observer", "tune", "verify", "FMUs", "loop", "study",
          "test", "report")  # fmt: skip


class Unmet(Enum):
    """What a step means that ends with exit code 1."""

    FINDING = "a result, with which the sitting goes on"
    NO_MODEL = "nothing that comes after can be believed"
    DONE_WITHOUT = "what comes after does without what it makes, whatever the reason"


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A command, run in the project's folder.

    Attributes:
        stage: one of `STAGES`.
        command: its words; paths are relative to the folder.
        makes: files by which it is known to be done.
        reads: files that it is done again for where they change.
        unmet: what it means where it does not hold, or where a model is refused.
        finding: what does not hold whatever comes of it; empty where that is open.
        settings: what it is done again for beside `reads`; the command where it says nothing.
        resumes: file that an interrupted run leaves, with which it goes on without `--force`.
    """

    stage: str
    command: tuple[str, ...]
    makes: tuple[str, ...]
    reads: tuple[str, ...] = ()
    unmet: Unmet = Unmet.FINDING
    finding: str = ""
    settings: str = ""
    resumes: str = ""

    @property
    def key(self) -> str:
        """By which the sitting's file knows it."""
        return f"{self.stage}: {self.makes[0]}"

    @property
    def asked(self) -> str:
        """What it is done again for where it changes."""
        return self.settings or self.shown

    @property
    def shown(self) -> str:
        """The command as a shell takes it."""
        return shlex.join(self.command)
