"""FMUs of ours as the blocks that they were made of."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from softneck.core import FileFormatError, SettingsError
from softneck.fmu import unpacked
from softneck.fmu.compiled._model_file import node_of
from softneck.runtime import Block, bundle
from softneck.runtime._compile import compiled_name

from ._variables import Description, read_description


def block_of(path: Path) -> Block | None:
    """Return the block in an FMU of this softneck that runs Python; None for any other.

    Raises:
        FileFormatError: no FMU, or what lies in it is damaged.
    """
    with unpacked(path) as folder:
        try:
            return python_block(path, folder, read_description(path, folder, {}))
        except SettingsError:
            return None


def python_block(path: Path, folder: Path, description: Description) -> Block | None:
    """Return the block in an FMU of ours that runs Python, unpacked in `folder`; None for any other FMU.

    Raises:
        SettingsError: it was made by another version of softneck.
        FileFormatError: what lies in it is damaged.
    """
    if not description.annotation.role or not (folder / "resources" / "block.json").is_file():
        return None
    try:
        return _stored(path, folder, description)
    except SettingsError:
        raise
    except Exception as error:  # json, numpy and Block raise whatever damaged bytes lead to
        said = (str(error).splitlines() or [type(error).__name__])[0][:120]
        raise FileFormatError(f"{path}: what softneck left in it is damaged ({said}).") from error


def _stored(path: Path, folder: Path, description: Description) -> Block:
    file = folder / "resources" / "block.json"
    facts = json.loads(file.read_text(encoding="utf-8"))
    runtime = facts.get("module_of_runtime", "")
    flat = np.load(folder / "resources" / "arrays.npy", allow_pickle=False)
    ends = np.cumsum([math.prod(shape) for shape in facts["shapes"]])
    parts = np.split(flat, ends[:-1]) if len(ends) else []
    arrays = tuple(part.reshape(shape) for part, shape in zip(parts, facts["shapes"], strict=True))
    # The table of kinds comes first: the name of a module from a file is not to be imported unseen.
    if runtime:
        node_of(runtime, arrays)
    if not runtime or compiled_name(bundle(runtime)) != facts["runtime"]:
        raise SettingsError(
            f"{path}: was made by another version of softneck, whose equations may differ; make it again with "
            "`softneck fmu`, or use `--backend python`."
        )
    return Block(
        kind=facts["kind"], role=facts["role"], runtime=runtime, sample_time=facts["sample_time"], arrays=arrays,
        inputs=description.ports("input"), outputs=description.ports("output"),
        parameters=description.ports("parameter"),
    )  # fmt: skip
