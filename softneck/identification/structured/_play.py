"""Play operators, low-pass filters and a polynomial of them: a plant without feedback, by one ridge regression."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import DataError, Matrix, Progress, require_positive, require_whole, silent
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._arrays import memory_array
from ..models._directions import directions_of
from ..models._drive import LoadedDrive, drive_start, fit_loaded_drive
from ..models._error_feedback import BEYOND, fit_echo
from ..models._fitting import SAME_EXCITATION, fitted_model, training_recording
from ..models._model import Model
from ..models._state_space import history_array
from ._play_terms import Data, PlayStructure, ridge, scores

# What the hold-out chooses from: filters about as fast as the neck's 5 1/s and three times that; plays up to a
# tenth of the motors' 6 rad.
_RATES = (6.0, 15.0)
# Of other robots, whose time constant is found only roughly, by that of the neck.
_MORE_RATES = (4.0, 6.0, 10.0, 15.0, 25.0)
_WIDTHS = ((), (0.3,), (0.1, 0.3, 0.6))
_DEGREES = (1, 2, 3)
_RIDGES = (1e-6, 1e-4, 1e-2)
# Of forms whose fits on the hold-out differ by less than this [points], that with the fewest terms is taken.
_ALIKE = 0.1
# A held input is forgotten after this [s]: the slowest filter by far is that of the load, some 1 1/s.
_MEMORY = 15.0
# f is kept within the range of the training outputs, widened by half of it to either side.
_BEYOND = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Play:
    """Output-error model without feedback: polynomial of play operators and low-pass filters of the inputs.

    theta_i, phi_i and delta_i of the simulated motors (drives that stall under load) pass play operators and
    chains of low-pass filters; pitch and roll are ridge regressions on all of these and on products of one stage.
    What is None is chosen by the free run over rows held out: the last fifth of each run and the fifth furthest
    from all others, or `hold_out`.

    Attributes:
        rate: of the low-pass filters [1/s].
        order: filters in a chain; the polynomial is of the last but one.
        widths: half-widths of the play operators [rad].
        degree: of the polynomial: 1, 2, or 3 (cubes of the tilt only).
        ridge: weight of the squared coefficients of standardised terms.
        echo: past errors that correct a prediction where outputs are measured.
    """

    rate: float | None = None
    order: int = 5
    widths: tuple[float, ...] | None = None
    degree: int | None = None
    ridge: float | None = None
    echo: int = 8

    def __post_init__(self) -> None:
        if self.rate is not None:
            require_positive("rate", self.rate, "1/s")
        require_whole("order", self.order, 2, 50)
        require_whole("echo", self.echo, 1, 100)
        if self.widths is not None:
            object.__setattr__(self, "widths", tuple(self.widths))
            for width in self.widths:
                require_positive("widths", width, "rad")
        if self.degree is not None:
            require_whole("degree", self.degree, 1, 3)
        if self.ridge is not None:
            require_positive("ridge", self.ridge)

    @one_blas_thread
    def fit(
        self,
        recordings: Recording | list[Recording],
        *,
        hold_out: Recording | None = None,
        progress: Progress = silent,
    ) -> Model:
        """Identify both axes.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            hold_out: another excitation, on whose free run to choose what is None.
            progress: called with the part done and a word on it.

        Raises:
            DataError: too short, constant, or fewer rows than terms.
        """
        recording = training_recording(recordings, any_robot=True, all_motors=True)
        progress(0.0, "drives")
        drive = fit_loaded_drive(recording)
        directions = directions_of(recording, [drive.simulate(r.set_points, drive_start(r)) for r in recording.runs()])
        T = directions.inputs(recording)
        data = Data.of(recording, drive, directions, T)
        extra = None if hold_out is None else Data.of(hold_out, drive, directions, T)
        form, weight, fit, tried = self._choose(data, extra, progress)
        progress(0.95, "all rows")
        arrays = _arrays(data, drive, form, weight, self.echo)
        findings = {
            "rate": form.rate,
            "widths": list(form.widths),
            "degree": form.degree,
            "ridge": weight,
            "terms": len(form.table),
            "hold_out_fit": fit,
            "tried": tried,
        }
        if not recording.robot.is_neck:
            findings |= directions.findings()
        if hold_out is None and tried > 1:
            findings["remark"] = SAME_EXCITATION
        progress(1.0, "done")
        return fitted_model("play", self, recording, arrays=arrays, findings=findings)

    def _choose(self, data: Data, extra: Data | None, progress: Progress) -> tuple[PlayStructure, float, float, int]:
        """Return form and ridge of the best free run on the hold-out, its fit [%], and how many were tried."""
        inputs, tilts = len(data.redefinition), min(len(data.redefinition), data.outputs.shape[1])
        rates = _RATES if data.stretch == 1.0 else tuple(rate / data.stretch for rate in _MORE_RATES)
        forms = [
            PlayStructure(rate, self.order, widths, degree, inputs, tilts)
            for rate in (rates if self.rate is None else (self.rate,))
            for widths in (_WIDTHS if self.widths is None else (self.widths,))
            for degree in (_DEGREES if self.degree is None else (self.degree,))
        ]
        # Two thirds of the rows at least must say something that the terms do not already.
        rows = int(data.settled.sum())
        fitting = [form for form in forms if 3 * len(form.table) < rows]
        if not fitting:
            least = min(len(form.table) for form in forms)
            raise DataError(f"{rows} settled rows are too few for {least} terms; record longer or lower `order`.")
        ridges = _RIDGES if self.ridge is None else (self.ridge,)
        scored: list[tuple[float, PlayStructure, float]] = []
        for number, form in enumerate(fitting):
            best = f"best fit {max(score for score, _, _ in scored):.1f} %" if scored else "forms"
            progress(0.1 + 0.85 * number / len(fitting), best)
            values = scores(data, extra, form, ridges)
            scored += [(score, form, w) for score, w in zip(values, ridges, strict=True)]
        top = max(score for score, _, _ in scored)
        if not np.isfinite(top):
            raise DataError("no form has a finite error on the hold-out; does it move at all?")
        alike = [entry for entry in scored if entry[0] > top - _ALIKE]
        fit, form, weight = max(alike, key=lambda entry: (-len(entry[1].table), entry[0]))
        return form, weight, fit, len(scored)


def _arrays(data: Data, drive: LoadedDrive, form: PlayStructure, weight: float, order: int) -> dict[str, Matrix]:
    good = data.settled
    # Along the simulated motors, as in free run, and along the logged ones, as in a prediction: one f serves both.
    both = np.concatenate([data.terms(form)[good], data.terms(form, measured=True)[good]])
    W = ridge(both, np.tile(data.outputs[good], (2, 1)), weight)
    lowest, highest = data.outputs[good].min(axis=0), data.outputs[good].max(axis=0)
    wider = _BEYOND * (highest - lowest)
    limits = np.column_stack([lowest - wider, highest + wider])
    # What is measured beside the outputs are the motors: the errors of one step are those along them.
    errors = data.outputs - np.clip(data.terms(form, measured=True) @ W.T, limits[:, 0], limits[:, 1])
    errors[~good] = np.nan
    edges = np.cumsum([len(motors) for motors in data.motors])[:-1]
    parts: list[Matrix] = np.split(errors, edges)
    echo = np.array([fit_echo([part[:, axis] for part in parts], order, beyond=BEYOND) for axis in range(len(W))])
    history = int(max(order, drive.drive[:, 1].max(), 1))
    return {
        "history": history_array(history, len(W)),
        "drive": drive.drive,
        "load": drive.load,
        "redefinition": data.redefinition,
        "widths": np.array(form.widths, dtype=np.float64),
        "chain": form.chain(data.sample_time),
        "table": form.table,
        "weights": W,
        "range": limits,
        "echo": echo,
        "memory": memory_array(_MEMORY * data.stretch, data.sample_time),
    }
