"""The block that an FMU of ours was made of, out of the FMU itself: so that a Python FMU can become a compiled one."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from softneck.core import SettingsError
from softneck.fmu import unpacked
from softneck.fmu.compiled._model_file import node_of
from softneck.runtime import Block, bundle
from softneck.runtime._compile import compiled_name

from ..parts._variables import Description, read_description


def block_without_python(path: Path) -> Block | None:
    """Return the block in an FMU that runs Python, None for an FMU that needs neither Python nor another tool.

    Raises:
        SettingsError: the FMU needs another tool, or was made by another version of softneck.
        FileFormatError: no FMU.
    """
    with unpacked(path) as folder:
        description = read_description(path, folder, {})
        facts = folder / "resources" / "block.json"
        if description.annotation.role and facts.is_file():
            return _block(path, folder, json.loads(facts.read_text(encoding="utf-8")), description)
        experiment = description.model.coSimulation
        if experiment is not None and experiment.needsExecutionTool:
            raise SettingsError(
                f"{path}: needs another program where it runs (needsExecutionTool), so that the SSP file would too; "
                "give a file of softneck instead, or use `--backend python`."
            )
        return None


def _block(path: Path, folder: Path, facts: dict, description: Description) -> Block:
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
