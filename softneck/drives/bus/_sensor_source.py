"""Which inclinometer a drives file names, and where its samples come from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softneck.core import SettingsError, require_between, require_one_of, require_whole

from ..master._gate import Reading, sample_of

SENSORS = ("simulated", "can", "serial", "python")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSource:
    """Where the inclinometer's samples come from, beside its kind.

    `port`, `baud`, `request`, `start`: of kind "serial", see `SerialInclinometer`. `python`: of kind "python":
    `package.module:factory`, called with `options`. `options`: for the factory. `folder`: of the drives file, where
    modules are looked for.
    """

    port: str = ""
    baud: int = 9600
    request: bool = False
    start: float = 10.0
    python: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        require_whole("baud", self.baud, 300, 4_000_000)
        require_between("start_s", self.start, 0.1, 120.0, "s")


# Key of [sensor] in the drives file -> (field, type).
SOURCE_KEYS: dict[str, tuple[str, type]] = {
    "port": ("port", str),
    "baud": ("baud", int),
    "request": ("request", bool),
    "start_s": ("start", float),
    "python": ("python", str),
    "options": ("options", dict),
}
_NEEDS = {"serial": "port", "python": "python"}


def make_source(kind: str, table: Mapping[str, Any], folder: Path) -> SensorSource:
    """Return the source that the keys `SOURCE_KEYS` of a table [sensor] describe.

    Raises SettingsError: an unknown kind, a key of another type, or one that the kind needs is missing.
    """
    require_one_of("[sensor] kind", kind, SENSORS)
    values: dict[str, Any] = {}
    for key, value in table.items():
        name, wanted = SOURCE_KEYS[key]
        number = wanted is float and isinstance(value, int) and not isinstance(value, bool)
        if not (number or isinstance(value, wanted)) or (wanted is int and isinstance(value, bool)):
            raise SettingsError(f"[sensor] {key} must be of type {wanted.__name__}; got {value!r}.")
        values[name] = value
    needed = _NEEDS.get(kind)
    if needed is not None and not values.get(needed):
        raise SettingsError(f'[sensor] kind = "{kind}" needs `{needed}`.')
    return SensorSource(**values, folder=folder)


# For each output: number of the sensor's own axis, and its sign.
Axes = tuple[tuple[int, float], ...]


def axes_of(said: Sequence[str], outputs: Sequence[str]) -> Axes:
    """Parse a list such as `["-roll", "pitch"]`: the first output is the sensor's second, reversed.

    The sensor's own axes go by the outputs' names, in their order; an empty list is a sensor that sits as it should.
    Raises SettingsError: not each axis once.
    """
    if not said:
        return tuple((k, 1.0) for k in range(len(outputs)))
    bare = [axis.removeprefix("-") for axis in said]
    if sorted(bare) != sorted(outputs):
        raise SettingsError(
            f'[sensor] axes must name each of {", ".join(outputs)} once, with "-" where it is reversed; got '
            f"{', '.join(said) or 'nothing'}."
        )
    return tuple((list(outputs).index(name), -1.0 if axis != name else 1.0)
                 for name, axis in zip(bare, said, strict=True))  # fmt: skip


def said_of(axes: Axes, outputs: Sequence[str]) -> tuple[str, ...]:
    """Return the list that `axes_of` reads; empty where the sensor sits as it should."""
    said = tuple(("-" if sign < 0.0 else "") + outputs[number] for number, sign in axes)
    return () if said == tuple(outputs) else said


def inverse(axes: Axes) -> Axes:
    """Return the inverse: the sensor's axes in terms of the outputs."""
    back = [(0, 1.0)] * len(axes)
    for output, (number, sign) in enumerate(axes):
        back[number] = (output, sign)
    return tuple(back)


def to_robot_axes(sample: Reading, axes: Axes) -> Reading:
    """Convert a sample from the sensor's axes to the robot's outputs."""
    values, rates = (tuple(sign * given[number] for number, sign in axes) for given in (sample.values, sample.rates))
    return sample_of(values, rates, valid=sample.valid)
