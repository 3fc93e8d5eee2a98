"""Draws of a play model by the bootstrap: its weights refitted to segments drawn with replacement."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from softneck.core import Matrix, Progress, Vector, silent
from softneck.signals import Recording

from ..models._fitting import ScaledData, training_recording
from ..models._model import Model
from ._play import RIDGE_WEIGHTS, Data, Play, PlayStructure, _arrays, _in_si, ridge, rising, spread_of

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
        chains: masks (inputs, chains, terms) of the linear terms of each chain.
        middle, spread: (outputs, terms) weights of all rows, and (terms, terms) their covariance up to a factor.
    """

    model: Model
    scaled: ScaledData
    scaled_arrays: dict[str, Matrix]
    terms: Matrix
    outputs: Matrix
    groups: np.ndarray
    weight: float
    chains: np.ndarray
    middle: Matrix
    spread: Matrix

    @classmethod
    def fit(cls, recording: Recording, *, settings: Play | None = None, progress: Progress = silent) -> PlayDraws:
        """Fit kind `play` to a recording, and what draws need."""
        settings = settings or Play()
        model = settings.fit(recording, progress=progress)
        scaled, found = ScaledData.of(training_recording(recording, all_motors=True)), model.findings
        poles = model.arrays["load"][4:]
        drive = scaled.drive.with_valves(poles) if poles.size else scaled.drive
        data = Data.of(scaled.data, drive, scaled.directions.all_inputs(scaled.data.set_points))
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
        terms, outputs, weight = data.terms(form)[good], data.outputs[good], float(found["ridge"])
        return cls(
            model=model, scaled=scaled, scaled_arrays=_arrays(data, drive, form, weight, settings.echo),
            terms=terms, outputs=outputs, groups=np.concatenate(groups)[good], weight=weight, chains=form.chains,
            middle=ridge(terms, outputs, weight), spread=spread_of(terms, weight),
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
        away = ridge(self.terms[rows], self.outputs[rows], self.weight) - self.middle
        weights = rising(self.scaled_arrays["weights"] + factor * away, self.spread, self.chains)
        return self._in_si(weights)

    def smoother(self) -> list[PlayDraws]:
        """Return this with each larger weight of the ridge, the largest first, and this itself last."""
        larger = sorted((weight for weight in RIDGE_WEIGHTS if weight > self.weight), reverse=True)
        return [*map(self._with_ridge, larger), self]

    def _with_ridge(self, weight: float) -> PlayDraws:
        middle, spread = ridge(self.terms, self.outputs, weight), spread_of(self.terms, weight)
        weights = rising(self.scaled_arrays["weights"] + middle - self.middle, spread, self.chains)
        findings = {**self.model.findings, "ridge": weight}
        model = replace(self.model, arrays={**self.model.arrays, **self._in_si(weights)}, findings=findings)
        arrays = {**self.scaled_arrays, "weights": weights}
        return replace(self, model=model, scaled_arrays=arrays, weight=weight, middle=middle, spread=spread)

    def _in_si(self, weights: Matrix) -> dict[str, Matrix]:
        """Return scaled weights (outputs, terms) as the array of a draw."""
        arrays = {**self.scaled_arrays, "weights": weights}
        found = arrays if self.scaled.scaling.is_identity else _in_si(arrays, self.scaled.scaling)
        return {"weights": found["weights"]}
