"""The variables of an FMU as ports, their C types, and the block inside an FMU of softneck."""

from __future__ import annotations

import ctypes
import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import FileFormatError, SettingsError, error_reason
from softneck.fmu import LIMIT_OUTPUTS, node_of, unpacked
from softneck.runtime import Block, Port, bundle, compiled_name

if TYPE_CHECKING:
    from fmpy.model_description import ModelDescription, ScalarVariable

# FMI type -> (C type, numpy type, name in fmi2Get... or fmi3Get...).
_TYPES_2: dict[str, tuple[Any, Any, str]] = {
    "Real": (ctypes.c_double, np.float64, "Real"),
    "Integer": (ctypes.c_int, np.int32, "Integer"),
    "Enumeration": (ctypes.c_int, np.int32, "Integer"),
    "Boolean": (ctypes.c_int, np.int32, "Boolean"),
}
_TYPES_3: dict[str, tuple[Any, Any, str]] = {
    "Float64": (ctypes.c_double, np.float64, "Float64"),
    "Float32": (ctypes.c_float, np.float32, "Float32"),
    **{
        f"{u.upper()}Int{bits}": (getattr(ctypes, f"c_{u}int{bits}"), f"{u}int{bits}", f"{u.upper()}Int{bits}")
        for u in ("", "u")
        for bits in (8, 16, 32, 64)
    },
    "Enumeration": (ctypes.c_int64, np.int64, "Int64"),
    "Boolean": (ctypes.c_bool, np.bool_, "Boolean"),
}


# FMI version -> its types.
FMI_TYPES = {2: _TYPES_2, 3: _TYPES_3}


@dataclass(frozen=True, slots=True)
class Annotation:
    """The annotation of softneck in its FMUs, empty for others; `missing` are variables whose NaN is "not measured".

    `robot` has name and hash, "" for necks.
    """

    kind: str = ""
    role: str = ""
    missing: frozenset[str] = frozenset()
    robot: tuple[str, str] = ("", "")


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """The parts of an FMU's description that a loop needs.

    `path`: of the FMU. `model`: fmpy's description. `annotation`: see `Annotation`. `variables`: our name -> variable,
    for all numbers. `version`: of FMI, 2 or 3. `units`: our name -> unit, which replace those of the FMU.
    """

    path: Path
    model: ModelDescription
    annotation: Annotation
    variables: Mapping[str, ScalarVariable]
    version: int = 2
    units: Mapping[str, str] = field(default_factory=dict)

    @property
    def identifier(self) -> str:
        """Return the name of the FMU's binary."""
        return (self.interface.modelIdentifier or "") if self.interface is not None else ""

    @property
    def interface(self) -> Any:
        """Return the interface that softneck runs: Co-Simulation if there is one, else Model Exchange."""
        return self.model.coSimulation if self.model.coSimulation is not None else self.model.modelExchange

    def ports(self, causality: str) -> tuple[Port, ...]:
        """Return the ports of one causality ("input", "output", "parameter") in the FMU's order."""
        return tuple(
            self._port(name, variable) for name, variable in self.variables.items() if variable.causality == causality
        )

    def _port(self, name: str, variable: ScalarVariable) -> Port:
        declared = variable.declaredType
        return Port(
            name=name,
            unit=self.units.get(name) or variable.unit or (declared.unit if declared is not None else "") or "1",
            description=variable.description or "",
            start=number_of(variable.start, 0.0),
            minimum=number_of(variable.min if variable.min is not None else getattr(declared, "min", None), None),
            maximum=number_of(variable.max if variable.max is not None else getattr(declared, "max", None), None),
            nominal=number_of(variable.nominal, None),
            boolean=variable.type == "Boolean",
            # An enumeration is the number of an item.
            integer=variable.type not in ("Real", "Float64", "Float32", "Boolean"),
            missing=variable.name in self.annotation.missing,
            tunable=variable.variability == "tunable",
        )


def read_description(
    path: Path, folder: Path, names: Mapping[str, str], units: Mapping[str, str] | None = None
) -> Description:
    """Read the description of the FMU `path`, unpacked in `folder`.

    `names` (the FMU's variable name -> ours) and `units` (our name -> unit) are as in `FmuPart`. Raises
    FileFormatError: no valid FMU of FMI 2.0 or 3.0, only with interfaces that need a solver or a scheduler, or without
    a variable of `names`.
    """
    import fmpy

    try:
        model = fmpy.read_model_description(str(folder), validate=False)
    except Exception as error:
        raise FileFormatError(f"{path}: its modelDescription.xml cannot be read ({error_reason(error)}).") from error
    version = {"2": 2, "3": 3}.get(str(model.fmiVersion).partition(".")[0])
    if version is None:
        raise FileFormatError(f"{path}: is an FMI {model.fmiVersion} FMU; softneck runs FMI 2.0 and 3.0.")
    if model.coSimulation is None:
        _check_exchange(path, model)
    known = {variable.name for variable in model.modelVariables}
    absent = sorted(set(names) - known)
    if absent:
        raise FileFormatError(f"{path}: has no variable {', '.join(absent)}; it has {', '.join(sorted(known))}.")
    arrays = {v.name: v.dimensions for v in model.modelVariables if v.dimensions}
    if wanted := sorted(arrays.keys() & set(names)):
        raise FileFormatError(f"{path}: `{wanted[0]}` is an array; the variables of a part are single numbers.")
    numbers = [v for v in model.modelVariables if v.type in FMI_TYPES[version] and not v.dimensions]
    variables: dict[str, ScalarVariable] = {}
    for variable in numbers:
        name = names.get(variable.name, variable.name)
        if name in variables:
            raise FileFormatError(f"{path}: {variables[name].name} and {variable.name} are both named `{name}`.")
        variables[name] = variable
    for name in units or {}:
        if name not in variables:
            raise FileFormatError(f"{path}: a unit is given for `{name}`, which is not one of its variables.")
    try:
        annotation = _annotation(folder)
    except ET.ParseError as error:  # fmpy's parser accepts more than Python's
        raise FileFormatError(f"{path}: its modelDescription.xml cannot be read ({error}).") from error
    return Description(path, model, annotation, variables, version, units or {})


