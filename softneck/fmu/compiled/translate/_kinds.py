"""The runtimes that the library holds.

The types of a runtime's arrays decide all other types in it; their ranks are those that its module declares. A runtime
that is not here, or that the translator does not know how to write in C, cannot be in a compiled FMU; `refused` says
why.
"""

from __future__ import annotations

import re

from softneck.runtime._bundle import ANY_SIZE, layout_of
from softneck.runtime._layout import Arrays

_NECKS = (
    "softneck.identification.linear._rls_runtime",
    "softneck.identification.linear._oe_runtime",
    "softneck.identification.linear._state_space_runtime",
    "softneck.identification.set_membership._nlsm_runtime",
    "softneck.identification.networks._nn_runtime",
    "softneck.identification.structured._play_runtime",
    "softneck.identification.structured._greybox_runtime",
    "softneck.identification.structured._loaded_greybox_runtime",
    "softneck.identification.uncertainty._guarded_runtime",
    "softneck.plant._neck_runtime",
    "softneck.estimation._kalman_runtime",
    "softneck.estimation._nonlinear_runtime",
    "softneck.estimation._payload_runtime",
    "softneck.design.linear._linear_controller_runtime",
    "softneck.design.varying._adaptive_runtime",
    "softneck.design.predictive._mpc_runtime",
    "softneck.fmu.describe._modelled_drives_runtime",
    "softneck.loop._reference_runtime",
)
# Those that robots of other sizes have; once more for all of these, so that the neck's know their sizes beforehand.
_ROBOTS = (
    "softneck.identification.set_membership._nlsm_runtime",
    "softneck.identification.structured._greybox_runtime",
    "softneck.identification.structured._loaded_greybox_runtime",
    "softneck.identification.uncertainty._guarded_runtime",
    "softneck.identification.networks._nn_runtime",
    "softneck.identification.linear._affine_runtime",
    "softneck.identification.linear._state_space_runtime",
    "softneck.identification.structured._play_runtime",
    "softneck.estimation._kalman_runtime",
    "softneck.design.linear._linear_controller_runtime",
    "softneck.design.varying._adaptive_runtime",
    "softneck.design.predictive._mpc_runtime",
    "softneck.loop._reference_runtime",
)
RUNTIMES = (*_NECKS, *(f"{module}@{ANY_SIZE}" for module in _ROBOTS))
# Its tuples have the robot's sizes: one text for all there is none, and whoever wants one compiles it (see `_library`).
_EACH_SIZE = "softneck.plant._neck_runtime"
_SIZE = re.compile(r"[1-8]x[1-4]")


_SIZED = frozenset(module for module in RUNTIMES if module.endswith(f"@{ANY_SIZE}"))
_DRIVES = frozenset({"softneck.fmu.describe._modelled_drives_runtime"})
_CONTROL = _DRIVES | {m for m in RUNTIMES if ".design." in m or "kalman" in m or ".loop." in m}
# An observer has a model of either size, modelled drives a controller.
_OBSERVERS = frozenset(module for module in RUNTIMES if ".estimation." in module) - _CONTROL
# Parts of the library: an FMU carries one that holds all its kinds, which weighs half as much as the whole.
LIBRARIES = {
    "models": frozenset(RUNTIMES) - _CONTROL - _SIZED,
    "control": _CONTROL - _SIZED,
    "robot_models": _SIZED - _CONTROL | _OBSERVERS,
    "robot_control": _CONTROL & _SIZED | _DRIVES,
}

# Which of a step's functions are compiled for speed, all others for size: those with so many loops within each other, 0
# for all. A search among thousands of points and a quadratic program spend their time in every loop.
FAST = {
    "softneck.identification.linear._rls_runtime": 0,
    "softneck.identification.set_membership._nlsm_runtime": 1,
    "softneck.identification.networks._nn_runtime": 0,
    "softneck.plant._neck_runtime": 0,
    "softneck.estimation._kalman_runtime": 2,
    "softneck.design.predictive._mpc_runtime": 1,
}


def module_of(runtime: str) -> str:
    """Return the module in the library that runs a runtime: its own, or that of all sizes."""
    plain, _, size = runtime.partition("@")
    sized = not size or _SIZE.fullmatch(size) is not None  # the name may come from a file
    return f"{plain}@{ANY_SIZE}" if sized and runtime not in RUNTIMES and plain != _EACH_SIZE else runtime


def is_known(module: str) -> bool:
    """Return whether a module is in the library, or can be compiled beside it for a robot of its sizes."""
    plain, _, size = module.partition("@")
    return module in RUNTIMES or (plain == _EACH_SIZE and _SIZE.fullmatch(size) is not None)


def ranks_of(module: str) -> tuple[int, ...]:
    """Return the rank of each array of a runtime, before those of its members."""
    return layout_of(module, Arrays).ranks()
