"""Plants that a command is given: models, families, necks by file or preset, FMUs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from softneck.core import SettingsError

from ._robot import load_of


def opened_plants(plants: tuple[Path, ...], robot: str | None) -> dict[str, Any]:
    """Return name -> plant.

    Args:
        plants: files, or presets of necks.
        robot: a preset or a robot file; None: what the files say.

    Raises:
        SettingsError: no plant.
    """
    from softneck.cosim import FmuPart
    from softneck.plant import NeckParameters
    from softneck.plant._presets import PRESETS

    things: dict[str, Any] = {}
    for item in plants:
        if item.suffix == ".fmu":
            # FMUs are loaded in several threads, each of which works in the FMU's own folder for a moment.
            thing: Any = partial(FmuPart, item.absolute(), role="plant")
        elif item.suffix == ".toml" or (str(item) in PRESETS and not item.exists()):
            thing = NeckParameters.preset(str(item))
        else:
            thing = load_of(item, robot)
            if not hasattr(thing, "tf"):
                raise SettingsError(
                    f"{item}: a MODEL, FAMILY, NECK or FMU is needed; this is a {type(thing).__name__}."
                )
        things[item.name if item.name not in things else str(item)] = thing
    return things
