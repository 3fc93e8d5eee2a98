"""An FMU as a part of a loop, through fmpy's FMI calls."""

from __future__ import annotations

import shutil
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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

from ._native import ERROR, FATAL, Bank, CallError, Native
from ._variables import Description, number_of, read_description

if TYPE_CHECKING:
    from fmpy.fmi1 import FMICallException


_ROLES = ("plant", "observer", "controller", "reference")
# What pythonfmu's binary says of every Python exception; the reason stands in the line before.
_NO_REASON = "Fatal py exception encountered"


class FmuError(SoftneckError):
    """An FMU refused a call; the line carries the FMU's own reason."""


class FmuPart:
    """An FMI 2.0 or 3.0 Co-Simulation FMU as a `softneck.loop.Part`.

    Attributes:
        path: of the FMU.
        inputs, outputs, parameters: ports, in the FMU's order; Booleans are 0.0 and 1.0.
        sample_time: [s].
        role: "plant", "observer", "controller" or "reference".
        native_names: our name -> the FMU's, where the mapping renames.
        units: our name -> unit, as the caller gave them.
        robot_told: name and hash of the robot that the FMU says it is of, "" where it says none.
        messages: the last lines of the FMU's log, as (status, text).
    """

    def __init__(
        self,
        path: str | Path,
        *,
        role: str | None = None,
        sample_time: float | None = None,
        names: Mapping[str, str] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> None:
        """Read the FMU's description; it is unpacked and loaded at `start`.

        Args:
            path: the `.fmu` file.
            role: what it is in the loop; softneck's own FMUs know it themselves.
            sample_time: [s]; the step of the FMU's default experiment if not given.
            names: the FMU's variable name -> ours, for FMUs that use other names.
            units: our name -> unit, for FMUs that state none or a wrong one.

        Raises:
            FileFormatError: no FMI 2.0 or 3.0 Co-Simulation FMU for this platform.
            SettingsError: neither FMU nor caller say role or sample time.
        """
        self.path = Path(path)
        with unpacked(self.path) as folder:
            self._description = read_description(self.path, folder, names or {}, units)
            _check_platform(self._description, folder)
        self.native_names = {ours: theirs for theirs, ours in (names or {}).items()}
        self.units = dict(units or {})
        self.robot_told = self._description.annotation.robot
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
        self._native: Native | None = None
        self._folder: Path | None = None
        self._broken = False

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Instantiate and initialise the FMU at `time` [s]; return its outputs (n_out,) there.

        An instance that is still loaded is reset and used again, which costs less and leaks nothing.

        Raises:
            SettingsError: a parameter that the FMU does not have.
            FmuError: the FMU refused; the line says why.
        """
        bank, values = self._parameter_bank(parameters)
        self.messages.clear()
        native = self._fresh()
        self._do("setup", native.setup, time)
        bank.bind(native)
        self._do("parameters", bank.write, values)
        self._do("inputs", self._inputs.write, np.array([port.start for port in self.inputs]))
        self._do("initialisation", native.enter, time)
        self._do("initialisation", native.exit)
        return self._do("outputs", self._outputs.read)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step one sample from `time` [s] with `inputs` (n_in,); return the outputs (n_out,) after it.

        Raises:
            FmuError: the FMU refused; the line says why.
        """
        native = self._native
        if native is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        try:
            self._inputs.write(inputs)
            native.step(time, self.sample_time)
            return self._outputs.read()
        except CallError as error:
            raise self._refused(f"in the step from t = {time:g} s", error) from error

    def close(self) -> None:
        """Terminate the FMU, free it and remove what was unpacked."""
        native, self._native = self._native, None
        folder, self._folder = self._folder, None
        broken, self._broken = self._broken, False
        try:
            if native is not None:
                native.release(broken=broken, ours=bool(self._description.annotation.role))
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def get_state(self) -> bytes:
        """Return the whole state of the FMU, serialised by itself.

        Raises:
            SettingsError: the FMU cannot serialise its state.
        """
        experiment: Any = self._description.model.coSimulation
        if not (experiment.canGetAndSetFMUstate and experiment.canSerializeFMUstate) or self._native is None:
            raise SettingsError(f"{self.path}: cannot save its state; its canSerializeFMUstate is false.")
        return self._do("its state", self._native.get_state)

    def set_state(self, state: bytes) -> None:
        """Go on from a state that `get_state` returned, here or in another process."""
        if self._native is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        self._do("its state", self._native.set_state, state)

    def __enter__(self) -> FmuPart:
        """Return the part itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def _fresh(self) -> Native:
        """Return an instance before its initialisation."""
        from fmpy.fmi1 import FMICallException

        if self._native is not None and not self._broken:
            try:
                self._native.reset()
                return self._native
            except (FMICallException, CallError):
                self._broken = True
        self.close()
        self._folder = unpack(self.path)
        try:
            self._native = Native(self._description, self._folder, lambda *line: self.messages.append(line))
        except Exception as error:  # fmpy raises nothing narrower
            raise FileFormatError(f"{self.path}: its binary cannot be loaded ({error}).") from error
        self._do("it could not be instantiated", self._native.instantiate)
        self._inputs.bind(self._native)
        self._outputs.bind(self._native)
        return self._native

    def _bank(self, names: Iterable[str]) -> Bank:
        return Bank([self._description.variables[name] for name in names], self._description.version)

    def _parameter_bank(self, parameters: Mapping[str, float]) -> tuple[Bank, Vector]:
        known = [port.name for port in self.parameters]
        for name in parameters:
            if name not in known:
                listed = ", ".join(known) or "none"
                raise SettingsError(f"`{name}` is not a parameter of {self.path}; it has {listed}.")
        return self._bank(parameters), np.array([float(value) for value in parameters.values()])

    def _do(self, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
        from fmpy.fmi1 import FMICallException

        try:
            return call(*arguments)
        except (FMICallException, CallError) as error:
            raise self._refused(f"at {what}", error) from error
        except Exception as error:
            # fmpy's own answer to a null instance
            self._broken = True
            raise FmuError(f"{self.path}: {what}: {self._reason() or error}") from error

    def _refused(self, when: str, error: FMICallException | CallError) -> FmuError:
        self._broken = self._broken or error.status >= FATAL
        return FmuError(f"{self.path}: {when}: {self._reason() or error}")

    def _reason(self) -> str:
        lines = [text for status, text in self.messages if status >= ERROR and not text.startswith(_NO_REASON)]
        return lines[-1] if lines else ""


def _check_platform(description: Description, folder: Path) -> None:
    import fmpy

    name = description.identifier
    wanted = fmpy.platform if description.version == 2 else fmpy.platform_tuple
    if (folder / "binaries" / wanted / f"{name}{fmpy.sharedLibraryExtension}").is_file():
        return
    present = sorted(item.name for item in (folder / "binaries").glob("*")) or ["none"]
    raise FileFormatError(
        f"{description.path}: has no binary for this platform ({wanted}); it has {', '.join(present)}."
    )


def _sample_time(description: Description, given: float | None) -> float:
    experiment = description.model.defaultExperiment
    step = given if given is not None else number_of(getattr(experiment, "stepSize", None), None)
    if step is None:
        raise SettingsError(f"{description.path}: states no step size; give its sample time in s.")
    require_positive("sample_time", step, "s")
    return float(step)


def check_outputs(part: FmuPart, names: tuple[str, ...]) -> list[int]:
    """Return the positions of the outputs `names`; raise DataError if the FMU lacks one."""
    known = [port.name for port in part.outputs]
    for name in names:
        if name not in known:
            raise DataError(f"`{name}` is not an output of {part.path}; it has {', '.join(known)}.")
    return [known.index(name) for name in names]