def shown_name(variable: ScalarVariable) -> str:
    """Return the name of a variable; that of an array of FMI 3.0 with its size, such as `u[3]` or `u[n][2]`."""
    sizes = (item.start or (item.variable.name if item.variable is not None else "?") for item in variable.dimensions)
    return f"{variable.name}{''.join(f'[{size}]' for size in sizes)}"


def interfaces_of(model: ModelDescription) -> list[str]:
    """Return the interfaces of an FMU by their names in FMI."""
    found = {
        "Model Exchange": model.modelExchange,
        "Co-Simulation": model.coSimulation,
        "Scheduled Execution": getattr(model, "scheduledExecution", None),
    }
    return [name for name, interface in found.items() if interface is not None]


def _check_exchange(path: Path, model: ModelDescription) -> None:
    """Refuse what needs a solver: softneck runs Model Exchange FMUs whose only dynamics are events at known times."""
    if model.modelExchange is None:
        only = ", ".join(interfaces_of(model)) or "no interface"
        raise FileFormatError(f"{path}: is for {only} only; export it for Co-Simulation.")
    states, zeros = int(model.numberOfContinuousStates or 0), int(model.numberOfEventIndicators or 0)
    if states or zeros:
        what = f"{states} continuous states" if states else f"{zeros} event indicators"
        raise FileFormatError(
            f"{path}: is for Model Exchange only and has {what}, which need a solver; export it for Co-Simulation."
        )


def _annotation(folder: Path) -> Annotation:
    root = ET.parse(folder / "modelDescription.xml").getroot()
    places = ("VendorAnnotations/Tool[@name='softneck']/Block", "Annotations/Annotation[@type='softneck']/Block")
    block = next((found for found in map(root.find, places) if found is not None), None)  # FMI 2.0, FMI 3.0
    if block is None:
        return Annotation()
    robot = (block.get("robot", ""), block.get("robotHash", ""))
    return Annotation(block.get("kind", ""), block.get("role", ""), frozenset(block.get("missing", "").split()), robot)


def number_of(text: Any, default: Any) -> Any:
    """Return an XML attribute as a float; Booleans become 0.0 and 1.0."""
    if text is None:
        return default
    if str(text) in ("true", "false"):
        return 1.0 if str(text) == "true" else 0.0
    try:
        return float(text)
    except ValueError:
        raise FileFormatError(f"modelDescription.xml has the attribute `{text}` where a number is needed.") from None


def read_block(path: Path) -> Block | None:
    """Return the block in an FMU of this softneck that runs Python; None for any other."""
    with unpacked(path) as folder:
        try:
            return python_block(path, folder, read_description(path, folder, {}))
        except SettingsError:
            return None


def python_block(path: Path, folder: Path, description: Description) -> Block | None:
    """Return the block in a Python FMU of softneck, unpacked in `folder`; None for any other FMU."""
    if not description.annotation.role or not (folder / "resources" / "block.json").is_file():
        return None
    try:
        return _read_block(path, folder, description)
    except SettingsError:
        raise
    except Exception as error:  # json, numpy and Block raise many errors for damaged bytes
        raise FileFormatError(f"{path}: its block is damaged ({error_reason(error)}).") from error


def _read_block(path: Path, folder: Path, description: Description) -> Block:
    file = folder / "resources" / "block.json"
    facts = json.loads(file.read_text(encoding="utf-8"))
    runtime = facts.get("module_of_runtime", "")
    flat = np.load(folder / "resources" / "arrays.npy", allow_pickle=False)
    ends = np.cumsum([math.prod(shape) for shape in facts["shapes"]])
    parts = np.split(flat, ends[:-1]) if len(ends) else []
    arrays = tuple(part.reshape(shape) for part, shape in zip(parts, facts["shapes"], strict=True))
    # A module that a file names is imported only if the table of kinds has it.
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
        # The FMU's own parameter is none of the block's.
        parameters=tuple(port for port in description.ports("parameter") if port.name != LIMIT_OUTPUTS),
    )  # fmt: skip
