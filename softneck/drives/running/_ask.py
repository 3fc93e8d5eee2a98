"""What somebody who is not the loop wants of a run."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum


class Ask(StrEnum):
    """What an operator wants of a run."""

    LEAVE = "leave"
    STOP = "stop"


Operator = Callable[[], Ask | None]
