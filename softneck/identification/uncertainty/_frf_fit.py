"""From recordings to a frequency response: which inputs moved, which runs are periodic, which were in a closed loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, Matrix, ReprMixin, SettingsError, Vector, require_one_of, to_si
from softneck.robot import Robot
from softneck.signals import Recording, RecordingLike, concatenate, open_recording

from ..linear._oe import SOURCES
from ._local_polynomial import (
    ComplexArray,
    Periods,
    Response,
    Spectrum,
    local_polynomial,
    period_of,
    periods,
    robust,
    spectrum,
)

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

# By definition: a response is supported where its 95 % circle is within this part of it.
SUPPORTED = 0.3
METHODS = {
    "robust": "periodic multisines: the best linear approximation for this class of input",
    "local polynomials": "any excitation: local polynomials, nonlinear distortion counted as noise",
}


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class FrequencyResponse(ReprMixin):
    """From inputs, held between samples, to sampled outputs: `y(k) = G(exp(j w T)) u(k)`, in SI.

    Attributes:
        sample_time: [s].
        robot: whose.
        inputs: (q,) names: theta_i, phi_i, delta_i of the neck, of other robots `{output}_input`, or the motors.
        frequency: (k,) rising [rad/s].
        response: (k, m, q), NaN where an input was not excited.
        covariance: (k, m q, m q), entry i q + a for `response[:, i, a]`: noise and nonlinear distortion.
        freedom: (k,) degrees of freedom of the covariance.
        coherence: (k, m) what part of each output the inputs explain, 0 to 1.
        noise: (k, m, q) variance by noise alone; NaN where it was not told apart.
        amplitude: (q,) of the inputs, root mean square times sqrt 2 [rad].
        method: "robust" or "local polynomials".
        findings: what was found on the way.
    """

    sample_time: float
    robot: Robot
    inputs: tuple[str, ...]
    frequency: Vector
    response: ComplexArray
    covariance: ComplexArray
    freedom: Vector
    coherence: Vector
    noise: Vector
    amplitude: Vector
    method: str
    findings: dict[str, Any] = field(default_factory=dict)

    @property
    def outputs(self) -> tuple[str, ...]:
        """(m,) names."""
        return self.robot.outputs.names

    def variance(self) -> Vector:
        """Return (k, m, q): of each entry of `response`, `E|error|^2`."""
        diagonal = np.einsum("kaa->ka", self.covariance).real
        return diagonal.reshape(self.response.shape)

    def radius(self) -> Vector:
        """Return (k, m, q): the radius of each entry's 95 % circle about `response`.

        `|error|^2 / variance` has an F distribution of 2 and 2 `freedom` degrees (Pintelon and Schoukens 2012, 2.4).
        """
        from scipy.stats import f

        factor = np.asarray(f.ppf(0.95, 2, 2.0 * np.maximum(self.freedom, 1e-9)))
        return np.sqrt(self.variance() * factor[:, None, None])

    def supported(self, output: str, source: str) -> np.ndarray:
        """Return (k,) where the 95 % circle of that entry is within 30 % of it."""
        i, a = self._entry(output, source)
        with np.errstate(invalid="ignore", divide="ignore"):
            return self.radius()[:, i, a] <= SUPPORTED * np.abs(self.response[:, i, a])

    def band(self, output: str, source: str) -> tuple[float, float] | None:
        """Return the widest band [rad/s] in which nine in ten frequencies are supported, ends included; else None."""
        good = self.supported(output, source)
        hits = np.concatenate([[0], np.cumsum(good)])
        best: tuple[float, float] | None = None
        for start in np.flatnonzero(good):
            for stop in np.flatnonzero(good)[::-1]:
                count = stop - start + 1
                if count < 2:
                    break
                if hits[stop + 1] - hits[start] >= 0.9 * count:
                    found = (float(self.frequency[start]), float(self.frequency[stop]))
                    if best is None or np.log(found[1] / found[0]) > np.log(best[1] / best[0]):
                        best = found
                    break
        return best

    def own_input(self, output: str) -> str:
        """Return the input that is meant to move an output (of the neck theta_i for pitch); else the strongest."""
        i = self._entry(output, self.inputs[0])[0]
        if self.robot.weights() is not None and self.robot.input_names[i] in self.inputs:
            return self.robot.input_names[i]
        return self.inputs[int(np.argmax(np.nansum(np.abs(self.response[:, i]), axis=0)))]

    def frd(self, output: str | None = None, source: str | None = None) -> control.FrequencyResponseData:
        """Return it, or one entry of it, for python-control; frequencies where it is NaN are left out."""
        import control

        G = self.response
        outputs, inputs = list(self.outputs), list(self.inputs)
        if output is not None:
            i, a = self._entry(output, source or self.own_input(output))
            G, outputs, inputs = G[:, i : i + 1, a : a + 1], [outputs[i]], [inputs[a]]
        known = np.isfinite(G).all(axis=(1, 2))
        return control.FrequencyResponseData(
            np.moveaxis(G[known], 0, 2), self.frequency[known], self.sample_time, inputs=inputs, outputs=outputs
        )

    def summary(self) -> str:
        """Return a few lines, in the robot's display unit."""
        scale, per_input, unit = self.display_factors()
        lines = [
            f"frequency response, {METHODS[self.method]}; {self.frequency.size} frequencies, "
            f"{self.frequency[0]:.3g} to {self.frequency[-1]:.3g} rad/s"
        ]
        sizes = ", ".join(
            f"{name} {per_input * size:.2g}" for name, size in zip(self.inputs, self.amplitude, strict=True)
        )
        lines.append(
            f"amplitude (rms times sqrt 2) [{self.robot.motors.unit}]: {sizes}; it holds for inputs of this size"
        )
        for output in self.outputs:
            lines += self._axis_lines(output, scale, unit)
        lines += [
            f"{key}: {value}" for key, value in self.findings.items() if key in ("closed_loop", "missing", "caution")
        ]
        return "\n".join(lines)

    def plot(self, output: str | None = None, *, models: Mapping[str, Any] | None = None) -> Figure:
        """Return a Bode plot of one output's answer to its own input, and the coherence.

        Args:
            output: name; the first if not given.
            models: name -> linear model or family, drawn beside.

        Raises:
            DataError: a model that is not linear, or of another sample time.
        """
        from softneck.plots import chart_figure, frequency_response_chart

        output = self.outputs[0] if output is None else output
        source = self.own_input(output)
        i, a = self._entry(output, source)
        scale, _, unit = self.display_factors()
        return chart_figure(frequency_response_chart(
            self.frequency, scale * self.response[:, i, a], scale * np.nan_to_num(self.radius()[:, i, a]),
            self.coherence[:, i], f"{source} to {output}", unit=unit,
            models={name: scale * self._curve(model, name, output) for name, model in (models or {}).items()},
        ))  # fmt: skip

    def _curve(self, model: Any, name: str, output: str) -> np.ndarray:
        """Return a model's response of `output` to the input that is meant for it [SI]."""
        if not hasattr(model, "tf"):
            raise DataError(f"{name}: only a linear model or a family has a response to draw.")
        if abs(model.sample_time - self.sample_time) > 1e-9 * self.sample_time:
            raise DataError(f"{name}: is at {model.sample_time:g} s and the recordings at {self.sample_time:g} s.")
        return np.squeeze(model.tf(output)(np.exp(1j * self.frequency * self.sample_time)))

    def _entry(self, output: str, source: str) -> tuple[int, int]:
        for name, names in ((output, self.outputs), (source, self.inputs)):
            if name not in names:
                raise SettingsError(f"unknown channel `{name}`; use one of {', '.join(names)}.")
        return self.outputs.index(output), self.inputs.index(source)

    def display_factors(self) -> tuple[float, float, str]:
        """Return the display factors of a response and of an input in SI, and the unit of the response."""
        outputs, motors = self.robot.outputs.display_unit, self.robot.motors.unit
        per_input = to_si(motors)[0]
        return per_input / to_si(outputs)[0], 1.0 / per_input, f"{outputs}/{motors}"

    def _axis_lines(self, output: str, scale: float, unit: str) -> list[str]:
        """Return a line on the band, and some five on values spread over the frequencies where something is known."""
        source = self.own_input(output)
        i, a = self._entry(output, source)
        band, radius = self.band(output, source), self.radius()
        told = (
            "nowhere supported by the data" if band is None else f"supported from {band[0]:.3g} to {band[1]:.3g} rad/s"
        )
        lines = [f"{source} to {output}: {told} (95 % circle within 30 %)"]
        known = np.flatnonzero(np.isfinite(self.response[:, i, a]))
        if known.size == 0:
            return lines
        for k in np.unique(known[np.linspace(0, known.size - 1, 6).round().astype(int)]):
            G = self.response[k, i, a]
            lines.append(
                f"  {self.frequency[k]:6.2f} rad/s: {scale * abs(G):.3g} +- {scale * radius[k, i, a]:.2g} "
                f"{unit} at {np.degrees(np.angle(G)):.0f} deg; coherence {self.coherence[k, i]:.2f}"
            )
        return lines


