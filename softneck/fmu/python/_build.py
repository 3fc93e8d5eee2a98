"""Export of a block as an FMI 2.0 Co-Simulation FMU through pythonfmu."""

from __future__ import annotations

import hashlib
import io
import json
import keyword
import os
import re
import sys
import tempfile
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import distribution
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from softneck.core import SettingsError, as_path, atomic_write, refuse_existing
from softneck.design import own_module
from softneck.runtime import PREFIX, Block, Port, load_runtime

from ..describe._describe import HOST_NEEDS, Buildable, FmuInfo, block_and_info, documentation_page
from ..describe._description import (
    Identity,
    exported_block,
    generation_tool,
    model_description,
    terminals_file,
    with_limit_outputs,
)
from ._module import slave_module
from ._zip import read_zip, write_zip

_BINARY_FOLDERS = ("binaries/linux64/", "binaries/win64/")
_KNOWN_ROLES = ("plant", "observer", "controller", "reference")


def build_fmu(
    thing: Buildable | Block | str | Path, path: str | Path, *, info: FmuInfo | None = None, force: bool = False
) -> Path:
    """Write a model, observer, controller or neck as an FMI 2.0 Co-Simulation FMU and return its path.

    The FMU contains the runtime of the block's kind, its arrays and pythonfmu's binaries; it needs Python
    and numpy on the host, not softneck. The same block and info give the same bytes.

    Args:
        thing: a model, observer, controller or neck, its block, its file, or a preset of a neck or robot.
        path: `NAME.fmu`; NAME becomes the model name.
        info: texts of the FMU; those of `fmu_info` if not given.
        force: replace an existing file.

    Raises:
        SettingsError: NAME is not an FMI identifier, or the block cannot be packaged.
        OutputFileError: the file exists or cannot be written.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> model = softneck.identify("rls", recording)
        >>> softneck.build_fmu(model, "Neck.fmu").name
        'Neck.fmu'
    """
    target = as_path(path)
    name = model_name(target)
    refuse_existing(target, force=force)
    block, said = block_and_info(thing, info)
    check_block(block)
    members = _members(with_limit_outputs(exported_block(block)), said, name)
    with atomic_write(target, force=force) as temporary:
        write_zip(temporary, members)
    return target


def model_name(path: Path) -> str:
    """Return the model name of an FMU file: the stem of its file name."""
    if path.suffix != ".fmu":
        raise SettingsError(f"{path}: an FMU's file name must end in `.fmu`.")
    if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", path.stem) or keyword.iskeyword(path.stem):
        raise SettingsError(
            f"{path}: `{path.stem}` cannot be the model name of an FMU; name the file with letters, digits and _ only, "
            "no digit in front and no Python keyword."
        )
    return path.stem


def check_block(block: Block) -> None:
    """Raise SettingsError if a block cannot be exported as an FMU."""
    if block.role not in _KNOWN_ROLES:
        raise SettingsError(f"{block.kind}: role `{block.role}` must be one of {', '.join(_KNOWN_ROLES)}.")
    for port in (*block.inputs, *block.outputs, *block.parameters):
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", port.name):
            raise SettingsError(f"{block.kind}: `{port.name}` cannot be the name of an FMU variable.")


def _members(block: Block, info: FmuInfo, name: str) -> dict[str, bytes]:
    runtime, own = block.runtime, {}
    if found := re.search(rf"{PREFIX}\w+", runtime):
        carried, text = own_module(found[0])
        runtime, own = runtime.replace(found[0], carried), {f"{carried}.py": text.encode()}
    module = slave_module(runtime)
    arrays = _flat(block.arrays)
    facts = _facts(block, name) | {"module": module.name, "runtime": module.runtime, "options": module.options}
    content = hashlib.sha256()
    for part in (module.source, module.script, repr(facts), repr(info), generation_tool(), arrays.hex()):
        content.update(part.encode())
    guid = str(uuid.uuid5(uuid.NAMESPACE_OID, content.hexdigest()))
    resources = {
        "block.json": json.dumps(facts | {"guid": guid}, sort_keys=True).encode(),
        "arrays.npy": arrays,
        f"{module.name}.py": module.source.encode(),
        **own,
    }
    members = _through_pythonfmu(module.script_name, module.script, resources)
    missing = [folder for folder in _BINARY_FOLDERS if not any(member.startswith(folder) for member in members)]
    if missing:
        raise SettingsError(f"the installed pythonfmu lacks {', '.join(missing)}; install pythonfmu 0.6.9 or newer.")
    members["modelDescription.xml"] = model_description(block, info, Identity(name, guid, generation_date()))
    members["documentation/index.html"] = documentation_page(name, block, info).encode()
    members["documentation/host.txt"] = f"{HOST_NEEDS}\n".encode()
    members["documentation/licenses/license.txt"] = license_text("softneck", info.license).encode()
    members["documentation/licenses/pythonfmu.txt"] = license_text("pythonfmu", "MIT").encode()
    return members | terminals_file(block)


