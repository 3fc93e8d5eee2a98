"""A neck by preset name or parameter file, as several commands take it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from softneck.core import SettingsError

if TYPE_CHECKING:
    from softneck.plant import NeckParameters


def load_neck(name: str) -> NeckParameters:
    """Return the parameters of a preset, or of a TOML file.

    Raises:
        SettingsError: neither a preset nor a neck file.
    """
    from softneck.plant import NeckParameters
    from softneck.plant._presets import PRESETS

    if name not in PRESETS and not Path(name).is_file():
        raise SettingsError(f"`{name}` is neither a neck preset ({', '.join(PRESETS)}) nor a file.")
    return NeckParameters.preset(name)