# Runs shorter than this have too few frequencies for a window of the local polynomials.
_MIN_ROWS = 200
# Samples that the sensor missed are filled by straight lines; more of them than this would be inventing an answer.
_MAX_MISSED_SHARE = 0.1
# An input that moves less than this part of the largest is at rest.
_MIN_MOTION_RATIO = 1e-3
# Realisations are of one class of input where their sizes agree within this factor.
_MAX_SIZE_RATIO = 1.5
_FREQUENCY_COUNT = 100
_REST_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """One run: inputs (time, q), outputs (time, m), references (time, m) of a closed loop or None."""

    inputs: Matrix
    outputs: Matrix
    references: Matrix | None
    missed: int


def frequency_response(recordings: RecordingLike, *, source: str = "set_points") -> FrequencyResponse:
    """Return the nonparametric response from inputs to outputs, with covariance and coherence.

    Runs of periodic multisines (at least two realisations, each of as many orthogonal experiments as inputs move) are
    taken by the robust method, which tells noise and nonlinear distortion apart; anything else by local polynomials.
    Recordings with a reference were in a closed loop:
    `S_yr S_ur^-1`. Every result is of inputs of this size: a nonlinear robot has another one for others.

    Args:
        recordings: as `identify` takes them; of one robot and one sample time; runs are never joined.
        source: "set_points", or "positions" of the motors.

    Returns:
        the response at its frequencies, in SI, inputs held between samples.

    Raises:
        DataError: too short, nothing moves, too many samples missed, sizes of realisations that differ, a closed
            loop whose reference rests or was not logged.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> found = softneck.frequency_response(softneck.record(signal("eq22", duration=30.0), neck, seed=1))
        >>> found.outputs, found.own_input("pitch")
        (('pitch', 'roll'), 'theta_i')
    """
    parts = [open_recording(item) for item in (recordings if isinstance(recordings, list | tuple) else [recordings])]
    require_one_of("source", source, SOURCES)
    whole = concatenate(parts)
    robot, sample_time = whole.robot, whole.sample_time
    names, transform = input_names(robot)
    runs = [_run(run, transform, source) for part in parts for run in part.runs()]
    moving = _moving(runs, names)
    runs = [_Run(run.inputs[:, moving], run.outputs, run.references, run.missed) for run in runs]
    inputs = tuple(name for name, moves in zip(names, moving, strict=True) if moves)
    found, method = _estimate(runs, sample_time)
    missed = sum(run.missed for run in runs)
    findings: dict[str, Any] = {"runs": len(runs), "rows": sum(run.inputs.shape[0] for run in runs)}
    if missed:
        findings["missing"] = f"{missed} rows with a missing sample were filled by straight lines"
    if any(run.references is not None for run in runs):
        findings["closed_loop"] = "recorded in a closed loop: from the reference to outputs and inputs, S_yr S_ur^-1"
    noise = np.full(found.response.shape, np.nan) if found.noise is None else found.noise
    return FrequencyResponse(
        sample_time=sample_time, robot=robot, inputs=inputs, frequency=found.frequency, response=found.response,
        covariance=found.covariance, freedom=found.freedom, coherence=np.clip(found.coherence, 0.0, 1.0), noise=noise,
        amplitude=np.sqrt(2.0 * np.mean([run.inputs.var(axis=0) for run in runs], axis=0)), method=method,
        findings=findings,
    )  # fmt: skip


