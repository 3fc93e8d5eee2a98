"""The C calls of an FMU, for FMI 2.0 and FMI 3.0; fmpy only loads and instantiates."""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import Vector
from softneck.loop import EndedError

from ._variables import FMI_TYPES, Description

if TYPE_CHECKING:
    from fmpy.model_description import ScalarVariable

OK_OR_WARNING, DISCARD, ERROR, FATAL = 1, 2, 3, 4
_TERMINATED = 3  # fmi2StatusKind
_STATUS_TEXTS = ("OK", "a warning", "discard", "an error", "a fatal error", "pending")
Log = Callable[[int, str], None]
_MOST_ITERATIONS = 100  # of one event
_SAME_TIME = 1e-6  # share of a step: times of events are sums of decimals
# fmpy changes the working directory while it loads a library, so only one thread may load at a time.
_LOADING = threading.Lock()


class CallError(RuntimeError):
    """A C call returned a bad status; `_fmu_part` raises an `FmuError` with the FMU's own reason."""

    def __init__(self, name: str, status: int) -> None:
        text = _STATUS_TEXTS[status] if 0 <= status < len(_STATUS_TEXTS) else f"status {status}"
        super().__init__(f"{name} returned {text}")
        self.status = status


class Native:
    """An instance of an FMU. `fmu`: fmpy's object. `version`: 2 or 3."""

    def __init__(self, description: Description, folder: Path, log: Log) -> None:
        """Load the library in `folder`; errors are those of fmpy."""
        from fmpy.fmi2 import FMU2Model, FMU2Slave
        from fmpy.fmi3 import FMU3Model, FMU3Slave

        self.version = description.version
        self.exchange = description.model.coSimulation is None
        self._notify = self.exchange and bool(description.interface.needsCompletedIntegratorStep)
        self._next_event = math.inf
        common = {
            "guid": description.model.guid,
            "unzipDirectory": str(folder),
            "modelIdentifier": description.identifier,
            "instanceName": description.path.stem,
        }
        classes = {2: (FMU2Slave, FMU2Model), 3: (FMU3Slave, FMU3Model)}
        with _LOADING:
            self.fmu: Any = classes[self.version][self.exchange](**common)
        self._log = log
        self._step: Callable[..., int] | None = None
        self._step_rest: tuple[Any, ...] = ()
        self._ends: ctypes.c_bool | None = None

    def instantiate(self) -> None:
        """Create the instance and prepare the call of a step."""
        from fmpy import calloc, free
        from fmpy.fmi2 import (
            fmi2CallbackAllocateMemoryTYPE,
            fmi2CallbackFreeMemoryTYPE,
            fmi2CallbackFunctions,
            fmi2CallbackLoggerTYPE,
        )

        if self.version == 2:
            # Not fmpy's logger proxy: there is one for the process, and the log would reach another part.
            callbacks = fmi2CallbackFunctions()
            callbacks.logger = fmi2CallbackLoggerTYPE(lambda _e, _i, status, _c, text: self._write_log(status, text))
            callbacks.allocateMemory = fmi2CallbackAllocateMemoryTYPE(calloc)
            callbacks.freeMemory = fmi2CallbackFreeMemoryTYPE(free)
            self.fmu.instantiate(False, callbacks, True)
        else:
            self.fmu.instantiate(loggingOn=True, logMessage=lambda _e, status, _c, text: self._write_log(status, text))
        self._step, self._step_rest = self._step_call()

    def _write_log(self, status: int, message: bytes) -> None:
        self._log(status, " ".join((message or b"").decode("utf-8", "replace").replace("%%", "%").split()))

    def _step_call(self) -> tuple[Callable[..., int], tuple[Any, ...]]:
        if self.exchange:
            return self._step_over_events, ()
        if self.version == 2:
            types = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int]
            return self.function("fmi2DoStep", types), (1,)
        flags = [ctypes.c_bool() for _ in range(3)]
        self._step_outputs = (*flags, ctypes.c_double())
        self._ends = flags[1]  # terminateSimulation
        types = [ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool] + [ctypes.c_void_p] * 4
        return self.function("fmi3DoStep", types), (True, *(ctypes.addressof(item) for item in self._step_outputs))

    def function(self, name: str, types: list[Any]) -> Callable[..., int]:
        """Return the C function `name` of the library with those argument types."""
        found = self.fmu.dll[name]
        found.argtypes, found.restype = types, ctypes.c_int
        return found

    def setup(self, time: float) -> None:
        """Set the start time of FMI 2.0; FMI 3.0 gets it on entering initialisation."""
        if self.version == 2:
            self.fmu.setupExperiment(None, time, None)

    def initialise(self, time: float) -> None:
        """Enter initialisation at `time` [s] and leave it."""
        if self.version == 2:
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=time)
        self.fmu.exitInitializationMode()

    def step(self, time: float, size: float) -> None:
        """Step from `time` by `size` [s]; raise CallError on a bad status."""
        status = self._step(self.fmu.component, time, size, *self._step_rest)  # pyright: ignore[reportOptionalCall]
        if status > OK_OR_WARNING:
            if status == DISCARD and self.version == 2 and self._has_terminated():
                raise EndedError("it asked to end the simulation")
            raise CallError(f"fmi{self.version}DoStep", status)
        if self._ends is not None and self._ends.value:
            raise EndedError("it asked to end the simulation")

    def _has_terminated(self) -> bool:
        """Return whether an FMU of FMI 2.0 discarded a step because it ends the simulation."""
        ended = ctypes.c_int()
        ask = self.function("fmi2GetBooleanStatus", [ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p])
        return ask(self.fmu.component, _TERMINATED, ctypes.byref(ended)) <= OK_OR_WARNING and ended.value != 0

    def _step_over_events(self, _component: Any, time: float, size: float) -> int:
        """Finish the event at `time` and handle those before its end; Model Exchange without continuous states."""
        end = time + size * (1.0 - _SAME_TIME)
        self._update()
        while self._next_event < end:
            self.reach(self._next_event)
            self._update()
        return 0

    def reach(self, time: float) -> None:
        """Enter the event at `time` [s], where the next inputs are set."""
        self._ask(self.fmu.setTime, time)
        if self._notify:
            self._ask(self.fmu.completedIntegratorStep)
        self._ask(self.fmu.enterEventMode)

    def _update(self) -> None:
        """Update discrete states until the FMU needs no more, and leave event mode."""
        update = self.fmu.newDiscreteStates if self.version == 2 else self.fmu.updateDiscreteStates
        for _ in range(_MOST_ITERATIONS):
            again, ended, _, _, defined, time = self._ask(update)
            if ended:
                raise EndedError("it asked to end the simulation")
            if not again:
                self._next_event = time if defined else math.inf
                self._ask(self.fmu.enterContinuousTimeMode)
                return
        raise CallError(f"its discrete states do not settle in {_MOST_ITERATIONS} iterations; the event", ERROR)

    def _ask(self, call: Callable[..., Any], *arguments: Any) -> Any:
        from fmpy.fmi1 import FMICallException

        try:
            return call(*arguments)
        except FMICallException as error:
            raise CallError(error.function, error.status) from error

    def release(self, *, broken: bool, is_softneck: bool) -> None:
        """Terminate and free the instance as far as FMI allows."""
        if self.fmu.component is None:
            return
        if not broken:
            try:
                self.fmu.terminate()
            except Exception as error:  # a failing end does not make the run invalid
                broken = getattr(error, "status", 0) >= FATAL
        # After "fatal" FMI allows no further call; softneck's own FMU stays valid and is freed.
        if not broken or is_softneck:
            self.fmu.freeInstance()

    def get_state(self) -> bytes:
        """Return the serialised state."""
        state = self._state_function("get")()
        try:
            return bytes(self._state_function("serialize")(state))
        finally:
            self._state_function("free")(state)

    def set_state(self, data: bytes) -> None:
        """Restore a serialised state."""
        state = self._state_function("deSerialize")(data)
        try:
            self._state_function("set")(state)
        finally:
            self._state_function("free")(state)

    def _state_function(self, verb: str) -> Callable[..., Any]:
        # fmpy spells it `...FMUstate` for FMI 2.0 and `...FMUState` for FMI 3.0.
        wanted = f"{verb}FMUState".lower()
        return getattr(self.fmu, next(name for name in dir(self.fmu) if name.lower() == wanted))


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Variables of one FMI type: their positions in the vector, and the buffers of the C calls."""

    places: Any
    references: Any
    buffer: Any
    view: np.ndarray
    suffix: str
    count: int
    boolean: bool


class Bank:
    """Some variables of an FMU, read into and written from a vector with one C call for each type."""

    def __init__(self, variables: list[ScalarVariable], version: int) -> None:
        """Prepare the buffers for `variables`, in the vector's order."""
        self.size, self.version = len(variables), version
        self._groups: list[_Group] = []
        types = FMI_TYPES[version]
        suffixes = [types[v.type][2] for v in variables]
        for suffix in dict.fromkeys(suffixes):
            places = [i for i, other in enumerate(suffixes) if other == suffix]
            c_type, dtype, _ = next(entry for entry in types.values() if entry[2] == suffix)
            references = (ctypes.c_uint * len(places))(*(variables[i].valueReference for i in places))
            buffer = (c_type * len(places))()
            even = places == list(range(places[0], places[0] + len(places)))
            self._groups.append(
                _Group(
                    slice(places[0], places[-1] + 1) if even else np.array(places), references, buffer,
                    np.frombuffer(buffer, dtype=dtype), suffix, len(places), suffix == "Boolean",
                )
            )  # fmt: skip
        self._sets: list[tuple[_Group, Callable[..., int], tuple[Any, ...]]] = []
        self._gets: list[tuple[_Group, Callable[..., int], tuple[Any, ...]]] = []

    def bind(self, native: Native) -> None:
        """Take the functions of a new instance."""
        self._sets, self._gets = [], []
        for group in self._groups:
            sizes = [ctypes.c_size_t, ctypes.c_void_p] + [ctypes.c_size_t] * (self.version == 3)
            types = [ctypes.c_void_p, ctypes.c_void_p, *sizes]
            end = (group.count,) if self.version == 3 else ()
            rest = (ctypes.addressof(group.references), group.count, ctypes.addressof(group.buffer), *end)
            head = f"fmi{self.version}"
            arguments = (native.fmu.component, *rest)
            self._sets.append((group, native.function(f"{head}Set{group.suffix}", types), arguments))
            self._gets.append((group, native.function(f"{head}Get{group.suffix}", types), arguments))

    def write(self, values: Vector) -> None:
        """Set all variables from `values` (size,); raise CallError on a bad status."""
        for group, call, arguments in self._sets:
            chosen = values[group.places]
            group.view[:] = chosen != 0.0 if group.boolean else chosen
            status = call(*arguments)
            if status > OK_OR_WARNING:
                raise CallError(f"fmi{self.version}Set{group.suffix}", status)

    def read(self) -> Vector:
        """Return all variables (size,); raise CallError on a bad status."""
        values = np.empty(self.size)
        for group, call, arguments in self._gets:
            status = call(*arguments)
            if status > OK_OR_WARNING:
                raise CallError(f"fmi{self.version}Get{group.suffix}", status)
            values[group.places] = group.view
        return values
