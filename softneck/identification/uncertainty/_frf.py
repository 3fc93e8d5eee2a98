"""The frequency response of a robot as data: values, covariance, coherence, and the band that the data support."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import DataError, FileFormatError, SettingsError, Vector, require_between, to_si, write_archive
from softneck.core._shown import Shown
from softneck.robot import Robot

from ._spectra import ComplexArray

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
class FrequencyResponse(Shown):
    """From inputs, held between samples, to sampled outputs: `y(k) = G(exp(j w T)) u(k)`, in SI.

    Attributes:
        sample_time: [s].
        robot: whose.
        inputs: (q,) names: theta_i, phi_i, delta_i of the neck, of other robots `towards_<output>` or the motors.
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

    def radius(self, confidence: float = 0.95) -> Vector:
        """Return (k, m, q): each entry lies within this circle about `response` with that confidence.

        `|error|^2 / variance` has an F distribution of 2 and 2 `freedom` degrees (Pintelon and Schoukens 2012, 2.4).

        Raises:
            SettingsError: a confidence outside 0 to 1.
        """
        from scipy.stats import f

        require_between("confidence", confidence, 0.01, 0.9999)
        factor = np.asarray(f.ppf(confidence, 2, 2.0 * np.maximum(self.freedom, 1e-9)))
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
        """Return the input that is meant to move an output: theta_i for pitch, or the one it answers most."""
        i = self._entry(output, self.inputs[0])[0]
        named = [
            name for name in (("theta_i", "phi_i")[i] if i < 2 else "", f"towards_{output}") if name in self.inputs
        ]
        if named:
            return named[0]
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
        scale, per_input, unit = self.shown()
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
        from softneck.plots import frequency_response_figure

        output = self.outputs[0] if output is None else output
        source = self.own_input(output)
        i, a = self._entry(output, source)
        scale, _, unit = self.shown()
        return frequency_response_figure(
            self.frequency, scale * self.response[:, i, a], scale * np.nan_to_num(self.radius()[:, i, a]),
            self.coherence[:, i], f"{source} to {output}", unit=unit,
            models={name: scale * self._curve(model, name, output) for name, model in (models or {}).items()},
        )  # fmt: skip

    def _curve(self, model: Any, name: str, output: str) -> np.ndarray:
        """Return a model's response of `output` to the input that is meant for it [SI]."""
        if not hasattr(model, "tf"):
            raise DataError(f"{name}: only a linear model or a family has a response to draw.")
        if abs(model.sample_time - self.sample_time) > 1e-9 * self.sample_time:
            raise DataError(f"{name}: is at {model.sample_time:g} s and the recordings at {self.sample_time:g} s.")
        return np.squeeze(model.tf(output)(np.exp(1j * self.frequency * self.sample_time)))

    def as_dict(self) -> dict[str, Any]:
        """Return method, inputs and bands as plain values."""
        bands = {output: self.band(output, self.own_input(output)) for output in self.outputs}
        return {
            "method": self.method,
            "frequencies": int(self.frequency.size),
            "inputs": self.inputs,
            "own_inputs": {output: self.own_input(output) for output in self.outputs},
            f"amplitude_{to_si(self.robot.motors.unit)[1]}": self.amplitude.tolist(),
            "band_rad_s": {output: None if band is None else list(band) for output, band in bands.items()},
            "findings": self.findings,
        }

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write it to an `.npz` file."""
        arrays: dict[str, np.ndarray] = {name: np.asarray(getattr(self, name)) for name in _REAL}
        for name in _COMPLEX:
            arrays |= {f"{name}_re": getattr(self, name).real, f"{name}_im": getattr(self, name).imag}
        header = {
            "kind": "frf",
            "sample_time": self.sample_time,
            "robot": self.robot.as_dict(),
            "inputs": self.inputs,
            "method": self.method,
            "findings": self.findings,
        }
        write_archive(path, header, arrays, force=force)

    @classmethod
    def from_archive(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> FrequencyResponse:
        """Return what `save` wrote."""
        robot, inputs = Robot.from_dict(header["robot"]), tuple(str(name) for name in header["inputs"])
        k, m, q = arrays["frequency"].size, len(robot.outputs.names), len(inputs)
        shapes = {"frequency": (k,), "freedom": (k,), "coherence": (k, m), "noise": (k, m, q), "amplitude": (q,),
                  "response": (k, m, q), "covariance": (k, m * q, m * q)}  # fmt: skip
        for name, shape in shapes.items():
            for part in (name,) if name in _REAL else (f"{name}_re", f"{name}_im"):
                if arrays[part].shape != shape or arrays[part].dtype != np.float64:
                    raise FileFormatError(f"its array `{part}` has shape {arrays[part].shape}; {shape} is needed.")
        w = arrays["frequency"]
        if (
            k == 0
            or not np.isfinite(w).all()
            or w[0] <= 0.0
            or (np.diff(w) <= 0.0).any()
            or header["method"] not in METHODS
        ):
            raise FileFormatError("its frequencies must be positive and rise, and its method be one of ours.")
        values = {name: arrays[name] for name in _REAL}
        values |= {name: arrays[f"{name}_re"] + 1j * arrays[f"{name}_im"] for name in _COMPLEX}
        return cls(
            sample_time=float(header["sample_time"]), robot=robot, inputs=inputs, method=str(header["method"]),
            findings=dict(header["findings"]), **values,
        )  # fmt: skip

    def _entry(self, output: str, source: str) -> tuple[int, int]:
        for name, names in ((output, self.outputs), (source, self.inputs)):
            if name not in names:
                raise SettingsError(f"unknown channel `{name}`; use one of {', '.join(names)}.")
        return self.outputs.index(output), self.inputs.index(source)

    def shown(self) -> tuple[float, float, str]:
        """Return what a response and an input in SI are multiplied by for people, and the unit of the response."""
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


_REAL = ("frequency", "freedom", "coherence", "noise", "amplitude")
_COMPLEX = ("response", "covariance")
