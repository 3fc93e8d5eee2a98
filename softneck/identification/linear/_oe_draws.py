"""Draws of an output-error model: other poles and numerators that explain its recordings too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import DataError, Matrix, Progress, Vector, silent
from softneck.signals import Recording

from ..models._fitting import ScaledData, training_recording
from ..models._model import Model
from ._oe import OutputError, OutputErrorFit, axis_runs, fit_output_error, limit_poles, prediction_slopes
from ._regression import linear_in_si

# Length of a segment [s of a neck's time]: ten of its time constants.
_SEGMENT_S = 2.0
# Largest size of a pole that is drawn.
_STABLE = 1.0 - 1e-6


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class OutputErrorDraws:
    """Transfer functions of two poles, drawn around the fitted ones.

    Segments of the recordings disagree on the numbers, as no model is exact. The draws have the covariance
    `H^-1 (sum g g') H^-1` of a misspecified model (White 1982, Econometrica 50:1), g the gradient of each segment.

    Attributes:
        model: fitted; a draw replaces its state space.
        settings: of its fit.
        scaled: its training data.
        fits, delays: of each output; the dead times are not drawn [samples].
        roots: (n, segments) of each covariance R R' of (f, b).
    """

    model: Model
    settings: OutputError
    scaled: ScaledData
    fits: list[OutputErrorFit]
    delays: list[int]
    roots: list[Matrix]

    @classmethod
    def fit(cls, recording: Recording, *, progress: Progress = silent) -> OutputErrorDraws:
        """Fit kind `oe` to a recording, and what draws need.

        Raises:
            DataError: one pole does for this robot.
        """
        model = OutputError().fit(recording, progress=progress)
        nf, nb = int(model.settings["nf"]), int(model.settings["nb"])
        if nf < 2:
            raise DataError("draws of kind `oe` are for robots of second order; this one has one pole.")
        scaled = ScaledData.of(training_recording(recording))
        fits, delays, roots = list[OutputErrorFit](), list[int](), list[Matrix]()
        for name, runs in zip(scaled.directions.names, axis_runs(scaled, "set_points"), strict=True):
            known = model.findings["transfer_functions"][name]
            fit = fit_output_error(runs, nf, nb, known["delay"], [np.array(known["a"])], constant=scaled.has_offset)
            if fit is None:
                raise DataError(f"the poles of {name} are not stable in scaled time.")
            J, left = prediction_slopes(runs, fit, known["delay"], constant=scaled.has_offset)
            segments = np.arange(len(left)) // max(1, round(_SEGMENT_S / scaled.data.sample_time))
            push = np.zeros((segments[-1] + 1, J.shape[1]))
            np.add.at(push, segments, J * left[:, None])
            roots.append((np.linalg.pinv(J.T @ J, hermitian=True) @ push.T)[: nf + nb])
            fits.append(fit)
            delays.append(int(known["delay"]))
        settings = OutputError(nf=nf, nb=nb)
        return cls(model=model, settings=settings, scaled=scaled, fits=fits, delays=delays, roots=roots)

    def draw(self, rng: np.random.Generator) -> Vector:
        """Return a draw: a normal number for each segment of each output."""
        return rng.standard_normal(sum(root.shape[1] for root in self.roots))

    def arrays(self, draw: Vector, factor: float) -> dict[str, Matrix]:
        """Return the arrays of a draw whose deviations are `factor` times those of the segments."""
        each = np.split(draw, np.cumsum([root.shape[1] for root in self.roots])[:-1])
        fits, nf = list[OutputErrorFit](), self.fits[0].f.size
        for fit, root, numbers in zip(self.fits, self.roots, each, strict=True):
            away = factor * root @ numbers
            fits.append(replace(fit, f=limit_poles(fit.f + away[:nf], _STABLE), b=fit.b + away[nf:]))
        arrays = self.settings.arrays_of(self.scaled, fits, self.delays)[0]
        found = arrays if self.scaled.scaling.is_identity else linear_in_si(arrays, self.scaled.scaling)
        return {name: found[name] for name in ("A", "B", "K", "offset") if name in found}

    def smoother(self) -> Sequence[OutputErrorDraws]:
        """Return this alone: it has no ridge."""
        return [self]
