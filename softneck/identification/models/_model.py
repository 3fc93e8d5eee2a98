"""The identified plant: one class for all kinds, as their runtimes share the form of `step`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from softneck.core import (
    KINDS,
    DataError,
    FileFormatError,
    Matrix,
    ReprMixin,
    SettingsError,
    Vector,
    finite_matrix,
    finite_vector,
    percent,
    require_one_of,
    require_whole,
    resolve,
    to_si,
    write_archive,
)
from softneck.robot import Robot
from softneck.runtime import Block, State
from softneck.signals import Labelled, Recording, RecordingLike, open_recording, require_same_robot

from . import _linear_systems as _linear
from ._arrays import (
    check_arrays,
    input_ports,
    members,
    memory_of,
    output_ports,
    parameter_ports,
    payloads,
    runtime_arrays,
    runtime_of,
    set_now,
)
from ._scores import r_squared

if TYPE_CHECKING:
    import casadi
    import control
    from matplotlib.figure import Figure

#: A simulation starts with this many measured samples, for every kind; they are not scored.
WARM_UP = 25
_MOTOR_SOURCES = ("simulated", "measured")
# A longer sample time, of a neck 10 s, is a mistake in the file.
_MAX_SAMPLE_TIME_CONSTANTS = 50.0
# Of bounds in simulation, which promise all samples only where their assumption holds.
_BOUND_PCT = 90
# Kinds without a symbolic form: they look their output up among the points of a set.
_SET_BASED_KINDS = ("nlsm",)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Model(ReprMixin):
    """A plant identified from recordings: motor set-points in, the outputs out (of a neck pitch and roll).

    Attributes:
        kind: name in the table of kinds.
        sample_time: [s].
        arrays: of the runtime, in its order.
        settings: of the estimator.
        findings: of the estimator: cost curves, noise, parameters.
        training_rows: hashes of the training rows (see `row_hashes`).
        robot: of the plant; the shapes below are a neck's, with 3 motors and 2 outputs.
    """

    kind: str
    sample_time: float
    arrays: Mapping[str, Matrix]
    settings: Mapping[str, Any] = field(default_factory=dict)
    findings: Mapping[str, Any] = field(default_factory=dict)
    training_rows: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.uint64))
    robot: Robot = field(default_factory=Robot.preset)

    def block(self) -> Block:
        """Return the model as a block, as the FMU builder and loops take it."""
        return Block(
            kind=self.kind,
            role="plant",
            runtime=runtime_of(self.kind, self.arrays),
            sample_time=self.sample_time,
            arrays=tuple(runtime_arrays(self.kind, self.arrays).values()),
            inputs=input_ports(self.findings, self.robot),
            outputs=output_ports(self.kind, self.robot, self.findings),
            parameters=parameter_ports(self.robot, self.arrays),
        )

    def initial_state(self, recording: Recording | None = None, **parameters: float) -> State:
        """Return the state at t_0: at rest, or at rest in the first row of `recording`.

        Args:
            recording: its first outputs and motor positions are those at rest, and its payload is taken.
            **parameters: start values by name (`pitch_start`, `roll_start` [rad], ...), without a recording.
        """
        block = self.block()
        if recording is None:
            return block.initial_state(**{"use_measurement": 1.0, **parameters})
        if parameters:
            raise SettingsError("`initial_state` takes a recording or start values, not both.")
        require_same_robot(recording.robot, self.robot, "a model and a recording")
        y0 = np.nan_to_num(recording.outputs[0])
        logged = recording.motor_positions[0]
        m0 = np.where(np.isfinite(logged), logged, recording.set_points[0])
        given = {f"{name}_start": float(y) for name, y in zip(self.robot.outputs.names, y0, strict=True)}
        if any(port.name == "payload" for port in block.parameters):
            given["payload"] = float(recording.channels["payload"][0]) if "payload" in recording.channels else 0.0
        start = block.initial_state(use_measurement=1.0, **given)
        at_rest = np.tile(np.concatenate([m0, y0, m0]), (memory_of(self.arrays), 1))
        state, _ = block.run(start, at_rest)
        outputs = start.outputs.copy()
        outputs[y0.size : y0.size + m0.size] = m0
        # The last `step` moved the present outputs; set them back to the first row.
        values = state.values.copy()
        set_now(self.kind, self.arrays, values, m0, y0)
        # The validity is that of motors at rest at m0.
        outputs[-1] = block.run(State(values, state.parameters, outputs), at_rest[:1])[1][0, -1]
        return State(values, state.parameters, outputs)

    def step(self, state: State, inputs: ArrayLike, *, measured: ArrayLike | None = None) -> tuple[State, Vector]:
        """Hold the set-points over [t_k, t_k+1); return the state and the outputs at t_k+1.

        Args:
            state: at t_k.
            inputs: (3,) motor set-points [rad].
            measured: the outputs, or those and the motor positions, measured at t_k [rad]; NaN where not.

        Returns:
            The next state and (pitch, roll, three motor positions, bounds for set membership) [rad], and validity last.

        Raises:
            DataError: wrong sizes or set-points that are not finite.
        """
        motors, outputs = self._sizes
        u = np.full(2 * motors + outputs, np.nan)
        u[:motors] = finite_vector("inputs", inputs, motors)
        if measured is not None:
            values = np.asarray(measured, dtype=np.float64).ravel()
            if values.size not in (outputs, outputs + motors):
                raise DataError(
                    f"`measured` must have {outputs} or {outputs + motors} entries "
                    f"({', '.join(self.robot.outputs.names)}, motors); got {values.size}."
                )
            u[motors : motors + values.size] = values
        return self.block().step(state, u)

    def jacobian(self, state: State, inputs: ArrayLike) -> _linear.Jacobian:
        """Return the derivatives A (n, n), B (n, 3), C (n_out, n), D (n_out, 3) of `step(state, inputs)`.

        They are exact, from the source of the step. States are in the order of `state.values`, outputs in that of
        `step`. At a kink it is the derivative to the right.

        Args:
            state: at t_k.
            inputs: (3,) motor set-points [rad].

        Raises:
            SettingsError: a kind without derivative.
        """
        return _linear.jacobian(self, state, inputs)

    def linearize(self, at: State | Mapping[str, float] | ArrayLike | None = None) -> control.StateSpace:
        """Linearize the model at a state, from the motors' set-points to the outputs.

        States that no input reaches or that reach no output are removed. The system has `dt` and the signals' names.

        Args:
            at: the state, with set-points at its motor positions; or set-points [rad], (3,) or by name
                (`motor_setpoint_1`, ..), under which the model is simulated to rest; None for zero.

        Raises:
            SettingsError: a kind without derivative, or a model that does not come to rest.
        """
        return _linear.linearize(self, at)

    def simulate(self, recording: RecordingLike, *, motors: str = "simulated", warm_up: int = WARM_UP) -> Labelled:
        """Simulate the outputs (time, n_out) [rad] from set-points alone (free run); row 0 is the start.

        The result is an array with named channels: `["pitch"]`, `.to_pandas()`, `.to_xarray()`, `.plot()`.

        Args:
            recording: a recording or its source (see `identify`), or set-points alone (time, motors) in SI, from rest.
            motors: "measured" feeds logged motor positions throughout, as the paper does.
            warm_up: samples at the start of each run that are fed with measured outputs.
        """
        recording = self._open(recording)
        require_one_of("motors", motors, _MOTOR_SOURCES)
        parts: list[Matrix] = []
        for run in recording.runs():
            start, rows = self.initial_state(run), _input_rows(run, motors, outputs=False)
            rows[:warm_up] = _input_rows(run, "measured")[:warm_up]
            parts.append(np.vstack([start.outputs, self.block().run(start, rows)[1][:-1]]))
        return self._label(recording, parts)

    def predict(self, recording: RecordingLike, horizon: int = 1, *, motors: str = "simulated") -> Labelled:
        """Return the outputs (time, n_out) [rad] predicted `horizon` samples ahead from measured ones.

        The result has named channels, as that of `simulate`. The first rows of each run, which have no such past, are
        predicted from its first row.
        """
        recording = self._open(recording)
        require_one_of("motors", motors, _MOTOR_SOURCES)
        require_whole("horizon", horizon, 1, 1_000_000)
        parts: list[Matrix] = []
        for run in recording.runs():
            start = self.initial_state(run)
            rows = _input_rows(run, "measured")
            if horizon == 1:
                _, predicted = self.block().run(start, rows)
            else:
                free = _input_rows(run, motors, outputs=False)
                predicted = self.block().run_horizon(start, rows, free, horizon)
            parts.append(np.vstack([start.outputs, predicted[:-1]]))
        return self._label(recording, parts)

    def score(self, recording: RecordingLike) -> float:
        """Return R2 of the simulation, the mean over the outputs, as scikit-learn's `score` does.

        1 is perfect, 0 is as good as the mean. Of the paper's fit in % it is `1 - (1 - fit/100)^2`. All rows after the
        warm-up of each run count; `softneck.validate` leaves out training rows.
        """
        recording = self._open(recording)
        judged = np.concatenate([np.arange(len(run)) >= WARM_UP for run in recording.runs()])
        Y, free = recording.outputs[judged], np.asarray(self.simulate(recording))[judged]
        return float(np.mean([r_squared(y, free[:, k]) for k, y in enumerate(Y.T)]))

    def plot(self, recording: RecordingLike, title: str = "") -> Figure:
        """Return a matplotlib figure of the measured outputs and the simulation, each with its error below."""
        recording = self._open(recording)
        free = np.asarray(self.simulate(recording))[:, : self._sizes[1]]
        draw = resolve("softneck.plots:validation_figure")
        return draw(
            recording.time, recording.outputs, {"simulation": free}, title, run=recording.run, robot=recording.robot
        )

    def _open(self, recording: RecordingLike) -> Recording:
        """Open and check a recording; an array of set-points gets this model's robot and sample time."""
        if isinstance(recording, np.ndarray):
            U = finite_matrix("set_points", recording, self._sizes[0])
            recording = Recording.from_arrays(U, sample_time=self.sample_time, robot=self.robot)
        else:
            recording = open_recording(recording)
        self.check(recording)
        return recording

    def _label(self, recording: Recording, parts: Sequence[Matrix]) -> Labelled:
        return Labelled(np.concatenate(parts), recording.time, {port.name: port.unit for port in self.block().outputs})

    def adapt(self, recording: Recording, *, window: float | None = None) -> Model:
        """Refit the model to the latest data, regularized towards its present parameters.

        Every third block of ten time constants is held out. Where an output is worse there, this model is kept.
        `findings["adaptation"]` describes the result.

        Args:
            recording: its last `window` [s] is used; by default 150 time constants, of a neck 30 s.

        Raises:
            SettingsError: a kind that cannot adapt.
        """
        # Resolved by name, as `adaptation` imports this module.
        return resolve("softneck.identification._adapt:Adaptation")(window=window).of(self, recording)

    def tf(
        self,
        output: str,
        *,
        angle_unit: str = "rad",
        input: str | None = None,
        continuous: bool = False,
        pade: int = 3,
    ) -> control.TransferFunction:
        """Return a transfer function to `output` (linear kinds); in discrete time its dead time is exact.

        Args:
            output: its name, of a neck "pitch" or "roll".
            angle_unit: of the output in SI, "rad" or "deg".
            input: a redefined input ("theta_i", "phi_i", "delta_i"; "flexion_input", "cocontraction") or a motor's
                set-point, with the others constant; None takes the redefined input of `output` (Eq. 9, 10).
            continuous: return the continuous-time form, with a Pade approximation of the dead time.
            pade: its order; 0 leaves the dead time out.
        """
        if continuous:
            return _linear.continuous_function(self, output, input, angle_unit, pade)
        return _linear.transfer_function(self, output, input, angle_unit)

    def ss(self) -> control.StateSpace:
        """Return the state space to the outputs in SI, from the redefined inputs or the motors as the kind has them."""
        return _linear.state_space(self)

    def casadi(self) -> casadi.Function:
        """Return one step of the simulation as a CasADi function, (x, u) -> (x_next, y), from the runtime's source.

        x is `State.values`, u (3,) the set-points [rad], y the outputs one sample later. Derivatives at kinks are
        one-sided.

        Raises:
            SettingsError: a kind that searches a set (`nlsm`, or `guarded` over it).
        """
        from softneck.runtime import step_function

        for kind in (self.kind, *(kind for kind, _ in members(self.arrays))):
            if kind in _SET_BASED_KINDS:
                raise SettingsError(f"a model of kind `{kind}` searches its set; it cannot become a CasADi function.")
        start = self.block().initial_state(use_measurement=0.0, noise_std=0.0)
        return step_function(self.block(), start.parameters, inputs=self._sizes[0])

    def summary(self) -> str:
        """Return a few lines on the model, in degrees."""
        lines = [f"{self.kind}: {KINDS[self.kind].summary}"]
        lines += _examined_lines(self.findings.get("examination", {}), self.robot.outputs.display_unit)
        lines.append(f"sample time {1e3 * self.sample_time:g} ms")
        if self.robot.in_header():
            outputs = ", ".join(self.robot.outputs.names)
            lines.append(f"robot {self.robot.label()}: {len(self.robot.motors.names)} motor(s), outputs {outputs}")
        known = payloads(self.arrays)
        if known is not None:
            lines.append(f"parameter `payload`: the recordings had {known[0]:g} to {known[1]:g} kg")
        if self.kind in _linear.KINDS:
            lines += _linear.describe(self)
        lines += [
            f"{key}: {_short_text(value)}"
            for key, value in self.findings.items()
            if isinstance(value, int | float | str) or (isinstance(value, list) and len(value) <= 4)
        ]
        if not self.arrays.get("ground", np.zeros(0)).size:
            lines.append("no validity in this file: identify it again")
        if self.kind == "nn":
            lines.append(
                "a guarded form exists (`softneck identify guarded`): it falls back where this one can be far off"
            )
        lines.append(f"trained on {self.training_rows.size} rows")
        lines += _held_out_lines(self.findings.get("hold_out", {}), self.robot.outputs.names)
        return "\n".join(lines)

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the model to an `.npz` file.

        Raises:
            OutputError: the file exists (and not `force`) or cannot be written.
        """
        channels = {"inputs": list(self.robot.set_points), "unit": to_si(self.robot.motors.unit)[1]}
        header = {**self._header(), "channels": channels}
        write_archive(path, header, {**self.arrays, "training_rows": self.training_rows}, force=force)

    def _header(self) -> dict[str, Any]:
        header = {"kind": self.kind, "sample_time": self.sample_time, "arrays": list(self.arrays)}
        return {**header, "settings": dict(self.settings), "findings": dict(self.findings), **self.robot.in_header()}

    @classmethod
    def from_archive(cls, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Model:
        """Return the model that `save` wrote."""
        model = cls(
            kind=header["kind"],
            sample_time=float(header["sample_time"]),
            arrays={name: arrays[name] for name in header["arrays"]},
            settings=header["settings"],
            findings=header["findings"],
            training_rows=arrays["training_rows"],
            robot=Robot.from_dict(header["robot"]) if "robot" in header else Robot.preset("neck"),
        )
        check_arrays(model.kind, model.arrays)
        if not 0.0 < model.sample_time < _MAX_SAMPLE_TIME_CONSTANTS * (model.robot.time_constant_s or np.inf):
            raise FileFormatError(f"a sample time of {model.sample_time} s is implausible for {model.robot.name}.")
        if not isinstance(model.settings, dict) or not isinstance(model.findings, dict):
            raise FileFormatError("its settings and findings must be tables.")
        try:
            input_ports(model.findings, model.robot)
            output_ports(model.kind, model.robot, model.findings)
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(
                "its ranges of set-points and outputs must be a minimum and a maximum for each motor and output."
            ) from error
        if model.training_rows.dtype != np.uint64 or model.training_rows.ndim != 1:
            raise FileFormatError("its training rows are not hashes.")
        return model

    @property
    def _sizes(self) -> tuple[int, int]:
        """The numbers of motors and outputs."""
        return len(self.robot.motors.names), len(self.robot.outputs.names)

    def check(self, recording: Recording) -> None:
        """Raise DataError for a recording of another robot or sample time, or with fewer than 2 rows."""
        if not isinstance(recording, Recording):
            raise DataError(f"a recording is needed; got a {type(recording).__name__}.")
        require_same_robot(recording.robot, self.robot, "a model and a recording")
        if not np.isclose(recording.sample_time, self.sample_time, rtol=1e-3):
            raise DataError(
                f"the model was identified at {self.sample_time:g} s and the recording is at "
                f"{recording.sample_time:g} s; resample it (`softneck import --resample`) or identify again."
            )
        if len(recording) < 2:
            raise DataError(f"a run needs at least 2 rows; got {len(recording)}.")


def _input_rows(run: Recording, source: str, *, outputs: bool = True) -> Matrix:
    """Return the block's inputs (time, n_in), NaN for positions that are not `source` "measured"."""
    U, Y = run.set_points, run.outputs
    motors, both = U.shape[1], U.shape[1] + Y.shape[1]
    rows = np.full((len(run), both + motors), np.nan)
    rows[:, :motors] = U
    rows[:, motors:both] = Y if outputs else np.nan
    if source == "measured" and run.has_motor_positions:
        rows[:, both:] = run.motor_positions
    return rows


