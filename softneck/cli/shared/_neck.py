"""A neck by preset name or parameter file, as several commands take it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import SettingsError

if TYPE_CHECKING:
    from softneck.plant import NeckParameters


_PRESETS = ("paper", "lab")


def load_neck(name: str) -> NeckParameters:
    """Return the parameters of preset `paper` or `lab`, or of a TOML file.

    Raises:
        SettingsError: neither a preset nor a neck file.
    """
    from softneck.plant import NeckParameters

    if name == "paper":
        return NeckParameters.paper()
    if name == "lab":
        return NeckParameters.lab()
    if not Path(name).is_file():
        raise SettingsError(f"`{name}` is neither a neck preset ({', '.join(_PRESETS)}) nor a file.")
    return NeckParameters.from_toml(name)
