"""A controller of any kind by its name, as `softneck design KIND` makes it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

from softneck.core import SettingsError, find_kind, fitting, make_settings, percent, resolve
from softneck.robot import Robot, load_for_robot

if TYPE_CHECKING:
    from .linear._controller import LinearController
    from .predictive._controller import MpcController
    from .predictive._nmpc import NmpcController
    from .varying._adaptive import VaryingController

# [%] Simulation over the rows held out: below it R2 is below 1/2, so more of the motion is unexplained than explained.
_MIN_FIT_PCT = 30.0


@overload
def design_controller(
    kind: Literal["mpc"], plant: Any, *, robot: Robot | str | Path | None = ..., any_fit: bool = ..., **settings: Any
) -> MpcController: ...
@overload
def design_controller(
    kind: Literal["nmpc"], plant: Any, *, robot: Robot | str | Path | None = ..., any_fit: bool = ..., **settings: Any
) -> NmpcController: ...
@overload
def design_controller(
    kind: Literal["adaptive"],
    plant: Any,
    *,
    robot: Robot | str | Path | None = ...,
    any_fit: bool = ...,
    **settings: Any,
) -> VaryingController: ...
@overload
def design_controller(
    kind: Literal["pi", "pid", "fopi", "hinf", "lqg", "custom"],
    plant: Any,
    *,
    robot: Robot | str | Path | None = ...,
    any_fit: bool = ...,
    **settings: Any,
) -> LinearController: ...
@overload
def design_controller(
    kind: str, plant: Any, *, robot: Robot | str | Path | None = ..., any_fit: bool = ..., **settings: Any
) -> Any: ...
def design_controller(
    kind: str, plant: Any, *, robot: Robot | str | Path | None = None, any_fit: bool = False, **settings: Any
) -> Any:
    """Return the controller of `kind` designed on `plant`; `settings` are those of the kind's settings class.

    Args:
        kind: name in the table of kinds: "pi", "pid", "hinf", "mpc", ...
        plant: an identified linear model, a family, the file of one, or a list whose first entry is the nominal plant.
        robot: whose limits count, itself, a preset or its file; None: those that the plant says.
        any_fit: design on models too whose simulation on the rows held out fits less than 30 %.
        **settings: for instance `phase_margin=1.05`; angles in rad.

    Raises:
        SettingsError: an unknown kind or setting, a value out of range, or a plant that does not fit.
        FileFormatError: no such file, or not one of ours.
        CheckFailedError: no controller of this kind meets its settings on that plant.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> model = softneck.identify("rls", recording)
        >>> softneck.design_controller("pi", model).save("pi.npz")
        >>> softneck.load("pi.npz").kind
        'pi'
    """
    made = make_settings(resolve(find_kind(kind, "controller").settings), settings)
    several = list(plant) if isinstance(plant, list | tuple) else [plant]
    plants = [linear_plant(one, any_fit=any_fit, robot=robot) for one in several]
    given = plants[0] if len(plants) == 1 else plants
    return made.design(given) if robot is None else made.design(given, robot=robot)


def linear_plant(thing: Any, *, any_fit: bool, robot: Robot | str | Path | None = None) -> Any:
    """Return the model or family to design on, read from a file if it is a path.

    Raises:
        SettingsError: neither, or a model that does not fit the rows held out (and not `any_fit`).
    """
    plant = load_for_robot(thing, robot=robot)
    path = str(thing) if isinstance(thing, str | Path) else ""
    if not hasattr(plant, "tf") and not hasattr(plant, "axes"):
        plant = load_for_robot(thing, "model")  # which says what it is
    with fitting(path or "the model"):
        held_out = getattr(plant, "findings", {}).get("hold_out", {})
        diverged = held_out.get("diverged") is not None
        fits = {name: fit for name, fit in held_out.get("fit", {}).items() if fit is not None}
        poor = {name: fit for name, fit in fits.items() if fit < _MIN_FIT_PCT}
    if (diverged or poor) and not any_fit:
        worst = min(poor, key=lambda name: poor[name], default="")
        what = "diverges" if diverged else f"fits {percent(poor[worst])} % in {worst}"
        without = f"Leave {', '.join(poor)} out of `outputs.names` in a robot.toml. " if len(poor) < len(fits) else ""
        raise SettingsError(
            f"{path and path + ': '}its simulation over the rows held out {what}; {_MIN_FIT_PCT:g} % is the least to "
            f"design on. {'' if diverged else without}Identify a better model, or go on by --any-fit (`any_fit=True`)."
        )
    return plant