def input_names(robot: Robot) -> tuple[tuple[str, ...], Matrix]:
    """Return names of the inputs and their weights (q, motors): one for each output, one for each way that moves none.

    Of the neck theta_i, phi_i, delta_i (Eq. 9-11); without directions, the motors themselves.
    """
    weights, motors = robot.weights(), len(robot.motors.names)
    if weights is None:
        return robot.set_points, np.eye(motors)
    if robot.directions.names:
        return robot.directions.names, robot.redefinition()[0]
    rest = np.linalg.svd(weights)[2][weights.shape[0] :]
    return (*robot.input_names, *(f"cocontraction_{k + 1}" for k in range(rest.shape[0]))), np.vstack([weights, rest])


def _run(run: Recording, transform: Matrix, source: str) -> _Run:
    motors = run.motor_positions if source == "positions" else run.set_points
    lost = ~np.isfinite(np.hstack([motors, run.outputs]))
    worst = float(lost.mean(axis=0).max())
    if worst > _MAX_MISSED_SHARE:
        raise DataError(
            f"run {int(run.run[0])}: {100 * worst:.0f} % of a channel's samples are missing, more than "
            f"{100 * _MAX_MISSED_SHARE:.0f} %; record again."
        )
    return _Run(
        _interpolate_missing(motors) @ transform.T,
        _interpolate_missing(run.outputs),
        _references(run),
        int(lost.any(axis=1).sum()),
    )


