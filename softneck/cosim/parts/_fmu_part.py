"""An FMU as a part of a loop, or simulated with recorded signals, by the FMI calls of fmpy."""

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
    Matrix,
    SettingsError,
    SoftneckError,
    Vector,
    require_one_of,
    require_positive,
)
from softneck.fmu import unpack, unpacked
from softneck.loop import PART_NAMES, EndedError
from softneck.signals import Recording

from ._native import ERROR, FATAL, Bank, CallError, Native
from ._variables import Description, number_of, read_description

if TYPE_CHECKING:
    from fmpy.fmi1 import FMICallException

# The message of pythonfmu's binary for every Python exception; the reason is in the line before.
_NO_REASON = "Fatal py exception encountered"


class FmuError(SoftneckError):
    """An FMU refused a call; the message has the FMU's own reason."""


class FmuPart:
    """An FMI 2.0 or 3.0 FMU as a `softneck.loop.Part`: Co-Simulation, or Model Exchange without continuous states.

    Attributes:
        path: of the FMU.
        inputs, outputs, parameters: ports, in the FMU's order; Booleans are 0.0 and 1.0.
        sample_time: [s].
        role: "plant", "observer", "controller" or "reference".
        native_names: our name -> the FMU's name, for renamed variables.
        units: our name -> unit, as the caller gave them.
        annotated_robot: name and hash of the robot in the FMU's annotation, "" without one.
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
        """Read the FMU's description; `start` unpacks and loads it.

        Args:
            path: the `.fmu` file.
            role: in the loop; softneck's FMUs state their own.
            sample_time: [s]; default: the step of the FMU's default experiment.
            names: the FMU's variable name -> ours, for FMUs with other names.
            units: our name -> unit, for FMUs that state none or a wrong one.

        Raises:
            FileFormatError: no such FMU for this platform.
            SettingsError: neither FMU nor caller states role or sample time.
        """
        self.path = Path(path)
        with unpacked(self.path) as folder:
            self._description = read_description(self.path, folder, names or {}, units)
            _check_platform(self._description, folder)
        self.native_names = {ours: theirs for theirs, ours in (names or {}).items()}
        self.units = dict(units or {})
        self.annotated_robot = self._description.annotation.robot
        self.role = role or self._description.annotation.role
        if not self.role:
            raise SettingsError(f"{self.path}: give its role in the loop ({', '.join(PART_NAMES)}).")
        require_one_of("role", self.role, PART_NAMES)
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

        A loaded instance is reset and used again, which costs less than a new one.

        Raises:
            SettingsError: a parameter that the FMU does not have.
            FmuError: the FMU refused; the message says why.
        """
        known = [port.name for port in self.parameters]
        for name in parameters:
            if name not in known:
                listed = ", ".join(known) or "none"
                raise SettingsError(f"`{name}` is not a parameter of {self.path}; it has {listed}.")
        bank, values = self._bank(parameters), np.array([float(value) for value in parameters.values()])
        self.messages.clear()
        native = self._prepare_instance()
        self._call("setup", native.setup, time)
        bank.bind(native)
        self._call("parameters", bank.write, values)
        self._call("inputs", self._inputs.write, np.array([port.start for port in self.inputs]))
        self._call("initialisation", native.initialise, time)
        return self._call("outputs", self._outputs.read)

    def advance(self, time: float, inputs: Vector) -> Vector:
        """Step one sample from `time` [s] with `inputs` (n_in,); return the outputs (n_out,) after it.

        Raises:
            FmuError: the FMU refused; the message says why.
        """
        native = self._native
        if native is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        try:
            self._inputs.write(inputs)
            native.step(time, self.sample_time)
            if native.exchange:
                return self._reach(native, time + self.sample_time)
            return self._outputs.read()
        except CallError as error:
            raise self._call_error(f"in the step from t = {time:g} s", error) from error
        except EndedError as error:
            raise EndedError(f"{self.path}: in the step from t = {time:g} s {error}.") from error

    def _reach(self, native: Native, time: float) -> Vector:
        """Enter the event at `time` [s]; return a plant's outputs there, and those before it of any other part."""
        if self.role == "plant":
            native.reach(time)
            return self._outputs.read()
        outputs = self._outputs.read()
        native.reach(time)
        return outputs

    def close(self) -> None:
        """Terminate the FMU, free it and remove its unpacked files."""
        native, self._native = self._native, None
        folder, self._folder = self._folder, None
        broken, self._broken = self._broken, False
        try:
            if native is not None:
                native.release(broken=broken, is_softneck=bool(self._description.annotation.role))
        finally:
            if folder is not None:
                shutil.rmtree(folder, ignore_errors=True)

    def get_state(self) -> bytes:
        """Return the whole state of the FMU, serialised by itself.

        Raises:
            SettingsError: the FMU cannot serialise its state.
        """
        interface = self._description.interface
        if not (interface.canGetAndSetFMUstate and interface.canSerializeFMUstate) or self._native is None:
            raise SettingsError(f"{self.path}: cannot save its state; its canSerializeFMUstate is false.")
        return self._call("its state", self._native.get_state)

    def set_state(self, state: bytes) -> None:
        """Continue from a state of `get_state`, of this or another process."""
        if self._native is None:
            raise FmuError(f"{self.path}: is not running; call `start` first.")
        self._call("its state", self._native.set_state, state)

    def __enter__(self) -> FmuPart:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _prepare_instance(self) -> Native:
        """Return an instance that is not initialised yet."""
        from fmpy.fmi1 import FMICallException

        if self._native is not None and not self._broken:
            try:
                self._native.fmu.reset()
                return self._native
            except (FMICallException, CallError):
                self._broken = True
        self.close()
        self._folder = unpack(self.path)
        try:
            self._native = Native(self._description, self._folder, lambda *line: self.messages.append(line))
        except Exception as error:  # fmpy raises nothing narrower
            raise FileFormatError(f"{self.path}: its binary cannot be loaded ({error}).") from error
        self._call("it could not be instantiated", self._native.instantiate)
        self._inputs.bind(self._native)
        self._outputs.bind(self._native)
        return self._native

    def _bank(self, names: Iterable[str]) -> Bank:
        return Bank([self._description.variables[name] for name in names], self._description.version)

    def _call(self, what: str, call: Callable[..., Any], *arguments: Any) -> Any:
        from fmpy.fmi1 import FMICallException

        try:
            return call(*arguments)
        except (FMICallException, CallError) as error:
            raise self._call_error(f"at {what}", error) from error
        except Exception as error:  # of fmpy, for a null instance
            self._broken = True
            raise FmuError(f"{self.path}: {what}: {self._reason() or error}") from error

    def _call_error(self, when: str, error: FMICallException | CallError) -> FmuError:
        self._broken = self._broken or error.status >= FATAL
        return FmuError(f"{self.path}: {when}: {self._reason() or error}")

    def _reason(self) -> str:
        lines = [text for status, text in self.messages if status >= ERROR and not text.startswith(_NO_REASON)]
        return lines[-1] if lines else ""


