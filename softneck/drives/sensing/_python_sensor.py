"""An inclinometer of the user's own, `package.module:factory`, kept from hurting the control loop where possible."""

from __future__ import annotations

import contextlib
import importlib
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from softneck.core import SettingsError

from ..master import Frame, Tilt
from ..master._gate import Reading, sample_of
from ._serial import SensorError

_METHODS = ("take", "read")
# A call that takes longer than this has cost bus cycles [s]; the loop itself stops after five of them.
_LONG = 0.02


class PythonInclinometer:
    """Asks a sensor of the user's own; after its first mistake it is asked no more, and the loop goes to rest.

    Attributes:
        problem: why it is asked no more, or which call took long; "" if all is well.
    """

    def __init__(self, sensor: Any, name: str, outputs: int = 2) -> None:
        """Ask `sensor` for so many outputs; it is called `name` where something is said about it."""
        self._sensor, self.name, self._outputs = sensor, name, outputs
        self.problem = ""
        self._ended = False

    def take(self, frames: Sequence[Frame]) -> None:
        """Hand over frames of a cycle without a sample."""
        self._call("take", frames)

    def read(self, now: float, frames: Sequence[Frame]) -> Reading | None:
        """Return the newest sample; None if none came, or where it returned something else."""
        answer = self._call("read", now, frames)
        if answer is None:
            return None
        try:
            return self._sample(answer)
        except (TypeError, ValueError) as error:
            self._end(f"`read` returned no sample: {error}")
            return None

    def _sample(self, answer: Any) -> Reading:
        """Return a `Tilt`, or one number for each output of another robot, as a sample."""
        if isinstance(answer, Tilt) and self._outputs == 2:
            values, rates = ([float(value) for value in told] for told in (answer.values, answer.rates))
            return sample_of(values, rates, valid=bool(answer.valid))
        if self._outputs == 2:
            raise TypeError(f"{type(answer).__name__} {answer!r:.60} is not a softneck.drives.master.Tilt")
        values = [float(value) for value in list[Any](answer)]
        if len(values) != self._outputs:
            raise TypeError(f"{len(values)} numbers for {self._outputs} outputs")
        return sample_of(values)

    def close(self) -> None:
        """Close it if it can be closed."""
        close = getattr(self._sensor, "close", None)
        if close is not None:
            # What fails now can no longer move or stop anything.
            with contextlib.suppress(Exception):
                close()

    def _call(self, method: str, *arguments: Any) -> Any:
        if self._ended:
            return None
        begin = time.monotonic()
        try:
            answer = getattr(self._sensor, method)(*arguments)
        except Exception as error:  # whatever it is, the drives must be led to rest rather than dropped
            self._end(f"`{method}` raised {type(error).__name__}: {' '.join(str(error).split())}")
            return None
        took = time.monotonic() - begin
        if took > _LONG and not self.problem:
            self.problem = f"`{method}` took {1e3 * took:.0f} ms; it must not wait."
        return answer

    def _end(self, problem: str) -> None:
        self._ended, self.problem = True, f"{problem}. It was not asked again."


def make_python_sensor(
    python: str, options: Mapping[str, Any], folder: Path, *, outputs: int = 2
) -> PythonInclinometer:
    """Call the factory `package.module:factory` with `options`; `folder` is looked into for the module too.

    Its sensor says `Tilt`s, or for a robot of other than two outputs a sequence with one number for each [rad].

    Raises:
        SettingsError: there is no such factory, or it returns no sensor.
        SensorError: it raises something.
    """
    module, _, name = python.partition(":")
    place = str(folder.resolve())
    sys.path.insert(0, place)
    try:
        factory = getattr(importlib.import_module(module), name)
    except Exception as error:  # a module of the user's own raises what it likes while it is imported
        raise SettingsError(
            f"[sensor] python = `{python}` cannot be found ({type(error).__name__}: {' '.join(str(error).split())}); "
            "write package.module:factory."
        ) from error
    finally:
        sys.path.remove(place)
    try:
        sensor = factory(dict(options))
    except Exception as error:
        text = " ".join(str(error).split())
        raise SensorError(f"inclinometer `{python}`: {type(error).__name__}: {text}. Nothing moved.") from error
    missing = [method for method in _METHODS if not callable(getattr(sensor, method, None))]
    if missing:
        raise SettingsError(f"[sensor] python = `{python}` returned a sensor without `{missing[0]}`.")
    return PythonInclinometer(sensor, python, outputs)
