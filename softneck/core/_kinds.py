"""The table of kinds of models, observers and controllers, with the dotted paths of their classes and runtimes."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from ._archive import read_archive, require_header
from ._errors import FileFormatError, SettingsError, did_you_mean


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of model, family, observer or controller.

    Attributes:
        name: as users type it and as it is in a file's header.
        role: "model", "observer", "controller" or "family".
        settings: dotted path of the settings class with the `fit` or `design` that makes it, or of a function.
        result: dotted path of the class whose `from_archive` reads the file.
        runtime: dotted name of the runtime module (see `softneck.runtime`); "" for kinds that are not simulated.
        summary: one line for `--help` and the docs.
        check: dotted path of the function that checks the values of a model's arrays; the runtime declares their names
            and shapes.
    """

    name: str
    role: str
    settings: str
    result: str
    runtime: str
    summary: str
    check: str = ""


_IDENT, _DESIGN = "softneck.identification", "softneck.design"
_MODEL = f"{_IDENT}:Model"
#: The table of kinds by name.
KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("rls", "model", "softneck.identification:Rls", _MODEL, f"{_IDENT}.linear._rls_runtime",
             "recursive least squares over the redefined inputs, with dead time (Eq. 23-30)",
             f"{_IDENT}.linear._regression:check_linear"),
        Kind("oe", "model", "softneck.identification:OutputError", _MODEL, f"{_IDENT}.linear._oe_runtime",
             "output error: transfer functions with dead time that simulate best (Gauss-Newton)",
             f"{_IDENT}.linear._regression:check_linear"),
        Kind("nlsm", "model", "softneck.identification:SetMembership", _MODEL, f"{_IDENT}.set_membership._nlsm_runtime",
             "nonlinear set membership (Eq. 12-21, Algorithm 1)",
             f"{_IDENT}.set_membership._regressor:check_nlsm"),
        Kind("nn", "model", "softneck.identification:Network", _MODEL, f"{_IDENT}.networks._nn_runtime",
             "NLARX neural network, two hidden layers of 25 (section 6.2)",
             f"{_IDENT}.networks._network:check_nn"),
        Kind("play", "model", "softneck.identification:Play", _MODEL, f"{_IDENT}.structured._play_runtime",
             "play operators and low-pass filters with a ridge polynomial; no feedback, accurate in simulation",
             f"{_IDENT}.structured._play:check_play"),
        Kind("greybox", "model", "softneck.identification:GreyBox", _MODEL, f"{_IDENT}.structured._greybox_runtime",
             "equations of a tendon-driven neck, with parameters fitted by the simulation error",
             f"{_IDENT}.structured._greybox:check_greybox"),
        Kind("guarded", "model", f"{_IDENT}.uncertainty._guarded:Guarded", _MODEL,
             f"{_IDENT}.uncertainty._guarded_runtime",
             "several models of one learned kind, faded to a base model where they disagree or extrapolate",
             f"{_IDENT}.uncertainty._guarded:check_guarded"),
        Kind("family", "family", "softneck.identification:FamilySettings", "softneck.identification:Family", "",
             "uncertain linear plant: nominal, box, samples and a weight over them"),
        Kind("kalman", "observer", "softneck.estimation:KalmanSettings", "softneck.estimation:KalmanObserver",
             "softneck.estimation._kalman_runtime",
             "Kalman filter over an identified linear model with a disturbance state"),
        Kind("nonlinear", "observer", "softneck.estimation:KalmanSettings", "softneck.estimation:NonlinearObserver",
             "softneck.estimation._nonlinear_runtime",
             "filter over an identified nonlinear model with a random-walk disturbance scaled by the model's motion"),
        Kind("pi", "controller", "softneck.design:PiSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "PI with reference filter, anti-windup and tendon allocation"),
        Kind("adaptive", "controller", "softneck.design:AdaptiveSettings", "softneck.design:VaryingController",
             f"{_DESIGN}.varying._adaptive_runtime",
             "recursive least squares during the run, gains redesigned in every sample, with safeguards"),
        Kind("hinf", "controller", "softneck.design:HinfSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "H-infinity mixed sensitivity on the exact-delay plant, verified on every sample"),
        Kind("pid", "controller", "softneck.design:PidSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "PID tuned on the worst sample of the plant, or by placed poles"),
        Kind("fopi", "controller", "softneck.design:FopiSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "fractional-order PI or PID, iso-damped"),
        Kind("lqg", "controller", "softneck.design:LqgSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "LQG whose filter estimates a load on the input: its integral action"),
        Kind("custom", "controller", "softneck.design:CustomSettings", "softneck.design:LinearController",
             f"{_DESIGN}.linear._linear_controller_runtime",
             "a system of your own from python-control (in Python: CustomSettings(controller=K))"),
        Kind("mpc", "controller", "softneck.design:MpcSettings", "softneck.design:MpcController",
             f"{_DESIGN}.predictive._mpc_runtime",
             "linear predictive control: limits, preview and co-contraction in one QP for each sample"),
        Kind("nmpc", "controller", "softneck.design:NmpcSettings", "softneck.design:NmpcController",
             f"{_DESIGN}.predictive._nmpc_runtime",
             "nonlinear predictive control over nn, play or greybox: one Gauss-Newton step for each sample"),
    )
}  # fmt: skip


#: Removed kinds and their replacements; docs/theory/tried.md has the reasons.
REMOVED: dict[str, str] = {
    "online_nlsm": "nlsm",
    "change": "nonlinear",
    "switched": "pi",
    "ncf": "hinf",
    "residual": "nlsm --set form=residual",
    "ensemble": "guarded",
    "scheduled": "pi",
    "srivc": "oe --set intervals=true",
    "subspace": "rls --set structure=mimo",
    "nss": "guarded --set of=nn` or `greybox",
    "rls_state": "Recursion in Python",
    "rls_online": "Recursion in Python",
    "frf": "softneck.frequency_response in Python",
}
_LAST_VERSION = "0.2.0"  # reads files of the kinds above


#: Settings that moved to the robot's file in softneck 0.3 -> their keys there.
_OF_ROBOT = {
    "position_limit": "[motors] setpoint_min and setpoint_max",
    "slew_limit": "[motors] rate_limit",
    "least_position": "[motors] setpoint_min",
    "tendon_angles": "[directions] angles_deg",
    "sample_time": "sample_time_s",
}


# What the file of every kind holds; a kind's own values are checked by its `from_archive`.
_EVERY_HEADER = {"kind": str, "sample_time": float, "order": str, "robot": {}, "settings": {}, "findings": {}}
_LONGEST_SAMPLE_TIME = 1e6


def removed_kind(name: str) -> str:
    """Return a sentence on a removed kind; empty if `name` is none."""
    if name not in REMOVED:
        return ""
    return (
        f"kind `{name}` was removed after softneck {_LAST_VERSION}, which still reads its files; use `{REMOVED[name]}`."
    )


def kinds_of(role: str) -> tuple[str, ...]:
    """Return the names of all kinds of one role."""
    return tuple(kind.name for kind in KINDS.values() if kind.role == role)


def find_kind(name: str, role: str) -> Kind:
    """Return the kind of that name; raise SettingsError with the known ones if there is none."""
    kind = KINDS.get(name) if isinstance(name, str) else None
    if kind is None or kind.role != role:
        if gone := removed_kind(str(name)):
            raise SettingsError(gone)
        known = kinds_of(role)
        raise SettingsError(
            f"unknown kind of {role} `{name}`; {did_you_mean(str(name), known)}use one of {', '.join(known)}."
        )
    return kind


def toml_value(text: str) -> Any:
    """Read a value as TOML does (number, true, [list]); anything else is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def make_settings(settings_class: type, values: Mapping[str, Any]) -> Any:
    """Return `settings_class(**values)`.

    Raises SettingsError: a key that the class does not have, or a value of the wrong type.
    """
    fields = {field.name for field in dataclasses.fields(settings_class)}
    unknown = sorted(set(values) - fields)
    if unknown and unknown[0] in _OF_ROBOT:
        raise SettingsError(
            f"`{unknown[0]}` is the robot's: set `{_OF_ROBOT[unknown[0]]}` in robot.toml, and name the file by --robot "
            "(`robot=` in Python)."
        )
    if unknown:
        meant = did_you_mean(unknown[0], fields)
        raise SettingsError(f"unknown setting `{unknown[0]}`; {meant}this kind has {', '.join(sorted(fields))}.")
    for field in dataclasses.fields(settings_class):
        if field.type == "bool" and not isinstance(values.get(field.name, False), bool):
            raise SettingsError(f"`{field.name}` is true or false; got {values[field.name]!r}.")
    try:
        return settings_class(**values)
    except TypeError as error:
        raise SettingsError(f"a setting has a value of the wrong type ({error}).") from error


def resolve(path: str) -> Any:
    """Import `package.module:name` and return the object."""
    module, _, name = path.partition(":")
    return getattr(import_module(module), name)


def load(path: str | Path, *, role: str | None = None) -> Any:
    """Open any model, observer or controller file that softneck wrote.

    Args:
        path: the `.npz` file.
        role: "model", "observer" or "controller" when only that will do.

    Raises:
        FileFormatError: not a softneck file, another version, damaged, or of another role.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> softneck.identify("rls", recording).save("rls.npz")
        >>> softneck.load("rls.npz").kind
        'rls'
    """
    header, arrays = read_archive(path)
    kind = KINDS.get(str(header.get("kind")))
    if kind is None and (gone := removed_kind(str(header.get("kind")))):
        raise FileFormatError(f"{path}: {gone}")
    if kind is None:
        raise FileFormatError(
            f"{path}: holds the unknown kind `{header.get('kind')}`; was it written by a newer softneck?"
        )
    if role is not None and kind.role != role:
        is_a, wanted = (f"{'an' if word[0] in 'aeiou' else 'a'} {word}" for word in (kind.role, role))
        raise FileFormatError(f"{path}: is {is_a} ({kind.name}), not {wanted}.")
    with fitting(path):
        require_header(header, _EVERY_HEADER)
        if not 0.0 < header.get("sample_time", 1.0) <= _LONGEST_SAMPLE_TIME:
            raise FileFormatError(f"its sample time is {header['sample_time']} s.")
        return resolve(kind.result).from_archive(header, arrays)


@contextmanager
def fitting(path: str | Path) -> Iterator[None]:
    """Turn errors of a header and arrays that do not fit together into FileFormatError."""
    try:
        yield
    except FileFormatError as error:
        raise FileFormatError(f"{path}: {error}") from error
    except ImportError:  # an extra that is not installed
        raise
    except Exception as error:
        raise FileFormatError(f"{path}: its header and arrays do not fit together ({error}).") from error
