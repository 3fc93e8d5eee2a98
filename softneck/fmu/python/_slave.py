"""The FMI 2.0 slave of all kinds: every FMU contains this text after the runtime of its kind (`_module.py`).

Ports, sample time and arrays come from `resources/block.json` and `resources/arrays.npy`, the three functions of the
runtime from the same module. It must run without softneck: standard library, numpy and pythonfmu's base class only.

Timing: sample n is at t_0 + n T_s. It is taken in the communication step that begins at or before it, with the inputs
held then. A plant's new outputs are visible when communication reaches sample n + 1, those of other blocks at once.
"""

import contextvars
import ctypes
import json
import math
import operator
import sys
import traceback
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
from pythonfmu.fmi2slave import Fmi2Slave

from ._slave_compiled import _FMU_SWITCH, _fmu_compiled_step, _fmu_print
from ._slave_exit import _fmu_release_at_exit

# Of the runtime, whose text stands before this one in an FMU; pyright checks them.
# ruff: noqa: F821
state_size: Callable[..., int]
initialise: Callable[..., None]
step: Callable[..., None]

# Tolerance as a share of the sample time: hosts sum up their time, and 1e6 steps of 2 ms are off by 1e-7 s at most.
_FMU_SAME_TIME = 1e-4
_FMU_MOST_SAMPLES = 1e9
_FMU_WARNING = 1
_FMU_ERROR = 3
_FMU_CATEGORY = {_FMU_WARNING: "logStatusWarning", _FMU_ERROR: "logStatusError"}
_FMU_VECTORS = ("variables", "pending", "memory")


class _FmuMessage:
    """One entry of the log queue, as pythonfmu's binary reads it."""

    def __init__(self, status: int, text: str) -> None:
        self.status = status
        self.category = _FMU_CATEGORY[status]
        self.msg = text.replace("%", "%%")  # FMI loggers take the message for a printf format
        self.debug = False


def _fmu_guarded(method: Callable[..., Any]) -> Callable[..., Any]:
    """Report the reason of a failed call on stderr and in the FMI log; the binary then returns an error status."""

    @wraps(method)
    def call(self: "SoftneckSlave", *arguments: Any) -> Any:
        try:
            return method(self, *arguments)
        except BaseException as error:
            self._fail(error)
            raise

    return call


def _fmu_keep_alive(*things: object) -> None:
    # On an exception pythonfmu 0.7 releases instance, class and log queue, and releases them again at the next reset or
    # free: without these references the second call after an error would use freed memory.
    for thing in things:
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))


def _fmu_arrays(path: Path, shapes: list[list[int]]) -> tuple[np.ndarray, ...]:
    """Return the arrays that are concatenated in one file."""
    flat = np.load(path, allow_pickle=False).astype(np.float64, copy=False)
    arrays, first = [], 0
    for shape in shapes:
        last = first + math.prod(shape)
        arrays.append(flat[first:last].reshape(shape))
        first = last
    return tuple(arrays)


def _fmu_quiet() -> Callable[..., Any]:
    """Return a function that calls others with numpy's warnings off, leaving the host's setting alone."""
    if int(np.__version__.split(".")[0]) >= 2:
        # numpy 2 keeps its error state in the context: entering one costs a tenth of `errstate`.
        context = contextvars.copy_context()
        context.run(np.seterr, all="ignore")
        return context.run

    def call(function: Callable[..., None], *arguments: Any) -> None:
        with np.errstate(all="ignore"):
            function(*arguments)

    return call