def _facts(block: Block, name: str) -> dict[str, Any]:
    """Return the JSON values that the slave reads: the block without its arrays."""
    return {
        "name": name,
        "kind": block.kind,
        "role": block.role,
        "sample_time": float(block.sample_time),
        "cost": "own" if PREFIX in block.runtime else step_cost(block),
        "module_of_runtime": ""
        if PREFIX in block.runtime
        else block.runtime,  # not for the slave: by this a compiled FMU can be made of this one
        "shapes": [list(array.shape) for array in block.arrays],
        "inputs": [_port_facts(port) for port in block.inputs],
        "outputs": [_port_facts(port) for port in block.outputs],
        "parameters": [_port_facts(port) for port in block.parameters],
    }


def _port_facts(port: Port) -> dict[str, Any]:
    return {
        "name": port.name,
        "unit": "1" if port.boolean else port.unit,
        "start": float(port.start),
        "low": float("-inf") if port.minimum is None else float(port.minimum),
        "high": float("inf") if port.maximum is None else float(port.maximum),
        "missing": port.missing,
        "tunable": port.tunable,
    }


def _flat(arrays: tuple[np.ndarray, ...]) -> bytes:
    """Return all arrays concatenated in one `.npy`: an instance starts ten times as fast as from an `.npz`."""
    buffer = io.BytesIO()
    flat = np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)
    np.save(buffer, flat.astype("<f8"), allow_pickle=False)
    return buffer.getvalue()


def _through_pythonfmu(module: str, source: str, resources: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return the members of the FMU that pythonfmu builds from the slave and its resources."""
    with tempfile.TemporaryDirectory(prefix="softneck-fmu-") as folder:
        script = Path(folder) / f"{module}.py"
        script.write_text(source, encoding="utf-8")
        files = [Path(folder) / name for name in resources]
        for file in files:
            file.write_bytes(resources[file.name])
        # pythonfmu imports the slave's class and leaves it in sys.modules; an instance would then read its resources
        # from pythonfmu's folder.
        with _imports_restored():
            from pythonfmu import FmuBuilder

            built = FmuBuilder.build_FMU(
                script, dest=Path(folder) / "built.fmu", project_files=files,
                canGetAndSetFMUstate=True, canSerializeFMUstate=True,
            )  # fmt: skip
        return read_zip(Path(built))


@contextmanager
def _imports_restored() -> Iterator[None]:
    path, bytecode, modules = list(sys.path), sys.dont_write_bytecode, set(sys.modules)
    sys.dont_write_bytecode = True
    # An FMU that ran in this process loaded its own pythonfmu, without binaries, and modules that use it.
    installed, loaded, from_fmus = str(distribution("pythonfmu").locate_file("")), sys.modules.get("pythonfmu"), {}
    if loaded is not None and not str(loaded.__file__).startswith(installed):
        from_fmus = {name: sys.modules.pop(name) for name in modules if name.startswith(("pythonfmu", "softneck_"))}
        sys.path.insert(0, installed)
    try:
        yield
    finally:
        sys.path[:] = path
        sys.dont_write_bytecode = bytecode
        new = ("pythonfmu", "softneck_") if from_fmus else "softneck_"
        for name in [name for name in sys.modules if name.startswith(new) and (from_fmus or name not in modules)]:
            sys.modules.pop(name)
        sys.modules.update(from_fmus)
        for entry in [key for key in sys.path_importer_cache if "softneck-fmu-" in key or "pythonfmu_" in key]:
            sys.path_importer_cache.pop(entry, None)


def generation_date() -> str:
    """Return SOURCE_DATE_EPOCH, or else the earliest date of a zip archive, so that equal blocks give equal bytes."""
    seconds = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(seconds), UTC) if seconds.isdigit() else datetime(1980, 1, 1, tzinfo=UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def license_text(package: str, stated: str) -> str:
    """Return the stated licence and the licence text of the package, which covers its code in the FMU."""
    for file in distribution(package).files or []:
        if file.name == "LICENSE":
            text = file.read_text(encoding="utf-8")
            return f"{stated}\n\nThe code of {package} in this FMU:\n\n{text}".lstrip()
    return f"{stated}\n\nThe code of {package} in this FMU is under the licence that {package} states.\n".lstrip()


# About 0.1 us for a line and 1 ns for a number: 15 us and more are "middling", 100 us and more are "heavy".
_MIDDLING_LINES, _HEAVY_LINES, _HEAVY_NUMBERS = 150, 1000, 20_000


def step_cost(block: Block) -> str:
    """Return "light", "middling" or "heavy": the cost of a step of `block` in plain Python."""
    if sum(array.size for array in block.arrays) > _HEAVY_NUMBERS:
        return "heavy"
    lines = _lines(block)
    return "heavy" if lines > _HEAVY_LINES else "middling" if lines > _MIDDLING_LINES else "light"


def _lines(block: Block) -> int:
    """Return the number of lines that one step in plain Python executes."""
    runtime = load_runtime(block.runtime, compiled=False)
    parameters = np.array([port.start for port in block.parameters])
    inputs = np.array([np.nan if port.missing else port.start for port in block.inputs])
    state, outputs = np.zeros(runtime.state_size(block.arrays)), np.zeros(len(block.outputs))
    count = 0

    def trace(_frame: FrameType, event: str, _argument: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    with np.errstate(all="ignore"):
        runtime.initialise(block.arrays, parameters, state, outputs)
        sys.settrace(trace)
        try:
            runtime.step(block.arrays, parameters, state, inputs, outputs)
        finally:
            sys.settrace(before)
    return count
