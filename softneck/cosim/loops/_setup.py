"""A loop with what is asked of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from softneck.core import require_one_of
from softneck.loop import Loop


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LoopSetup:
    """A loop with what is asked of it; a loop file describes one.

    Attributes:
        loop: the parts, the reference, the order.
        limits: metric -> upper limit, such as "pitch.overshoot_pct": 5.0.
        files: what was read for it: role -> (path, SHA-256).
        angle: which angle the metrics judge: "true" (where the plant offers it) or "measured".
    """

    loop: Loop
    limits: Mapping[str, float] = field(default_factory=dict)
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    angle: str = "true"

    def __post_init__(self) -> None:
        require_one_of("angle", self.angle, ("true", "measured"))
