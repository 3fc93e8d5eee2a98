"""An FMU as a part of a loop, through fmpy's FMI calls."""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy import calloc, free
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    fmi2CallbackAllocateMemoryTYPE,
    fmi2CallbackFreeMemoryTYPE,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
)

from softneck.core import (
    DataError,
    FileFormatError,
    SettingsError,
    SoftneckError,
    Vector,
    require_one_of,
    require_positive,
)
from softneck.fmu import unpack, unpacked

from ._variables import Bank, Description, read_description

_ROLES = ("plant", "observer", "controller", "reference")
_WARNING, _ERROR, _FATAL = 1, 3, 4
# What pythonfmu's binary says of every Python exception; the reason stands in the line before.
_NO_REASON = "Fatal py exception encountered"


class FmuError(SoftneckError):
    """An FMU refused a call; the line carries the FMU's own reason."""


class FmuPart:
    """An FMI 2.0 Co-Simulation FMU as a `softneck.loop.Part`.

    Attributes:
        path: of the FMU.
        inputs, outputs, parameters: ports, in the FMU's order; Booleans are 0.0 and 1.0.
        sample_time: [s].
        role: "plant", "observer", "controller" or "reference".
        messages: the last lines of the FMU's log, as (status, text).
    """

    def __init__(
        self,
        path: str | Path,
        *,
        role: str | None = None,
        sample_time: float | None = None,
        names: Mapping[str, str] | None = None,
    ) -> None:
        """Read the FMU's description; it is unpacked and loaded at `start`.

        Args:
            path: the `.fmu` file.
            role: what it is in the loop; softneck's own FMUs know it themselves.
            sample_time: [s]; the step of the FMU's default experiment if not given.
            names: the FMU's variable name -> ours, for FMUs that use other names.

        Raises:
            FileFormatError: no FMI 2.0 Co-Simulation FMU for this platform.
            SettingsError: neither FMU nor caller say role or sample time.
        """
        self.path = Path(path)
        with unpacked(self.path) as folder:
            self._description = read_description(self.path, folder, names or {})
            _check_platform(self._description, folder)
        self.role = role or self._description.annotation.role
        if not self.role:
            raise SettingsError(f"{self.path}: say its role in the loop ({', '.join(_ROLES)}).")
        require_one_of("role", self.role, _ROLES)
        self.sample_time = _sample_time(self._description, sample_time)
        self.inputs = self._description.ports("input")
        self.outputs = self._description.ports("output")
        self.parameters = self._description.ports("parameter")
        self.messages: deque[tuple[int, str]] = deque(maxlen=100)
        self._inputs = self._bank(port.name for port in self.inputs)
        self._outputs = self._bank(port.name for port in self.outputs)
        self._fmu: FMU2Slave | None = None
        self._folder: Path | None = None
        self._broken = False

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Instantiate and initialise the FMU at `time` [s]; return its outputs (n_out,) there.

        Raises:
            SettingsError: a parameter that the FMU does not have.
            FmuError: the FMU refused; the line says why.
        """
        self.close()
        self.messages.clear()
        bank, values = self._parameter_bank(parameters)
        self._folder = unpack(self.path)
        fmu = self._fmu = self._instance(self._folder)
        self._do("it could not be instantiated", fmu.instantiate, False, _callbacks(self._log), True)
        self._do("setup", fmu.setupExperiment, None, time, None)
        self._do("parameters", bank.write, fmu, values)
        self._do("inputs", self._inputs.write, fmu, np.array([port.start for port in self.inputs]))
        self._do("initialisation", fmu.enterInitializationMode)
        self._do("initialisation", fmu.exitInitializationMode)
        return self._do("outputs", self._outputs.read, fmu)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step one sample from `time` [s] with `inputs` (n_in,); return the outputs (n_out,) after it.

        Raises:
            FmuError: the FMU refused; the line says why.
        """
        fmu = self._fmu
        if fmu is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        try:
            self._inputs.write(fmu, inputs)
            fmu.fmi2DoStep(fmu.component, time, self.sample_time, 1)
            return self._outputs.read(fmu)
        except FMICallException as error:
            raise self._refused(f"in the step from t = {time:g} s", error) from error

    def close(self) -> None:
        """Terminate the FMU, free it and remove what was unpacked."""
        fmu, self._fmu = self._fmu, None
        folder, self._folder = self._folder, None
        broken, self._broken = self._broken, False
        try:
            if fmu is not None and fmu.component is not None:
                _release(fmu, broken=broken, ours=bool(self._description.annotation.role))
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def __enter__(self) -> FmuPart:
        """Return the part itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _instance(self, folder: Path) -> FMU2Slave:
        model = self._description.model
        try:
            return FMU2Slave(
                guid=model.guid,
                unzipDirectory=str(folder),
                modelIdentifier=self._description.identifier,
                instanceName=self.path.stem,
            )
        except Exception as error:  # fmpy raises nothing narrower
            raise FileFormatError(f"{self.path}: its binary cannot be loaded ({error}).") from error

    def _bank(self, names: Any) -> Bank:
        return Bank([self._description.variables[name] for name in names])

    def _parameter_bank(self, parameters: Mapping[str, float]) -> tuple[Bank, Vector]:
        known = [port.name for port in self.parameters]
        for name in parameters:
            if name not in known:
                listed = ", ".join(known) or "none"
                raise SettingsError(f"`{name}` is no parameter of {self.path}; it has {listed}.")
        return self._bank(parameters), np.array([float(value) for value in parameters.values()])

    def _do(self, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except FMICallException as error:
            raise self._refused(f"at {what}", error) from error
        except Exception as error:
            # fmpy's own answer to a null instance
            self._broken = True
            raise FmuError(f"{self.path}: {what}: {self._reason() or error}") from error

    def _refused(self, when: str, error: FMICallException) -> FmuError:
        self._broken = self._broken or error.status >= _FATAL
        return FmuError(f"{self.path}: {when}: {self._reason() or error}")

    def _reason(self) -> str:
        lines = [text for status, text in self.messages if status >= _ERROR and not text.startswith(_NO_REASON)]
        return lines[-1] if lines else ""

    def _log(self, _environment: Any, _instance: bytes, status: int, _category: bytes, message: bytes) -> None:
        text = message.decode("utf-8", "replace").replace("%%", "%")
        self.messages.append((status, " ".join(text.split())))


def _callbacks(log: Callable[..., None]) -> fmi2CallbackFunctions:
    # Without fmpy's logger proxy: that is one for the process, and an FMU's log would reach another part.
    callbacks = fmi2CallbackFunctions()
    callbacks.logger = fmi2CallbackLoggerTYPE(log)
    callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
    return callbacks


def _release(fmu: FMU2Slave, *, broken: bool, ours: bool) -> None:
    if not broken:
        try:
            fmu.terminate()
        except FMICallException as error:
            broken = error.status >= _FATAL
    # After "fatal" FMI allows no further call; our own slave stays sound and is freed.
    if not broken or ours:
        fmu.freeInstance()


def _check_platform(description: Description, folder: Path) -> None:
    name = description.identifier
    if (folder / "binaries" / fmpy.platform / f"{name}{fmpy.sharedLibraryExtension}").is_file():
        return
    present = sorted(item.name for item in (folder / "binaries").glob("*")) or ["none"]
    raise FileFormatError(
        f"{description.path}: has no binary for this platform ({fmpy.platform}); it has {', '.join(present)}."
    )


def _sample_time(description: Description, given: float | None) -> float:
    experiment = description.model.defaultExperiment
    step = given if given is not None else getattr(experiment, "stepSize", None)
    if step is None:
        raise SettingsError(f"{description.path}: says no step size; give its sample time in s.")
    require_positive("sample_time", float(step), "s")
    return float(step)


def check_outputs(part: FmuPart, names: tuple[str, ...]) -> list[int]:
    """Return the positions of the outputs `names`; raise DataError if the FMU lacks one."""
    known = [port.name for port in part.outputs]
    for name in names:
        if name not in known:
            raise DataError(f"`{name}` is no output of {part.path}; it has {', '.join(known)}.")
    return [known.index(name) for name in names]