def _interpolate_missing(values: Matrix) -> Matrix:
    """Return (time, n) with straight lines where samples are missing."""
    rows, filled = np.arange(values.shape[0]), values.copy()
    for column in filled.T:
        there = np.isfinite(column)
        column[~there] = np.interp(rows[~there], rows[there], column[there])
    return filled


def _references(run: Recording) -> Matrix | None:
    """Return the references of a run in a closed loop, None for an open one; DataError if they rest or are missing."""
    names = [f"{name}_reference" for name in run.robot.outputs.names]
    logged = [name for name in names if name in run.channels]
    if not logged:
        if any(name in run.channels for name in ("enabled", "innovation")):
            raise DataError(
                "recorded in a closed loop (it has an observer's or a controller's channels) without its reference: "
                f"log `{names[0]}`, or record in an open loop."
            )
        return None
    r = np.column_stack([run.channels[name] for name in logged])
    if np.ptp(r, axis=0).max() <= _REST_TOLERANCE:
        raise DataError("recorded in a closed loop whose reference rests: nothing drives it; let the reference move.")
    return r[:, np.ptp(r, axis=0) > _REST_TOLERANCE]


def _moving(runs: Sequence[_Run], names: Sequence[str]) -> np.ndarray:
    """Return which inputs move (q,)."""
    size = np.sqrt(np.mean([run.inputs.var(axis=0) for run in runs], axis=0))
    if size.max() <= _REST_TOLERANCE:
        raise DataError(f"no input moves ({', '.join(names)} rest); there is nothing to see a response by.")
    return size > _MIN_MOTION_RATIO * size.max()


def _estimate(runs: Sequence[_Run], sample_time: float) -> tuple[Response, str]:
    """Return the response and how it was found."""
    if any(run.references is not None for run in runs):
        return _behind_references(runs, sample_time), "local polynomials"
    lengths = [period_of(run.inputs) for run in runs]
    cut = [
        periods(run.inputs, run.outputs, length, sample_time)
        for run, length in zip(runs, lengths, strict=True)
        if length is not None
    ]
    if any(item.is_sine for item in cut):
        raise DataError("a run of one sine shows no linear response; record `multisine` with a band of two ends.")
    others = [run for run, length in zip(runs, lengths, strict=True) if length is None]
    if not others:
        _check_alike(cut)
        found = robust(cut)
        if found is not None:
            return found, "robust"
    _check_length(others)
    spectra = [spectrum(run.inputs, run.outputs, sample_time) for run in runs]
    return local_polynomial(spectra, _grid(runs, sample_time), runs[0].outputs.shape[1]), "local polynomials"


def _behind_references(runs: Sequence[_Run], sample_time: float) -> Response:
    widths = {None if run.references is None else run.references.shape[1] for run in runs}
    if len(widths) > 1:
        raise DataError("some runs are in a closed loop and others not, or other references move; take them apart.")
    q = runs[0].inputs.shape[1]
    _check_length(runs)
    spectra: list[Spectrum] = []
    for run in runs:
        references = run.references
        if references is None or references.shape[1] < q:
            count = 0 if references is None else references.shape[1]
            raise DataError(
                f"in a closed loop {q} inputs move and {count} reference(s): as many references must move as inputs; "
                "let each move by itself, and the co-contraction rest."
            )
        spectra.append(spectrum(references, np.hstack([run.outputs, run.inputs]), sample_time))
    return local_polynomial(spectra, _grid(runs, sample_time), runs[0].outputs.shape[1])


def _grid(runs: Sequence[_Run], sample_time: float) -> Vector:
    """Return the frequencies at which local polynomials answer: from two cycles in the longest run to nine tenths of
    the Nyquist frequency, beyond which little of a held input is left."""
    longest = max(run.inputs.shape[0] for run in runs) * sample_time
    return np.geomspace(4.0 * np.pi / longest, 0.9 * np.pi / sample_time, _FREQUENCY_COUNT)


def _check_length(runs: Sequence[_Run]) -> None:
    for number, run in enumerate(runs):
        if run.inputs.shape[0] < _MIN_ROWS:
            raise DataError(
                f"run {number} has {run.inputs.shape[0]} rows; a frequency response of what is not periodic needs "
                f"{_MIN_ROWS} at least."
            )


def _check_alike(runs: Sequence[Periods]) -> None:
    sizes = [float(np.sqrt((np.abs(run.inputs) ** 2).sum())) for run in runs]
    if max(sizes) > _MAX_SIZE_RATIO * min(sizes):
        raise DataError(
            f"the multisines' sizes differ by a factor of {max(sizes) / min(sizes):.2g}: a nonlinear robot answers "
            "small and large ones differently; make one response of each size."
        )
