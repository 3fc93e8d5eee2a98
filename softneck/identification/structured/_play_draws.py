"""Draws of a play model by the bootstrap: its weights refitted to segments drawn with replacement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, Progress, Vector, silent
from softneck.signals import Recording

from ..models._fitting import ScaledData, training_recording
from ..models._model import Model
from ._play import Data, Play, PlayStructure, _arrays, _in_si, ridge

# Length of a segment [s of a neck's time]: ten of its time constants.
_SEGMENT_S = 2.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PlayDraws:
    """Weights of a play model, bootstrapped over segments of its runs (Kuensch 1989, Ann. Stat. 17:1217).

    Attributes:
        model: fitted; a draw replaces its weights.
        scaled: its training data.
        scaled_arrays: of the model, in scaled quantities.
        terms, outputs: (rows, terms) and (rows, outputs) from which the weights are learned.
        groups: (rows,) the segment of each row.
        weight: of the ridge.
    """

    model: Model
    scaled: ScaledData
    scaled_arrays: dict[str, Matrix]
    terms: Matrix
    outputs: Matrix
    groups: np.ndarray
    weight: float

    @classmethod
    def fit(cls, recording: Recording, *, settings: Play | None = None, progress: Progress = silent) -> PlayDraws:
        """Fit kind `play` to a recording, and what draws need."""
        settings = settings or Play()
        model = settings.fit(recording, progress=progress)
        scaled, found = ScaledData.of(training_recording(recording, all_motors=True)), model.findings
        data = Data.of(scaled.data, scaled.drive, scaled.directions.all_inputs(scaled.data.set_points))
        unit, second = scaled.scaling.motor_unit, scaled.scaling.second
        inputs, tilts = len(data.redefinition), min(len(data.redefinition), data.outputs.shape[1])
        widths = tuple(width / unit for width in found["widths"])
        form = PlayStructure(found["rate"] * second, settings.order, widths, found["degree"], inputs, tilts)
        good, length = data.settled, max(1, round(_SEGMENT_S / data.sample_time))
        groups, first = [], 0
        for motors in data.motors:
            number = first + np.arange(len(motors)) // length
            groups.append(number)
            first = int(number[-1]) + 1
        return cls(
            model=model, scaled=scaled, scaled_arrays=_arrays(data, scaled.drive, form, found["ridge"], settings.echo),
            terms=data.terms(form)[good], outputs=data.outputs[good], groups=np.concatenate(groups)[good],
            weight=float(found["ridge"]),
        )  # fmt: skip

    def draw(self, rng: np.random.Generator) -> Vector:
        """Return a draw: how often each segment is taken."""
        there = np.unique(self.groups)
        counts = np.zeros(int(self.groups.max()) + 1)
        np.add.at(counts, rng.choice(there, there.size), 1.0)
        return counts

    def arrays(self, draw: Vector, factor: float) -> dict[str, Matrix]:
        """Return the arrays of a draw whose deviations are `factor` times those of the bootstrap."""
        rows = np.repeat(np.arange(self.groups.size), draw[self.groups].astype(int))
        middle = ridge(self.terms, self.outputs, self.weight)
        away = ridge(self.terms[rows], self.outputs[rows], self.weight) - middle
        own = self.scaled_arrays
        arrays = {**own, "weights": own["weights"] + factor * away}
        found = arrays if self.scaled.scaling.is_identity else _in_si(arrays, self.scaled.scaling)
        return {"weights": found["weights"]}
