"""Which of a sensor's own axes is which output of the robot, and with which sign."""

from __future__ import annotations

from collections.abc import Sequence

from softneck.core import SettingsError

from ..master._gate import Reading, sample_of

# For each output: number of the sensor's own axis, and its sign.
Axes = tuple[tuple[int, float], ...]


def axes_of(said: Sequence[str], outputs: Sequence[str]) -> Axes:
    """Return what a list such as `["-roll", "pitch"]` says: the first output is the sensor's second, reversed.

    The sensor's own axes go by the outputs' names, in their order; an empty list is a sensor that sits as it should.

    Raises:
        SettingsError: not each axis once.
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
    """Return the way back: what the sensor's own axes are of the outputs."""
    back = [(0, 1.0)] * len(axes)
    for output, (number, sign) in enumerate(axes):
        back[number] = (output, sign)
    return tuple(back)


def turned(sample: Reading, axes: Axes) -> Reading:
    """Return what the robot's outputs are in a sample of the sensor's own axes."""
    values, rates = (tuple(sign * given[number] for number, sign in axes) for given in (sample.values, sample.rates))
    return sample_of(values, rates, valid=sample.valid)
