"""The runtimes in the compiled library.

The types of a runtime's arrays determine all other types in it; their ranks are declared by its module. A runtime that
is not listed here, or that cannot be translated to C, cannot be in a compiled FMU; `Sources.refused` has the reason.
"""

from __future__ import annotations

import re

from softneck.runtime import ANY_SIZE, layout_of
from softneck.runtime._layout import Arrays

_NECK_RUNTIMES = (
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
    "softneck.fmu.describe._tunable_gains_runtime",
    "softneck.fmu.describe._tunable_plant_runtime",
    "softneck.fmu.describe._tunable_state_space_runtime",
    "softneck.loop._reference_runtime",
)
# Runtimes for robots of any size, in addition to those above, whose sizes are the neck's and known at compile time.
_ROBOT_RUNTIMES = (
    "softneck.identification.linear._rls_runtime",
    "softneck.identification.linear._oe_runtime",
    "softneck.identification.set_membership._nlsm_runtime",
    "softneck.identification.structured._greybox_runtime",
    "softneck.identification.structured._loaded_greybox_runtime",
    "softneck.identification.uncertainty._guarded_runtime",
    "softneck.identification.networks._nn_runtime",
    "softneck.identification.linear._state_space_runtime",
    "softneck.identification.structured._play_runtime",
    "softneck.estimation._kalman_runtime",
    "softneck.design.linear._linear_controller_runtime",
    "softneck.design.varying._adaptive_runtime",
    "softneck.design.predictive._mpc_runtime",
    "softneck.fmu.describe._tunable_gains_runtime",
    "softneck.fmu.describe._tunable_plant_runtime",
    "softneck.fmu.describe._tunable_state_space_runtime",
    "softneck.loop._reference_runtime",
)
RUNTIMES = (*_NECK_RUNTIMES, *(f"{module}@{ANY_SIZE}" for module in _ROBOT_RUNTIMES))
# Its tuples have the robot's sizes, so there is no text for all sizes: each size is compiled on demand (see
# `_library`).
_EACH_SIZE = "softneck.plant._neck_runtime"
_SIZE = re.compile(r"[1-8]x[1-4]")


_SIZED = frozenset(module for module in RUNTIMES if module.endswith(f"@{ANY_SIZE}"))
_DRIVES = frozenset({"softneck.fmu.describe._modelled_drives_runtime"})
_CONTROL = _DRIVES | {m for m in RUNTIMES if ".design." in m or "gains" in m or "kalman" in m or ".loop." in m}
# Observers are in both parts for models, the modelled drives in both parts for controllers.
_OBSERVERS = frozenset(module for module in RUNTIMES if ".estimation." in module) - _CONTROL
# Parts of the library: an FMU contains the part with all its kinds, half as large as the whole.
LIBRARIES = {
    "models": frozenset(RUNTIMES) - _CONTROL - _SIZED,
    "control": _CONTROL - _SIZED,
    "robot_models": _SIZED - _CONTROL | _OBSERVERS,
    "robot_control": _CONTROL & _SIZED | _DRIVES,
}

# Functions with at least this many nested loops (0: all functions) are compiled for speed, all others for size. A
# search among thousands of points and a quadratic program spend their time in every loop.
FAST = {
    "softneck.identification.linear._rls_runtime": 0,
    "softneck.fmu.describe._tunable_plant_runtime": 0,
    "softneck.identification.set_membership._nlsm_runtime": 1,
    "softneck.identification.networks._nn_runtime": 0,
    "softneck.plant._neck_runtime": 0,
    "softneck.estimation._kalman_runtime": 2,
    "softneck.design.predictive._mpc_runtime": 1,
}


def module_of(runtime: str) -> str:
    """Return the library's module for a runtime: its own, or the one for all sizes."""
    plain, _, size = runtime.partition("@")
    sized = not size or _SIZE.fullmatch(size) is not None  # the name may come from a file
    return f"{plain}@{ANY_SIZE}" if sized and runtime not in RUNTIMES and plain != _EACH_SIZE else runtime


def is_known(module: str) -> bool:
    """Return whether a module is in the library, or can be compiled on demand for a robot's sizes."""
    plain, _, size = module.partition("@")
    return module in RUNTIMES or (plain == _EACH_SIZE and _SIZE.fullmatch(size) is not None)


def ranks_of(module: str) -> tuple[int, ...]:
    """Return the rank of each array of a runtime, before those of its members."""
    return layout_of(module, Arrays).ranks()
