"""What an FMU tells people about the model, observer, controller or neck inside it."""

from __future__ import annotations

from html import escape
from typing import Any, Protocol

from softneck.core import Block

from ._info import FmuInfo

_LIMITS = {
    "plant": (
        "An identified plant is good where its training data were: other payloads, other tendons and slower or wilder "
        "motions than those recorded are guesses. In free run an error stays; nothing pulls it back."
    ),
    "observer": "It assumes the linear plant it was designed on; far from there its innovation says so.",
    "controller": "It was designed on a linear plant; verify the loop on the virtual neck before it moves hardware.",
}


class Buildable(Protocol):
    """Anything an FMU is made of."""

    def block(self) -> Block:
        """Return the block that steps."""
        ...

    def summary(self) -> str:
        """Return a few lines for people."""
        ...


def describe(thing: Buildable, *, scores: str = "", stop_time: float = 10.0) -> FmuInfo:
    """Return the texts of an FMU of `thing`: its summary, its settings, its scores and what it is not good for."""
    block = thing.block()
    summary = thing.summary()
    parts = [f"<pre>{escape(summary)}</pre>"]
    settings: dict[str, Any] = dict(getattr(thing, "settings", {}) or {})
    if settings:
        rows = "".join(f"<tr><td>{escape(str(k))}</td><td>{escape(str(v))}</td></tr>" for k, v in settings.items())
        parts.append(f"<h2>Settings</h2><table>{rows}</table>")
    if scores:
        parts.append(f"<h2>Scores</h2><pre>{escape(scores)}</pre>")
    if block.role in _LIMITS and block.kind != "virtual_neck":
        parts.append(f"<h2>What it is not good for</h2><p>{_LIMITS[block.role]}</p>")
    return FmuInfo(
        description=summary.splitlines()[0] if summary else block.kind,
        author="softneck",
        license="BSD-3-Clause (runtime); the model is its author's",
        documentation="\n".join(parts),
        stop_time=stop_time,
    )