def _examined_lines(found: Mapping[str, Any], unit: str) -> list[str]:
    """Return the line of a summary on the examination: the fit to be expected, and the worst one."""
    if not found:
        return []
    worst = f"{percent(found['fit'])} % at its worst ({found['part']}, {found['output']})"
    lacks = f": one motion is too little to say more; {found['record']}" if found.get("record") else ""
    if found["low"] is None:
        return [f"simulation fit {worst}{lacks}"]
    expected = (
        f"simulation fit on other motions {found['expected']:.0f} % ({found['low']:.0f} to {found['high']:.0f} %)"
    )
    lines = [f"{expected}, {worst}{lacks}"]
    if bounds := found.get("bounds"):
        least, wide = min(bounds["held_pct"].values()), max(bounds["width"].values())
        kept = "held" if least >= _BOUND_PCT else f"are no {_BOUND_PCT} % bounds: they held"
        lines.append(f"bounds in simulation {kept} {least:.0f} % of motions left out, mean width {wide:.3g} {unit}")
    return lines


def _held_out_lines(found: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the lines of a summary on the hold-out."""
    if not found:
        return []
    tables = {"persistence": "persistence", "one_step": "one step", "fit": "simulation"}
    lines = [f"hold-out of {found.get('rows', '-')} rows, fit [%] {'/'.join(names)}:"]
    for key, what in tables.items():
        if table := found.get(key):
            lines.append(f"  {what:11} {'/'.join(map(percent, table.values()))}")
    return lines


def _short_text(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_short_text, value))
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def embed_model(model: Model) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the renamed arrays of a model that is part of a controller's or observer's file."""
    arrays = {f"model_{name}": array for name, array in model.arrays.items()}
    return model._header(), {**arrays, "model_training_rows": model.training_rows}


def embedded_model(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Model:
    """Return the model that `embed_model` put into a file with this header."""
    names = [*header["arrays"], "training_rows"]
    return Model.from_archive(dict(header), {name: arrays[f"model_{name}"] for name in names})
