"""Controllers, plants and observers of one's own in Python: objects that step."""

from __future__ import annotations

import ast
import hashlib
import inspect
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import ReprMixin, SettingsError, require_positive, to_si
from softneck.robot import Robot, find_robot
from softneck.runtime import PREFIX, Block, OwnStep, Port, own_runtime

from ._ports import controller_inputs, controller_outputs

_ROLES = ("controller", "plant", "observer")


def _ports(stepped: Any, robot: Robot) -> tuple[str, tuple[Port, ...], tuple[Port, ...]]:
    """Return role, inputs and outputs of an object: a robot's controller, or what it declares itself."""
    name, role = type(stepped).__name__, getattr(stepped, "role", _ROLES[0])
    if role not in _ROLES:
        raise SettingsError(f"{name}: `role` is {role!r}; use one of {', '.join(_ROLES)}.")
    if role == _ROLES[0]:
        return role, controller_inputs(robot), controller_outputs(robot)
    tables = []
    for what in ("inputs", "outputs"):
        units: Any = getattr(stepped, what, None)
        known = isinstance(units, Mapping) and all(isinstance(one, str) for one in (*units, *units.values()))
        if not known or any(to_si(unit)[1] != unit for unit in units.values()):
            raise SettingsError(
                f'{name}: a {role} needs `{what}`, a dictionary of names and SI units like {{"flexion": "rad"}}; '
                f"got {units!r}."
            )
        tables.append(tuple(Port(name=port, unit=unit) for port, unit in units.items()))
    return role, *tables


class OwnObject(ReprMixin):
    """An object with `step(state, inputs) -> (state, outputs)` as a block; see docs/howto/own_controller.md.

    Attributes:
        robot, order: as the object's attributes say, else a neck's and "sequential".
        ss: the object's own method, where it has one.
    """

    ss: Callable[[], Any]

    def __init__(self, stepped: Any) -> None:
        """Look at ports and state, and step once with the start values."""
        self.robot = find_robot(getattr(stepped, "robot", None))
        self.order = getattr(stepped, "order", "sequential")
        if hasattr(stepped, "ss"):
            self.ss = stepped.ss
        step = float(getattr(stepped, "sample_time", 0.02))
        require_positive("sample_time", step, "s")
        role, inputs, outputs = _ports(stepped, self.robot)
        own = OwnStep(stepped, [port.name for port in inputs])
        name = type(stepped).__name__
        try:
            first = own.first(len(outputs))
            state, made = own.step(own.start(), np.array([port.start for port in inputs]))
        except Exception as error:  # whatever the user's own code raises
            raise SettingsError(f"{name}: its first step fails with {type(error).__name__}: {error}.") from error
        if state.shape != own.start().shape or made.shape != (len(outputs),):
            what = "set-points" if role == _ROLES[0] else "outputs"
            raise SettingsError(
                f"{name}: `step` must return ({own.start().size} state, {len(outputs)} {what}); it returned "
                f"shapes {state.shape} and {made.shape}."
            )
        if first.shape != made.shape:
            raise SettingsError(
                f"{name}: `initial_outputs` must return {len(outputs)} numbers; got shape {first.shape}."
            )
        self._block = Block(
            kind=name, role=role, runtime=own_runtime(own), sample_time=step, arrays=(), inputs=inputs,
            outputs=outputs,
        )  # fmt: skip

    def block(self) -> Block:
        """Return the block that is stepped."""
        return self._block

    def summary(self) -> str:
        """Return one line on the controller."""
        return f"{self._block.kind}: a {self._block.role} of one's own, {1e3 * self._block.sample_time:g} ms"


def own_object(thing: Any) -> Any:
    """Return an object that steps as one with a block, everything else as it is."""
    if isinstance(thing, str | Path | Mapping | type | Block) or hasattr(thing, "block") or hasattr(thing, "advance"):
        return thing
    return OwnObject(thing) if callable(getattr(thing, "step", None)) else thing


def own_module(runtime: str) -> tuple[str, str]:
    """Return name and text of a module that holds the object of a runtime where softneck is not.

    Raises SettingsError: its class has no file of its own, or the object holds more than numbers, texts and arrays.
    """
    own = sys.modules[runtime].own
    kind = type(own.stepped)
    try:
        source = Path(inspect.getfile(kind)).read_text(encoding="utf-8")
    except (OSError, TypeError) as error:
        raise SettingsError(f"{kind.__name__}: an FMU carries its class's file; write it in a file (.py).") from error
    for node in ast.parse(source).body:  # what methods import is imported when they are called
        imported = [node.module or "."] if isinstance(node, ast.ImportFrom) else []
        imported += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        for name in (name.partition(".")[0] for name in imported):
            if name not in sys.stdlib_module_names and name != "numpy":
                raise SettingsError(
                    f"{kind.__name__}: its file imports `{name}`, which an FMU has not; give the class a file of its "
                    "own that imports numpy and the standard library only."
                )
    lines = ["import numpy as np", "from collections.abc import Sequence", "from typing import Any"]
    lines += [inspect.getsource(OwnStep), f"own = object.__new__({kind.__qualname__})"]
    lines += [
        f"object.__setattr__(own, {name!r}, {_literal(kind.__name__, name, value)})"
        for name, value in own_attributes(own.stepped)
    ]
    text = "\n".join([source, *lines, f"own = OwnStep(own, {own.names!r})", ""])
    return f"{PREFIX}{hashlib.sha256(text.encode()).hexdigest()[:16]}", text


def own_attributes(thing: Any) -> list[tuple[str, Any]]:
    """Return name and value of each attribute of an object."""
    slots = [name for kind in type(thing).__mro__ for name in getattr(kind, "__slots__", ()) if hasattr(thing, name)]
    return [*getattr(thing, "__dict__", {}).items(), *((name, getattr(thing, name)) for name in slots)]


def _literal(kind: str, name: str, value: Any) -> str:
    """Return the Python text of an attribute's value."""
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "fiub":
        return f"np.array({_literal(kind, name, value.tolist())}, dtype={value.dtype.name!r})[()]"
    if isinstance(value, float):
        return f"float({float(value)!r})" if np.isfinite(value) else f'float("{value}")'
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    if isinstance(value, list | tuple):
        items = "".join(f"{_literal(kind, name, item)}, " for item in value)
        return f"[{items}]" if isinstance(value, list) else f"({items})"
    if isinstance(value, dict):
        return f"dict({_literal(kind, name, [*map(list, value.items())])})"
    if isinstance(value, Robot):  # what softneck alone looks at
        return "None"
    raise SettingsError(
        f"{kind}: an FMU carries numbers, texts, lists and arrays; `{name}` is a {type(value).__name__}."
    )
