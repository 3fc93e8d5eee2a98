"""The identified plant: one class for all kinds, as their runtimes share one `step` form."""

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
from softneck.core import load as load_file
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


#: A free run starts from this many measured samples, for every kind; they are not scored.
WARM_UP = 25
_MOTORS = ("simulated", "measured")
# A sample time of so many time constants is a slip: a neck's 10 s.
_LONGEST_SAMPLE = 50.0
# Kinds whose next output is looked up among the points of a set: which of them decide depends on the state.
_SEARCHING = ("nlsm",)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Model(ReprMixin):
    """A plant identified from recordings: motor set-points in, the outputs out (of a neck pitch and roll).

    Attributes:
        kind: name in the table of kinds.
        sample_time: [s].
        arrays: what the runtime reads, in its order.
        settings: what the estimator was asked for.
        findings: what it found: cost curves, noise, parameters.
        training_rows: hashes of the rows it was trained on (see `row_hashes`).
        robot: whose plant it is; the shapes below are a neck's, with 3 motors and 2 outputs.
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
            outputs=output_ports(self.kind, self.robot),
            parameters=parameter_ports(self.robot, self.arrays),
        )

    def initial_state(self, recording: Recording | None = None, **parameters: float) -> State:
        """Return the state at t_0: at rest, or as if the neck had stood at the first row of `recording`.

        Args:
            recording: whose first pitch, roll and motor positions the neck had held before, and whose payload it bears.
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
        start = block.initial_state(use_measurement=1.0, **self._starts(y0), **_payload_of(recording, block))
        held = np.tile(np.concatenate([m0, y0, m0]), (memory_of(self.arrays), 1))
        state, _ = block.run(start, held)
        outputs = start.outputs.copy()
        outputs[y0.size : y0.size + m0.size] = m0
        # The last `step` moved the outputs of now; set them back to what the first row says.
        values = state.values.copy()
        set_now(self.kind, self.arrays, values, m0, y0)
        # Of motors that are held at m0, as the start takes them to be.
        outputs[-1] = block.run(State(values, state.parameters, outputs), held[:1])[1][0, -1]
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

        They are exact, from the text of the step itself. Rows and columns of the state are in the order of
        `state.values`, those of the outputs in that of `step`. At a kink the derivative to the right counts.

        Args:
            state: at t_k.
            inputs: (3,) motor set-points [rad].

        Raises:
            SettingsError: a kind without derivative.
        """
        return _linear.jacobian(self, state, inputs)

    def linearize(
        self, at: State | Mapping[str, float] | ArrayLike | None = None, *, units: str = "SI"
    ) -> control.StateSpace:
        """Return the linear system from the motors' set-points to the outputs that the model is near a state.

        States that no input moves, or that no output shows, are left out. It has `dt` and the signals' names.

        Args:
            at: the state, whose motors are told to stay where they are; or set-points [rad], (3,) or by name
                (`motor_setpoint_1`, ..), under which the model has come to rest; None for zero.
            units: as of `ss`.

        Raises:
            SettingsError: a kind without derivative, or a model that does not come to rest.
        """
        return _linear.linearize(self, at, units)

    def simulate(self, recording: RecordingLike, *, motors: str = "simulated", warm_up: int = WARM_UP) -> Labelled:
        """Free run: return the outputs (time, n_out) [rad] from set-points alone; row 0 is the start.

        The result is an array that knows its channels: `["pitch"]`, `.to_pandas()`, `.to_xarray()`, `.plot()`.

        Args:
            recording: whose set-points drive the model, or what stands for one (see `identify`), or set-points alone
                (time, motors) in SI, from rest; its first `warm_up` samples align each run.
            motors: "measured" feeds logged motor positions throughout, as the paper does.
            warm_up: samples at the start of each run in which the measured outputs are fed.
        """
        recording = self._opened(recording)
        require_one_of("motors", motors, _MOTORS)
        return self._labelled(recording, [self._free_run(run, motors, warm_up) for run in recording.runs()])

    def predict(self, recording: RecordingLike, horizon: int = 1, *, motors: str = "simulated") -> Labelled:
        """Return the outputs (time, n_out) [rad] predicted `horizon` samples ahead from measured ones.

        The result is labelled as that of `simulate`.

        The first rows of each run, with no such past, are predicted from its first row.
        """
        recording = self._opened(recording)
        require_one_of("motors", motors, _MOTORS)
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
        return self._labelled(recording, parts)

    def score(self, recording: RecordingLike) -> float:
        """Return R2 of the simulation, the mean over the outputs, as scikit-learn's `score` does.

        1 is perfect, 0 is as good as the mean, below it is worse. Of the paper's fit in % it is `1 - (1 - fit/100)^2`.
        All rows count but those that align each run; `softneck.validate` leaves out rows that were trained on.
        """
        recording = self._opened(recording)
        judged = np.concatenate([np.arange(len(run)) >= WARM_UP for run in recording.runs()])
        Y, free = recording.outputs[judged], np.asarray(self.simulate(recording))[judged]
        return float(np.mean([r_squared(y, free[:, k]) for k, y in enumerate(Y.T)]))

    def plot(self, recording: RecordingLike, title: str = "") -> Figure:
        """Return a matplotlib figure of the measured outputs and the simulation, each with its error below."""
        recording = self._opened(recording)
        free = np.asarray(self.simulate(recording))[:, : self._sizes[1]]
        draw = resolve("softneck.plots:validation_figure")
        return draw(
            recording.time, recording.outputs, {"free run": free}, title, run=recording.run, robot=recording.robot
        )

    def _opened(self, recording: RecordingLike) -> Recording:
        """Return the recording that this model is to run along; an array is of its robot and sample time."""
        if isinstance(recording, np.ndarray):
            U = finite_matrix("set_points", recording, self._sizes[0])
            recording = Recording.from_arrays(U, sample_time=self.sample_time, robot=self.robot)
        else:
            recording = open_recording(recording)
        self.check(recording)
        return recording

    def _labelled(self, recording: Recording, parts: Sequence[Matrix]) -> Labelled:
        return Labelled(np.concatenate(parts), recording.time, {port.name: port.unit for port in self.block().outputs})

    def adapted(self, recording: Recording, *, window: float | None = None) -> Model:
        """Return the model refitted to the latest data, held to what it is where these say nothing.

        Of the window every third block of ten time constants is held out: where an output is worse there, this model
        is kept.
        `findings["adaptation"]` says what became of it.

        Args:
            recording: whose last `window` [s] is looked at; None: 150 time constants, of a neck 30 s.

        Raises:
            SettingsError: a kind that cannot adapt.
        """
        # Above this room: what moves is known by kind.
        return resolve("softneck.identification.adaptation._adapt:adapted")(self, recording, window)

    def tf(
        self,
        output: str,
        *,
        angle_unit: str = "rad",
        input: str | None = None,
        continuous: bool = False,
        pade: int = 3,
        units: str = "SI",
    ) -> control.TransferFunction:
        """Return a transfer function to `output` (linear kinds); in discrete time its dead time is exact.

        Args:
            output: its name, of a neck "pitch" or "roll".
            angle_unit: of the output in SI, "rad" or "deg".
            input: a redefined input ("theta_i", "phi_i", "delta_i"; "flexion_input", "cocontraction") or a motor's
                set-point, the others held; None takes the redefined input of `output` (Eq. 9, 10).
            continuous: return K/(s + p) and the like, the dead time as a Pade approximation.
            pade: its order; 0 leaves the dead time out.
            units: as of `ss`.
        """
        if continuous:
            return _linear.continuous_function(self, output, input, angle_unit, pade, units)
        return _linear.transfer_function(self, output, input, angle_unit, units)

    def ss(self, *, units: str = "SI") -> control.StateSpace:
        """Return the state space to the outputs from the redefined inputs, or from the motors where it has them.

        Args:
            units: "SI" (rad, Pa, m, V), with the signals' names; "robot": motors in the unit of the robot's files and
                outputs in the one that people see, with names that say it: `pressure_setpoint [kPa]`, `flexion [deg]`.
        """
        return _linear.state_space(self, units)

    def casadi(self) -> casadi.Function:
        """Return one step in free run as a function of symbols, (x, u) -> (x_next, y), from the runtime's own text.

        x is `State.values`, u (3,) the set-points [rad], y the outputs one sample later. At kinks derivatives are those
        of one side.

        Raises:
            SettingsError: a kind that searches a set (`nlsm`, or `guarded` over it).
        """
        from softneck.runtime import step_function

        held = [self.kind, *(kind for kind, _ in members(self.arrays))]
        for kind in held:
            if kind in _SEARCHING:
                raise SettingsError(f"a model of kind `{kind}` searches its set; it cannot become a CasADi function.")
        start = self.block().initial_state(use_measurement=0.0, noise_std=0.0)
        return step_function(self.block(), start.parameters, inputs=self._sizes[0])

    def summary(self) -> str:
        """Return a few lines on what the model is, in degrees."""
        lines = [f"{self.kind}: {KINDS[self.kind].summary}", f"sample time {1e3 * self.sample_time:g} ms"]
        if self.robot.in_header():
            lines.append(f"robot {self.robot.label()}: {len(self.robot.motors.names)} motor(s), outputs "
                         f"{', '.join(self.robot.outputs.names)}")  # fmt: skip
        known = payloads(self.arrays)
        if known is not None:
            lines.append(f"parameter `payload`: the recordings had {known[0]:g} to {known[1]:g} kg")
        if self.kind in _linear.KINDS:
            lines += _linear.describe(self)
        lines += [f"{key}: {_short(value)}" for key, value in self.findings.items() if _is_plain(value)]
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
        return {
            "kind": self.kind, "sample_time": self.sample_time, "arrays": list(self.arrays),
            "settings": dict(self.settings), "findings": dict(self.findings), **self.robot.in_header(),
        }  # fmt: skip

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
        _check_header(model)
        return model

    @property
    def _sizes(self) -> tuple[int, int]:
        """How many motors and how many outputs."""
        return len(self.robot.motors.names), len(self.robot.outputs.names)

    def _starts(self, y0: Vector) -> dict[str, float]:
        return {f"{name}_start": float(y) for name, y in zip(self.robot.outputs.names, y0, strict=True)}

    def check(self, recording: Recording) -> None:
        """Raise DataError for what this model cannot run along: no recording, another robot or sample time."""
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

    def _free_run(self, run: Recording, motors: str, warm_up: int) -> Matrix:
        start = self.initial_state(run)
        rows = _input_rows(run, motors, outputs=False)
        rows[:warm_up] = _input_rows(run, "measured")[:warm_up]
        _, outputs = self.block().run(start, rows)
        return np.vstack([start.outputs, outputs[:-1]])


def _payload_of(run: Recording, block: Block) -> dict[str, float]:
    """Return the payload of a run, that of its first row, where the model knows of any; none logged is none."""
    if all(port.name != "payload" for port in block.parameters):
        return {}
    return {"payload": float(run.channels["payload"][0]) if "payload" in run.channels else 0.0}


def _check_header(model: Model) -> None:
    if not 0.0 < model.sample_time < _LONGEST_SAMPLE * (model.robot.time_constant_s or np.inf):
        raise FileFormatError(f"a sample time of {model.sample_time} s is implausible for {model.robot.name}.")
    if not isinstance(model.settings, dict) or not isinstance(model.findings, dict):
        raise FileFormatError("its settings and findings must be tables.")
    try:
        input_ports(model.findings, model.robot)
    except (KeyError, TypeError, ValueError) as error:
        raise FileFormatError("its range of set-points must be a minimum and a maximum for each motor.") from error
    if model.training_rows.dtype != np.uint64 or model.training_rows.ndim != 1:
        raise FileFormatError("its training rows are not hashes.")


def load_model(path: str | Path) -> Model:
    """Open a model file; raises FileFormatError for anything else."""
    return load_file(path, role="model")


def _input_rows(run: Recording, source: str, *, outputs: bool = True) -> Matrix:
    U, Y = run.set_points, run.outputs
    motors, both = U.shape[1], U.shape[1] + Y.shape[1]
    rows = np.full((len(run), both + motors), np.nan)
    rows[:, :motors] = U
    rows[:, motors:both] = Y if outputs else np.nan
    if source == "measured" and run.has_motor_positions:
        rows[:, both:] = run.motor_positions
    return rows


def _held_out_lines(found: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the fits [%] on the rows held out, for people."""
    if not found:
        return []
    tables = {"persistence": "persistence", "one_step": "one step", "fit": "free run"}
    lines = [f"hold-out of {found.get('rows', '-')} rows, fit [%] {'/'.join(names)}:"]
    for key, what in tables.items():
        if table := found.get(key):
            lines.append(f"  {what:11} {'/'.join(map(percent, table.values()))}")
    return lines


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float | str) or (isinstance(value, list) and len(value) <= 4)


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_short(item) for item in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def embed_model(model: Model) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what the header of a controller or an observer says of its model, and its arrays by their names there."""
    arrays = {f"model_{name}": array for name, array in model.arrays.items()}
    return model._header(), {**arrays, "model_training_rows": model.training_rows}


def embedded_model(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Model:
    """Return the model of which the file's header says `header`."""
    names = [*header["arrays"], "training_rows"]
    return Model.from_archive(dict(header), {name: arrays[f"model_{name}"] for name in names})