def naming_arguments(part: Any, names: Mapping[str, str]) -> dict[str, Any]:
    """Return the arguments `names` and `units` of an FMU's part whose variables get other names."""
    native = {**{name: name for name in names}, **part.native_names}
    return {
        "names": {theirs: names.get(ours, ours) for ours, theirs in native.items()},
        "units": {names.get(ours, ours): unit for ours, unit in part.units.items()},
    }


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
        raise SettingsError(
            f"{description.path}: states no step size; give its sample time in s (`sample_time_s` in a loop file)."
        )
    require_positive("sample_time", step, "s")
    return float(step)


def drive_fmu(
    path: str | Path,
    inputs: Mapping[str, Vector],
    *,
    parameters: Mapping[str, float] | None = None,
    outputs: tuple[str, ...] | None = None,
    start_time: float = 0.0,
) -> Matrix:
    """Step an FMU through rows of inputs, name -> (rows,), and return its outputs (rows, n_out); row k is at t_k.

    Row 0 of a plant has its outputs at the start, row k its outputs after the inputs up to row k - 1. Row k of an
    observer or controller has its outputs for the inputs of row k. Inputs without a column keep their start value.
    """
    part = FmuPart(path)
    rows = _rows(part, inputs)
    known = [port.name for port in part.outputs]
    for name in outputs or ():
        if name not in known:
            raise DataError(f"`{name}` is not an output of {path}; it has {', '.join(known)}.")
    chosen = [known.index(name) for name in (known if outputs is None else outputs)]
    table = np.empty((len(rows), len(part.outputs)))
    plant = part.role == "plant"
    with part:
        now = part.start(start_time, parameters or {})
        for k, row in enumerate(rows):
            after = part.advance(start_time + k * part.sample_time, row) if k + 1 < len(rows) or not plant else now
            table[k] = now if plant else after
            now = after
    return table[:, chosen]


def simulate_fmu(
    path: str | Path,
    recording: Recording,
    *,
    parameters: Mapping[str, float] | None = None,
    outputs: tuple[str, ...] | None = None,
) -> Matrix:
    """Simulate a plant FMU (free run) with a recording's set-points; return its outputs (time, n_out).

    Row k is at the recording's row k; each run of the recording starts from the initial state.

    Args:
        path: the FMU.
        recording: with the set-points.
        parameters: values by name, such as `pitch_start` [rad].
        outputs: names; default: all.

    Raises:
        DataError: another sample time than the FMU's, or unknown names.
        FmuError: the FMU refused; the message says why.
    """
    part = FmuPart(path)
    if not np.isclose(part.sample_time, recording.sample_time, rtol=1e-6):  # rounding of decimals
        raise DataError(
            f"{path}: runs at {part.sample_time:g} s and the recording is at {recording.sample_time:g} s; "
            "resample the recording."
        )
    tables = []
    for run in recording.runs():
        drive = dict(zip(run.robot.set_points, run.set_points.T, strict=True))
        tables.append(drive_fmu(path, drive, parameters=parameters, outputs=outputs, start_time=float(run.time[0])))
    return np.concatenate(tables)


def _rows(part: FmuPart, inputs: Mapping[str, Vector]) -> Matrix:
    names = [port.name for port in part.inputs]
    sizes = {len(column) for column in inputs.values()}
    if len(sizes) != 1 or 0 in sizes:
        raise DataError(f"the inputs must have one common length of at least 1; got {sorted(sizes)}.")
    # Inputs without a column are "not measured" where that is allowed.
    held = [np.nan if port.missing else port.start for port in part.inputs]
    rows = np.tile(np.array(held), (sizes.pop(), 1))
    for name, column in inputs.items():
        if name not in names:
            raise DataError(f"`{name}` is not an input of {part.path}; it has {', '.join(names)}.")
        rows[:, names.index(name)] = column
    return rows
