"""A reference as a block: what the reference FMU of an SSP file is made of."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np

from softneck.core import SettingsError, require_positive
from softneck.runtime import Block, Port

from ._references import RampReference, RecordingReference, Reference, RotationReference, SineReference, StepReference
from ._wiring import REFERENCE_PORTS

_KINDS: tuple[type, ...] = (StepReference, RampReference, SineReference, RotationReference)
_RECORDED = 4
# The runtime's order; the starts of those that a kind does not have are never read.
_PARAMETERS = (
    Port(name="pitch", unit="rad", minimum=-0.8, maximum=0.8, description="end value or amplitude"),
    Port(name="roll", unit="rad", minimum=-0.8, maximum=0.8, description="end value or amplitude"),
    Port(name="cocontraction", unit="rad", minimum=-6.0, maximum=6.0, description="delta_i (Eq. 11)"),
    Port(name="inclination", unit="rad", minimum=0.0, maximum=0.8, description="of a rotation"),
    Port(name="frequency", unit="1", minimum=0.0, start=0.2, description="of a sine or rotation [Hz]"),
    Port(name="at", unit="s", description="time at which it begins"),
    Port(name="rise", unit="s", minimum=1e-9, start=1.0, description="time over which it rises"),
    Port(name="enabled_start", boolean=True, start=1.0, description="value of `enabled`"),
)


class ReferenceBlock:
    """A reference that an FMU can be built of (`softneck.fmu.describe._describe.Buildable`)."""

    def __init__(self, reference: Reference, *, sample_time: float = 0.02, duration: float | None = None) -> None:
        """Describe `reference` as a block.

        Args:
            reference: one of softneck's own, or any function of time if `duration` is given.
            sample_time: [s].
            duration: for how long a function of your own is written down, sample by sample [s].
        """
        require_positive("sample_time", sample_time, "s")
        self.reference, self.sample_time = reference, sample_time
        self._duration = duration

    def block(self) -> Block:
        """Return the block; its outputs are those of the reference, one sample after each step.

        Raises:
            SettingsError: a function of the user's own without a duration.
        """
        kind, starts, table = self._described()
        parameters = tuple(replace(port, start=starts.get(port.name, port.start)) for port in _PARAMETERS)
        return Block(
            kind="reference", role="reference", runtime="softneck.loop._reference_runtime",
            sample_time=self.sample_time, arrays=(np.array([float(kind), self.sample_time]), table), inputs=(),
            outputs=REFERENCE_PORTS, parameters=parameters,
        )  # fmt: skip

    def summary(self) -> str:
        """Return a line for people."""
        name = type(self.reference).__name__
        values = ", ".join(f"{key} = {value:g}" for key, value in self._described()[1].items())
        return f"{name}{f' ({values}; rad, s)' if values else ''} at {1e3 * self.sample_time:g} ms"

    def _described(self) -> tuple[int, dict[str, float], np.ndarray]:
        reference = self.reference
        for kind, known in enumerate(_KINDS):
            if isinstance(reference, known):
                starts = {item.name: float(getattr(reference, item.name)) for item in fields(known)}
                return kind, starts, np.zeros((1, 4))
        if isinstance(reference, RecordingReference):
            third = np.zeros(reference.time.size) if reference.cocontraction is None else reference.cocontraction
            return _RECORDED, {}, np.column_stack([reference.time, reference.pitch, reference.roll, third])
        if self._duration is None:
            raise SettingsError("a reference of your own needs the duration over which it is written down.")
        times = np.arange(math.ceil(self._duration / self.sample_time) + 1) * self.sample_time
        return _RECORDED, {}, np.array([[time, *reference(time)] for time in times.tolist()])
