"""What an FMU says about itself beyond its variables."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class FmuInfo:
    """Texts for people, and the length of the default experiment.

    Attributes:
        description: one line.
        author: who made the model, "" for none.
        license: SPDX name, "" for none.
        version: of the model, "" for none.
        copyright: one line, "" for none.
        documentation: HTML that goes into the body of `documentation/index.html`: how the model was
            identified, its scores, what it is not good for.
        stop_time: of the default experiment [s].
    """

    description: str = ""
    author: str = ""
    license: str = ""
    version: str = ""
    copyright: str = ""
    documentation: str = ""
    stop_time: float = 10.0
