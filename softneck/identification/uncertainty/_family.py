"""The family of linear models over inclination, direction and payload, as an uncertain plant for design."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    ReprMixin,
    SettingsError,
    Vector,
    require_one_of,
    to_si,
    write_archive,
)
from softneck.robot import Robot
from softneck.signals import Recording, require_same_robot

from ..linear._srivc_fit import Continuous
from ..models._directions import Directions
from ._draws import Draws
from ._frf_fit import SUPPORTED
from ._measured import (
    AxisMeasured,
    axis_points,
    axis_runs,
    judge_records,
    measured_responses,
    needed_lines,
    response_of,
)

if TYPE_CHECKING:
    import control


SCOPES = ("window", "point", "recording")
# Arrays of the draws in a file begin with this.
_DRAWS = "draws."


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisFamily:
    """The uncertainty of one axis.

    samples: (n, 3) static gain [rad/rad], pole [1/s], dead time [s] of every local model; std: (n, 4) of those, and of
    K; where: (n, 5) scope (0 window, 1 point, 2 recording), recording, time [s], inclination, direction [rad]; used:
    (n,) 1 where the sample is in the uncertain plant; nominal: (3,) middle of the box (2, 3), its dead time in whole
    samples; weight: (2, order + 1) numerator and denominator of W(s), `|G/G0 - 1| <= |W|` for every sample used;
    envelope: (m,) largest relative error of those at the family's frequencies.
    """

    samples: Matrix
    std: Matrix
    where: Matrix
    used: Vector
    nominal: Vector
    box: Matrix
    weight: Matrix
    envelope: Vector


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Family(ReprMixin):
    """An uncertain linear plant; `FamilySettings.fit` makes it and a design reads it.

    Attributes:
        sample_time: [s].
        axes: by the names of the outputs, pitch and roll.
        frequency: (m,) at which the weight was fitted [rad/s], up to the Nyquist frequency.
        cross: (2, 3) static gains from theta_i, phi_i, delta_i to pitch and roll [rad/rad]; NaN where not excited. Of
            another robot (outputs, outputs), from the input of each output.
        cross_std: as `cross`.
        compression: (3,) static gain [m/rad], pole [1/s], dead time [s] of G_delta; NaN where not recorded.
        settings, findings: what was asked and what was found.
        robot: whose plant it is; its outputs and motors in their SI units where a neck's are in rad.
        directions: (outputs, motors) weights of the motors in each axis's input; None: those that the robot gives.
        measured: by the names of the outputs, what the recordings themselves show of it; empty in files of before.
        draws: nonlinear models of the same recordings, by which `verify` decides; None if none were made.
    """

    sample_time: float
    axes: dict[str, AxisFamily]
    frequency: Vector
    cross: Matrix
    cross_std: Matrix
    compression: Vector
    settings: dict[str, Any] = field(default_factory=dict)
    findings: dict[str, Any] = field(default_factory=dict)
    robot: Robot = field(default_factory=Robot.preset)
    directions: Matrix | None = None
    measured: dict[str, AxisMeasured] = field(default_factory=dict)
    draws: Draws | None = None

    def __post_init__(self) -> None:
        if self.directions is None:
            object.__setattr__(self, "directions", self.robot.weights())

    def nominal(self, output: str) -> Continuous:
        """Return the nominal plant of an axis, `K exp(-L s)/(s + p)`."""
        return one_pole(self._axis(output).nominal)

    def tf(self, output: str, *, continuous: bool = False, pade: int = 3) -> control.TransferFunction:
        """Return the nominal transfer function: sampled with its dead time in full, or continuous with a Pade one."""
        return self._system(self.nominal(output), output, continuous, pade)

    def samples(self, output: str) -> list[control.TransferFunction]:
        """Return every sample of the uncertain plant, sampled as `tf` is."""
        axis = self._axis(output)
        return [self._system(one_pole(row), output, False, 0) for row in axis.samples[axis.used > 0.5]]

    def weight(self, output: str) -> control.TransferFunction:
        """Return W(s), stable and of minimum phase."""
        import control

        above, below = self._axis(output).weight
        return control.TransferFunction(np.trim_zeros(above, "f"), np.trim_zeros(below, "f"), name=f"W_{output}")

    def errors(self, output: str) -> Matrix:
        """Return `|G/G0 - 1|` (n, m) of the samples used, at the family's frequencies."""
        axis = self._axis(output)
        return relative_errors(axis.samples[axis.used > 0.5], axis.nominal, self.frequency, self.sample_time)

    def covered(self, output: str) -> float:
        """Return the largest `|G/G0 - 1| / |W|` over all samples used and a dense grid; at most 1."""
        axis = self._axis(output)
        w = np.geomspace(self.frequency[0], self.frequency[-1], 5 * self.frequency.size)
        W = np.abs(np.polyval(axis.weight[0], 1j * w) / np.polyval(axis.weight[1], 1j * w))
        errors = relative_errors(axis.samples[axis.used > 0.5], axis.nominal, w, self.sample_time)
        return float(np.max(errors / W))

    def band(self, output: str) -> tuple[float, float] | None:
        """Return the lowest and highest frequency that the data support [rad/s]; None if untested."""
        self._axis(output)
        found = self.measured.get(output)
        return None if found is None else found.band

    def invalidated_by(
        self, recordings: Sequence[Recording], names: Sequence[str]
    ) -> tuple[list[str], dict[str, Matrix]]:
        """Return where whole recordings need more than the weight, in words, and of each axis how many times it.

        Args:
            recordings: of the same robot and sample time, others than those that the family was fitted to.
            names: of each.

        Returns:
            a line for each axis and recording; (recordings, bands) of each axis, NaN where a recording does not
            excite the band. What is 1 or less does not invalidate the family, and is not thereby explained by it.

        Raises:
            DataError: another robot or sample time, or a family that was not tested against data.
        """
        if not self.measured:
            raise DataError(
                "the family was not tested against data, so it has no weight to compare with; fit it again."
            )
        for part in recordings:
            require_same_robot(part.robot, self.robot, "family and recordings")
            if abs(part.sample_time - self.sample_time) > 1e-6 * self.sample_time:
                raise DataError(f"the family is at {self.sample_time:g} s, a recording at {part.sample_time:g} s.")
        source = str(self.settings.get("source", "set_points"))
        weights = np.asarray(self.directions)
        directions = Directions(self.robot.outputs.names, weights, np.ones(len(weights)), learned=False)
        responses, why = measured_responses(recordings, source)
        lines, table = list(why), {}
        for axis, name in enumerate(self.axes):
            if name in self.measured:
                points = axis_points(responses, axis, directions, float(self.findings["tested"]["confidence"]))
                runs = axis_runs(recordings, directions, source, axis)
                judged = judge_records(runs, self.measured[name], points, self.sample_time)
                table[name] = judged
                lines += needed_lines(replace(self.measured[name], needed=judged), names, name)
        return lines, table

    def summary(self) -> str:
        """Return a few lines, in the units in which people see outputs and motors."""
        robot = self.robot
        shown, per = robot.outputs.display_unit, robot.motors.unit
        factor, unit = robot.shown_gain
        lines = [
            f"family of {self.findings.get('recordings', 0)} recordings of robot {robot.label()}, "
            f"{1e3 * self.sample_time:g} ms"
        ]
        for name, axis in self.axes.items():
            counts = [int(np.sum(axis.where[:, 0] == scope)) for scope in range(3)]
            low, high = axis.box
            gain, pole, delay = axis.nominal
            lines.append(
                f"{name}: G(s) = exp(-{delay:.4g} s) {factor * gain * pole:.4g}/(s + {pole:.4g}) {unit}; "
                f"gain {factor * low[0]:.4g} to {factor * high[0]:.4g} {unit}, "
                f"pole {low[1]:.4g} to {high[1]:.4g} 1/s, dead time {1e3 * low[2]:.4g} to {1e3 * high[2]:.4g} ms"
            )
            lines.append(
                f"  {counts[0]} windows, {counts[1]} operating points, {counts[2]} recordings; "
                f"{int(axis.used.sum())} samples in the plant, |G/G0 - 1| at most {axis.envelope.max():.2f}, "
                f"by the weight covered to {self.covered(name):.3f}"
            )
        lines.append(f"neglected cross gains [{unit}]: {self._cross_gains(factor)}")
        if np.isfinite(self.compression).all():
            K, p, L = self.compression
            K *= 1e3 * to_si(per)[0]
            lines.append(f"compression: G_delta(s) = exp(-{L:.3f} s) {K * p:.4g}/(s + {p:.4g}) mm/{per}")
        lines += self._measured_lines()
        lines += [] if self.draws is None else self.draws.summary(1.0 / to_si(shown)[0], shown)
        lines += [f"caution: {self.findings['caution']}"] if "caution" in self.findings else []
        return "\n".join(lines)

    def _cross_gains(self, factor: float) -> str:
        """Return the gains from each input to the outputs that it is not meant for."""
        names = (*self.robot.input_names, self.robot.cocontraction_name)
        parts = []
        for i, output in enumerate(self.axes):
            for j, value in enumerate(self.cross[i]):
                if j != i:
                    text = f"{factor * value:+.2g}" if np.isfinite(value) else "not excited"
                    parts.append(f"{names[j]} to {output} {text}")
        return ", ".join(parts) or "none"

    def _measured_lines(self) -> list[str]:
        """Return the lines on the measured responses, or the reason for their absence."""
        told = self.findings.get("tested", {})
        lines = []
        for name in self.axes:
            found = self.measured.get(name)
            if found is None:
                lines.append(f"{name}: not tested against data{''.join(f'; {why}' for why in told.get('why', [])[:1])}")
                continue
            low, high = found.band
            poles = ", ".join(f"{-root.real:.3g}" for root in np.roots(np.concatenate([[1.0], found.model.a])))
            lines.append(
                f"{name}: the data excite {low:.2g} to {high:.2g} rad/s; there every response measured is within the "
                f"weight (at most {found.weight.max():.2g}) of poles at {poles} 1/s behind "
                f"{1e3 * found.model.delay:.0f} ms, each circle with {100 * told.get('confidence', 0.95):.3g} % "
                "confidence; nothing is known above"
            )
            lines += needed_lines(found, told.get("names", []), name)
            lines += [
                f"{name}: {part} moves it and shows no response known within {100 * SUPPORTED:.0f} %: nothing is known "
                "of what it holds"
                for part in told.get("unheard", {}).get(name, [])
            ]
        return lines

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the family to an `.npz` file."""
        arrays: dict[str, np.ndarray] = {
            "frequency": self.frequency,
            "cross": self.cross,
            "cross_std": self.cross_std,
            "compression": self.compression,
        }
        for name, axis in self.axes.items():
            arrays |= {f"{name}_{key}": getattr(axis, key) for key in AxisFamily.__dataclass_fields__}
        header = {
            "kind": "family",
            "sample_time": self.sample_time,
            "settings": self.settings,
            "findings": self.findings,
            "lpv_source": None,  # format 1 names an interpolation over the inclination here; there is none any more
            **self.robot.in_header(),
        }
        weights, own = self.directions, self.robot.weights()
        if weights is not None and (own is None or not np.array_equal(weights, own)):
            arrays["directions"] = weights
        for name, found in self.measured.items():
            arrays |= {f"{name}_measured_{key}": value for key, value in found.arrays().items()}
        if self.draws is not None:
            header["draws"], more = self.draws.to_archive()
            arrays |= {f"{_DRAWS}{name}": value for name, value in more.items()}
        write_archive(path, header, arrays, force=force)

    @classmethod
    def from_archive(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Family:
        """Return the family that `save` wrote."""
        drawn = {name.removeprefix(_DRAWS): array for name, array in arrays.items() if name.startswith(_DRAWS)}
        arrays = {name: array for name, array in arrays.items() if not name.startswith(_DRAWS)}
        for name, array in arrays.items():
            if array.dtype != np.float64:
                raise FileFormatError(f"its array `{name}` is not of floats.")
        robot = Robot.from_dict(header["robot"]) if "robot" in header else Robot.preset("neck")
        axes = {
            name: AxisFamily(**{key: arrays[f"{name}_{key}"] for key in AxisFamily.__dataclass_fields__})
            for name in robot.outputs.names
        }
        for name, axis in axes.items():
            _check(name, axis, arrays["frequency"].size)
        _check_cross_gains(arrays, len(axes))
        weights = arrays.get("directions", robot.weights())
        if weights is None or weights.shape != (len(axes), len(robot.motors.names)):
            raise FileFormatError("its array `directions` is not of outputs x motors.")
        measured = {}
        for name in robot.outputs.names:
            own = f"{name}_measured_"
            parts = {key.removeprefix(own): value for key, value in arrays.items() if key.startswith(own)}
            if parts:
                names = header["findings"].get("tested", {}).get("names", [])
                measured[name] = AxisMeasured.from_arrays(parts, len(names))
        return cls(
            sample_time=float(header["sample_time"]),
            axes=axes,
            frequency=arrays["frequency"],
            cross=arrays["cross"],
            cross_std=arrays["cross_std"],
            compression=arrays["compression"],
            settings=header["settings"],
            findings=header["findings"],
            robot=robot,
            directions=weights,
            measured=measured,
            draws=Draws.from_archive(header["draws"], drawn) if "draws" in header else None,
        )

    def _axis(self, output: str) -> AxisFamily:
        require_one_of("output", output, tuple(self.axes))
        return self.axes[output]

    def _system(self, model: Continuous, output: str, continuous: bool, pade: int) -> control.TransferFunction:
        import control

        names = {"inputs": [self.robot.input_names[self.robot.outputs.names.index(output)]], "outputs": [output]}
        if continuous:
            if not 0 <= pade <= 12:
                raise SettingsError(f"`pade` must be between 0 and 12; got {pade}.")
            G = control.TransferFunction(model.b, np.concatenate([[1.0], model.a]))
            if pade > 0 and model.delay > 0.0:
                G = G * control.TransferFunction(*control.pade(model.delay, pade))
            return control.TransferFunction(G.num, G.den, **names)
        a, b, d = model.discretize(self.sample_time)
        b = b if b[-1] != 0.0 else b[:-1]
        below = np.concatenate([[1.0], a, np.zeros(d + b.size - a.size)])
        return control.TransferFunction(b, below, self.sample_time, **names)


def one_pole(numbers: Vector) -> Continuous:
    """Return the model of static gain [rad/rad], pole [1/s] and dead time [s]."""
    gain, pole, delay = (float(value) for value in numbers)
    return Continuous(a=np.array([pole]), b=np.array([gain * pole]), delay=delay)


def relative_errors(samples: Matrix, nominal: Vector, frequency: Vector, sample_time: float) -> Matrix:
    """Return `|G/G0 - 1|` (n, m) of all samples at `frequency` [rad/s], inputs held between samples."""
    G0 = response_of(one_pole(nominal), frequency, sample_time)
    return np.array([np.abs(response_of(one_pole(row), frequency, sample_time) / G0 - 1.0) for row in samples])


def _check_cross_gains(arrays: Mapping[str, np.ndarray], outputs: int) -> None:
    """Raise FileFormatError for cross gains of other inputs than each output's own, and maybe the co-contraction."""
    inputs = min(max(arrays["cross"].shape[-1], outputs), outputs + 1)
    for name, shape in (("cross", (outputs, inputs)), ("cross_std", (outputs, inputs)), ("compression", (3,))):
        if arrays[name].shape != shape:
            raise FileFormatError(f"its array `{name}` has shape {arrays[name].shape}; {shape} is needed.")


def _check(name: str, axis: AxisFamily, frequencies: int) -> None:
    n = axis.samples.shape[0]
    shapes = {
        "samples": (n, 3), "std": (n, 4), "where": (n, 5), "used": (n,), "nominal": (3,), "box": (2, 3),
        "weight": (2, min(max(axis.weight.shape[-1], 1), 4)), "envelope": (frequencies,),
    }  # fmt: skip
    for key, shape in shapes.items():
        if getattr(axis, key).shape != shape:
            raise FileFormatError(f"its array `{name}_{key}` has shape {getattr(axis, key).shape}; {shape} is needed.")
    for key in ("samples", "used", "nominal", "box", "weight", "envelope"):
        if not np.isfinite(getattr(axis, key)).all():
            raise FileFormatError(f"its array `{name}_{key}` is not finite.")
    for key in ("samples", "nominal", "box"):
        table = np.atleast_2d(getattr(axis, key))
        if (table[:, 1] <= 0.0).any() or (table[:, 2] < 0.0).any():
            raise FileFormatError(f"its array `{name}_{key}` is not of poles above and dead times from zero.")