class SoftneckSlave(Fmi2Slave):
    """A softneck block as an FMI slave; value references count inputs, outputs, parameters."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.folder = kwargs["resources"]
        _fmu_release_at_exit(self.folder)
        self.facts = json.loads(Path(self.folder, "block.json").read_text(encoding="utf-8"))
        self.arrays = _fmu_arrays(Path(self.folder, "arrays.npy"), self.facts["shapes"])
        self.modelName = self.facts["name"]
        self.queue: list[_FmuMessage] = []
        self.warned: set[str] = set()
        self.ports = self.facts["inputs"] + self.facts["outputs"] + self.facts["parameters"]
        n_in, n_out = len(self.facts["inputs"]), len(self.facts["outputs"])
        self.n_in, self.n_known = n_in, n_in + n_out
        self.plant = self.facts["role"] in ("plant", "reference")
        self.sample_time = self.facts["sample_time"]
        self.start, self.count, self.running, self.stale = 0.0, 0, False, True
        self.stop = math.inf
        self.variables = np.array([port["start"] for port in self.ports], dtype=np.float64)
        # An input that is neither connected nor set was not measured.
        self.variables[:n_in][[port["missing"] for port in self.facts["inputs"]]] = np.nan
        self.pending = np.zeros(n_out)
        self.memory = np.zeros(state_size(self.arrays))
        self.advance: Callable[..., None] | None = None
        self.compiled = False
        self.quietly = _fmu_quiet()
        outputs = [port["name"] for port in self.facts["outputs"]]
        self.validity = outputs.index("validity") if "validity" in outputs else None
        # Finite, so that an infinite output is outside too.
        self.lows = [max(port["low"], -sys.float_info.max) for port in self.facts["outputs"]]
        self.highs = [min(port["high"], sys.float_info.max) for port in self.facts["outputs"]]
        self._view()

    def _view(self) -> None:
        self.inputs = self.variables[: self.n_in]
        self.outputs = self.variables[self.n_in : self.n_known]
        # The last parameter may be the slave's own.
        self.limited = bool(self.facts["parameters"]) and self.facts["parameters"][-1]["name"] == "limit_outputs"
        self.parameters = self.variables[self.n_known : len(self.variables) - self.limited]

    def _get_log_queue(self) -> list[_FmuMessage]:
        return self.queue

    def tell(self, status: int, text: str) -> None:
        """Write `text` to the FMI log and to stderr, as hosts only show the log on request."""
        self.queue.append(_FmuMessage(status, text))
        _fmu_print(text)

    def _fail(self, error: BaseException) -> None:
        self.tell(_FMU_ERROR, f"{self.facts['name']}: {error}")
        if not isinstance(error, ValueError):
            _fmu_print(traceback.format_exc())
        _fmu_keep_alive(self, type(self), self.queue)

    # Life cycle

    @_fmu_guarded
    def setup_experiment(self, start_time: float, stop_time: float | None = None, *_: Any) -> None:
        """Take the start time, and the stop time where the host defines one."""
        if not math.isfinite(start_time):
            raise ValueError(f"the start time is {start_time}; it must be finite.")
        self.start, self.count = float(start_time), 0
        self.stop = math.inf if stop_time is None else float(stop_time)
        if self.folder in sys.path:  # the binary put it there to find this module, once for each instance
            sys.path.remove(self.folder)

    @_fmu_guarded
    def enter_initialization_mode(self) -> None:
        """Enter the mode in which outputs follow the parameters; no action needed."""

    @_fmu_guarded
    def exit_initialization_mode(self) -> None:
        """Fix the parameters."""
        self._initialise()
        self.running = True

    def _initialise(self) -> None:
        if self.stale:
            self.memory[:] = 0.0
            self.quietly(initialise, self.arrays, self.parameters, self.memory, self.pending)
            if self.plant:  # a controller decides in its first step; set-points rest at zero before, allowed or not
                self._check_outputs()
            self.outputs[:] = self.pending
            if self.advance is None:
                self._choose(always=False)
            self.stale = False

    def _choose(self, *, always: bool) -> None:
        """Select the step function: compiled by numba if that is faster overall or `always`, else plain Python."""
        # Compile now, by a call on copies.
        copies = (self.arrays, self.parameters, self.memory.copy(), np.zeros(self.n_in), self.pending.copy())
        found = _fmu_compiled_step(self.facts, self.folder, copies, always=always)
        self.compiled, self.advance = found is not None, found or step

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Take all samples in [current_time, current_time + step_size); on False the state is unchanged."""
        try:
            end = current_time + step_size
            refusal = self._refusal(current_time, step_size, end)
            if refusal:
                self.tell(_FMU_ERROR, f"{self.facts['name']}: {refusal}")
                return False
            if self.stale:
                self._initialise()
            slack = _FMU_SAME_TIME * self.sample_time
            while self.start + self.count * self.sample_time < end - slack:
                self._take_sample()
            # A plant's next outputs are visible when the next sample is reached.
            if self.plant and self.start + self.count * self.sample_time <= end + slack:
                self.outputs[:] = self.pending
        except BaseException as error:
            # Not False: pythonfmu's binary returns "discard" then, and hosts end the result there without a message. A
            # step that failed halfway must not count as refused.
            self._fail(error)
            raise
        return True

    def _refusal(self, time: float, size: float, end: float) -> str:
        """Return the reason why a step to `end` is not possible; "" if it is."""
        if not self.running:
            return "a step before the initialisation has ended."
        samples = (end - self.start) / self.sample_time - self.count
        if not (size >= 0.0 and samples <= _FMU_MOST_SAMPLES):
            return f"a step from {time:g} s over {size:g} s cannot be taken."
        if end - self.stop > _FMU_SAME_TIME * self.sample_time + 1e-9 * abs(self.stop):  # hosts round their times
            return f"a step from {time:g} s over {size:g} s goes past the stop time of {self.stop:g} s."
        return ""

    def _take_sample(self) -> None:
        if self.plant:
            self.outputs[:] = self.pending
        if self.compiled:
            self.advance(self.arrays, self.parameters, self.memory, self.inputs, self.pending)  # type: ignore[misc]
        else:
            self.quietly(step, self.arrays, self.parameters, self.memory, self.inputs, self.pending)
        self.count += 1
        self._check_outputs()
        if not self.plant:
            self.outputs[:] = self.pending

    def _check_outputs(self) -> None:
        values = self.pending.tolist()
        if all(map(operator.le, self.lows, values)) and all(map(operator.le, values, self.highs)):
            return
        for i, (port, value) in enumerate(zip(self.facts["outputs"], values, strict=True)):
            if math.isinf(value) or (math.isnan(value) and not port["missing"]):
                time = self.start + self.count * self.sample_time
                raise ValueError(f"output {port['name']} became {value} at t = {time:.6g} s: the model has diverged.")
            slack = 1e-9 * (1.0 + abs(value))  # rounding of a model that ends at its limit
            if value < port["low"] - slack or value > port["high"] + slack:
                self._leave_range(i, port, value)

    def _leave_range(self, i: int, port: dict[str, Any], value: float) -> None:
        """Report an output outside of its range once; the outputs of this sample are not valid."""
        if port["name"] not in self.warned:
            self.warned.add(port["name"])
            span = f"{port['low']:g} to {port['high']:g} {port['unit']}"
            text = f"output {port['name']} = {value:g} is outside {span}: the model is not valid there."
            self.tell(_FMU_WARNING, f"{self.facts['name']}: {text}")
        if self.limited and self.variables[-1]:
            self.pending[i] = min(max(value, port["low"]), port["high"])
        if self.validity is not None:
            self.pending[self.validity] = 0.0

    # Variables

    @_fmu_guarded
    def set_real(self, references: list[int], values: list[float]) -> None:
        """Set inputs and parameters."""
        for reference, value in zip(references, values, strict=True):
            self._set(reference, float(value))

    @_fmu_guarded
    def set_boolean(self, references: list[int], values: list[bool]) -> None:
        """Set Boolean inputs and parameters; inside they are 0.0 and 1.0."""
        for reference, value in zip(references, values, strict=True):
            self._set(reference, 1.0 if value else 0.0)

    @_fmu_guarded
    def set_integer(self, references: list[int], values: list[int]) -> None:
        """Set whole-number parameters."""
        for reference, value in zip(references, values, strict=True):
            self._set(reference, float(value))

    @_fmu_guarded
    def get_integer(self, references: list[int]) -> list[int]:
        """Return values of whole-number parameters."""
        return [int(self.variables[reference]) for reference in references]

    @_fmu_guarded
    def get_real(self, references: list[int]) -> list[float]:
        """Return values of any variables."""
        self._initialise()
        values = self.variables.tolist()
        return [self._readable(values[reference], reference) for reference in references]

    def _readable(self, value: float, reference: int) -> float:
        """Return the start value for an input that was never set, as hosts expect a number."""
        return self.ports[reference]["start"] if value != value and reference < self.n_in else value

    @_fmu_guarded
    def get_boolean(self, references: list[int]) -> list[bool]:
        """Return values of Boolean variables."""
        self._initialise()
        return [bool(self.variables[reference] != 0.0) for reference in references]

    def _set(self, reference: int, value: float) -> None:
        port = self.ports[reference]
        if value - value != 0.0 and not (port["missing"] and value != value):
            raise ValueError(f"{port['name']} was set to {value}; it must be finite.")
        # The limit that a saturating controller computes may differ from the stated one by rounding.
        slack = 1e-9 * (1.0 + abs(value))
        outside = not port["low"] - slack <= value <= port["high"] + slack and value == value
        if reference < self.n_in:
            if outside and port["name"] not in self.warned:
                self._warn_outside(port, value)
        elif reference < self.n_known:
            raise ValueError(f"{port['name']} is an output and cannot be set.")
        elif self.running and not port["tunable"]:
            raise ValueError(f"{port['name']} is fixed; set it before the initialisation ends.")
        elif outside:
            text = f"between {port['low']:g} and {port['high']:g} [{port['unit']}]"
            raise ValueError(f"{port['name']} must be {text}; it was set to {value:g}.")
        elif not self.running:
            self.stale = True
        self.variables[reference] = value

    def _warn_outside(self, port: dict[str, Any], value: float) -> None:
        self.warned.add(port["name"])
        # A set-point slightly outside the training range is probably in rad all the same.
        far = abs(value) > 2.0 * max(-port["low"], port["high"])
        asked = port["name"].endswith("_reference") or ("_setpoint" in port["name"] and far)
        hint = " Is it in degrees?" if asked and port["unit"] == "rad" else ""
        span = f"{port['low']:g} to {port['high']:g} {port['unit']}"
        self.tell(_FMU_WARNING, f"{self.facts['name']}: {port['name']} = {value:g} is outside {span}.{hint}")

    # The whole state, to the bit

    @_fmu_guarded
    def _get_fmu_state(self) -> dict[str, Any]:
        self._initialise()
        vectors = {name: getattr(self, name).astype("<f8").tobytes() for name in _FMU_VECTORS}
        counters = {"start": self.start, "count": self.count, "running": self.running, "compiled": self.compiled}
        return {"guid": self.facts["guid"], **counters, **vectors}

    @_fmu_guarded
    def _set_fmu_state(self, state: dict[str, Any]) -> None:
        sizes = {name: getattr(self, name).nbytes for name in _FMU_VECTORS}
        if state.get("guid") != self.facts["guid"] or sizes != {name: len(state.get(name, b"")) for name in sizes}:
            raise ValueError("the FMU state comes from another FMU or is damaged.")
        for name in _FMU_VECTORS:
            getattr(self, name)[:] = np.frombuffer(state[name], dtype="<f8")
        self.start, self.count, self.running = state["start"], state["count"], state["running"]
        self.stale = False
        # Compiled and plain steps differ in the last digit, but a replay must be equal.
        if self.advance is None or state["compiled"] != self.compiled:
            self._resume(state["compiled"])

    def _resume(self, compiled: bool) -> None:
        if compiled:
            self._choose(always=True)
        else:
            self.compiled, self.advance = False, step
        if compiled and not self.compiled:
            self.tell(
                _FMU_WARNING,
                f"{self.facts['name']}: this state was saved by compiled steps and goes on by plain ones, "
                f"which differ in the last digit (numba is not here, or {_FMU_SWITCH} is 0).",
            )

    @staticmethod
    def _fmu_state_to_bytes(state: dict[str, Any]) -> bytes:
        plain = {name: value.hex() if name in _FMU_VECTORS else value for name, value in state.items()}
        return json.dumps(plain, sort_keys=True).encode()

    @staticmethod
    def _fmu_state_from_bytes(state: bytes) -> dict[str, Any]:
        try:
            plain = json.loads(state.decode())
            return {name: bytes.fromhex(value) if name in _FMU_VECTORS else value for name, value in plain.items()}
        except (ValueError, AttributeError, TypeError):
            return {}  # `_set_fmu_state` refuses it with a message
