"""The variables of an FMU as ports, and the calls that move them."""

from __future__ import annotations

import ctypes
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Slave
from fmpy.model_description import ModelDescription, ScalarVariable

from softneck.core import FileFormatError, Port, Vector

# FMI type -> (C type, numpy type, name in fmi2Get... and fmi2Set...).
_TYPES: dict[str, tuple[Any, Any, str]] = {
    "Real": (ctypes.c_double, np.float64, "Real"),
    "Integer": (ctypes.c_int, np.int32, "Integer"),
    "Enumeration": (ctypes.c_int, np.int32, "Integer"),
    "Boolean": (ctypes.c_int, np.int32, "Boolean"),
}


@dataclass(frozen=True, slots=True)
class Annotation:
    """What softneck's FMUs say about themselves beyond FMI; empty for others.

    Attributes:
        kind, role: of the block, "" for foreign FMUs.
        missing: names of variables whose NaN means "not measured".
    """

    kind: str = ""
    role: str = ""
    missing: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """An FMU's description as far as a loop needs it.

    Attributes:
        path: of the FMU.
        model: fmpy's own description.
        annotation: see `Annotation`.
        variables: our name -> variable, for all that can be numbers.
    """

    path: Path
    model: ModelDescription
    annotation: Annotation
    variables: Mapping[str, ScalarVariable]

    @property
    def identifier(self) -> str:
        """Return the name of the FMU's binary."""
        experiment = self.model.coSimulation
        return (experiment.modelIdentifier or "") if experiment is not None else ""

    def ports(self, causality: str) -> tuple[Port, ...]:
        """Return the ports of one causality ("input", "output", "parameter") in the FMU's order."""
        return tuple(
            self._port(name, variable) for name, variable in self.variables.items() if variable.causality == causality
        )

    def _port(self, name: str, variable: ScalarVariable) -> Port:
        declared = variable.declaredType
        return Port(
            name=name,
            unit=variable.unit or (declared.unit if declared is not None and declared.unit else "1"),
            description=variable.description or "",
            start=_number(variable.start, 0.0),
            minimum=_number(variable.min if variable.min is not None else getattr(declared, "min", None), None),
            maximum=_number(variable.max if variable.max is not None else getattr(declared, "max", None), None),
            nominal=_number(variable.nominal, None),
            boolean=variable.type == "Boolean",
            missing=variable.name in self.annotation.missing,
        )


def read_description(path: Path, folder: Path, names: Mapping[str, str]) -> Description:
    """Read the description of the FMU `path`, unpacked in `folder`.

    Args:
        path: for messages.
        folder: where it is unpacked.
        names: the FMU's variable name -> ours, for FMUs that use others.

    Raises:
        FileFormatError: no valid FMI 2.0 Co-Simulation FMU, or it lacks a variable of `names`.
    """
    try:
        model = fmpy.read_model_description(str(folder), validate=False)
    except Exception as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FileFormatError(f"{path}: its modelDescription.xml cannot be read ({reason}).") from error
    if model.fmiVersion != "2.0":
        raise FileFormatError(f"{path}: is an FMI {model.fmiVersion} FMU; this softneck runs FMI 2.0.")
    if model.coSimulation is None:
        raise FileFormatError(f"{path}: is for Model Exchange only; a Co-Simulation FMU is needed.")
    known = {variable.name for variable in model.modelVariables}
    absent = sorted(set(names) - known)
    if absent:
        raise FileFormatError(f"{path}: has no variable {', '.join(absent)}; it has {', '.join(sorted(known))}.")
    variables = {names.get(v.name, v.name): v for v in model.modelVariables if v.type in _TYPES}
    return Description(path, model, _annotation(folder), variables)


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Variables of one FMI type: where they stand in the vector and the buffers the C calls use."""

    places: np.ndarray
    references: Any
    buffer: Any
    view: np.ndarray
    call: str


class Bank:
    """Some variables of an FMU, moved from and to a vector with one C call for each type."""

    def __init__(self, variables: list[ScalarVariable]) -> None:
        """Prepare the buffers for `variables`, in the vector's order."""
        self.size = len(variables)
        self._groups: list[_Group] = []
        for kind in ("Real", "Integer", "Boolean"):
            places = [i for i, v in enumerate(variables) if _TYPES[v.type][2] == kind]
            if places:
                c_type, dtype, call = _TYPES[kind]
                references = (ctypes.c_uint * len(places))(*(variables[i].valueReference for i in places))
                buffer = (c_type * len(places))()
                view = np.frombuffer(buffer, dtype=dtype)
                self._groups.append(_Group(np.array(places), references, buffer, view, call))

    def write(self, fmu: FMU2Slave, values: Vector) -> None:
        """Set all variables from `values` (size,)."""
        for group in self._groups:
            chosen = values[group.places]
            group.view[:] = chosen != 0.0 if group.call == "Boolean" else chosen
            call = getattr(fmu, f"fmi2Set{group.call}")
            call(fmu.component, group.references, group.places.size, group.buffer)

    def read(self, fmu: FMU2Slave) -> Vector:
        """Return all variables (size,)."""
        values = np.empty(self.size)
        for group in self._groups:
            call = getattr(fmu, f"fmi2Get{group.call}")
            call(fmu.component, group.references, group.places.size, group.buffer)
            values[group.places] = group.view
        return values


def _annotation(folder: Path) -> Annotation:
    root = ET.parse(folder / "modelDescription.xml").getroot()
    block = root.find("VendorAnnotations/Tool[@name='softneck']/Block")
    if block is None:
        return Annotation()
    return Annotation(block.get("kind", ""), block.get("role", ""), frozenset(block.get("missing", "").split()))


def _number(text: Any, default: Any) -> Any:
    """Return an XML attribute as a float; Booleans become 0.0 and 1.0."""
    if text is None:
        return default
    if str(text) in ("true", "false"):
        return 1.0 if str(text) == "true" else 0.0
    return float(text)
