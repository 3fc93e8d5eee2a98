"""The Kalman observer: filterpy for design and offline use, a numpy runtime in loops and FMUs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from filterpy.kalman import KalmanFilter
from numpy.typing import ArrayLike

from softneck.core import Block, DataError, FileFormatError, Matrix, Port, State, Vector, write_archive
from softneck.signals import Recording

_RUNTIME = "softneck.estimation._kalman_runtime"
_ARRAYS = ("F", "B", "H", "model_noise", "disturbance_noise", "P0", "redefinition", "constants")
_NOISE = ("measurement_noise_std", "model_noise_std", "disturbance_noise_std")
_MEASURED = ("pitch", "roll")


@dataclass(frozen=True, slots=True, eq=False)
class Estimates:
    """What the filter made of a recording, row by row.

    Attributes:
        time: (time,) [s].
        pitch, roll: (time,) estimates at the instant of the measurement [rad].
        pitch_rate, roll_rate: (time,) [rad/s].
        innovation: (time,) normalised innovation squared; 0 where nothing was measured.
        accepted: (time,) bool, whether the measurement was taken in.
        healthy: (time,) bool.
    """

    time: Vector
    pitch: Vector
    roll: Vector
    pitch_rate: Vector
    roll_rate: Vector
    innovation: Vector
    accepted: np.ndarray
    healthy: np.ndarray


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class KalmanObserver:
    """A designed Kalman filter; `KalmanSettings.design` makes it.

    Attributes:
        sample_time: [s].
        arrays: F (n, n), B (n, 2), H (2, n), unit covariances of model and disturbance noise (n, n), P0 (n, n),
            rows 1 and 2 of the redefinition (2, 3), constants (delays, gate, rejections, timeout, sample time).
        noise: measurement, model and disturbance noise, standard deviations [rad].
        sensor: name of the preset, "none" where the noise was given.
        order: of the loop it is for.
        gate_level: chi-square level of the gate.
    """

    sample_time: float
    arrays: tuple[Matrix, ...]
    noise: tuple[float, float, float]
    sensor: str
    order: str
    gate_level: float

    @property
    def delays(self) -> tuple[int, int]:
        """Samples that set-points need to act on pitch and roll, beyond the first."""
        return int(self.arrays[7][0]), int(self.arrays[7][1])

    def block(self) -> Block:
        """Return the filter as a block of role "observer"."""
        u = tuple(Port(name=f"motor_setpoint_{j}", unit="rad", minimum=-6.0, maximum=6.0) for j in (1, 2, 3))
        y = tuple(Port(name=f"{a}_measured", unit="rad", description=f"measured {a}", missing=True) for a in _MEASURED)
        valid = Port(name="measurement_valid", description="whether the angles were measured", start=1.0, boolean=True)
        return Block(
            kind="kalman",
            role="observer",
            runtime=_RUNTIME,
            sample_time=self.sample_time,
            arrays=self.arrays,
            inputs=(*u, *y, valid),
            outputs=(
                *(Port(name=a, unit="rad", description=f"estimated {a}") for a in _MEASURED),
                *(Port(name=f"{a}_rate", unit="rad/s", description=f"estimated rate of {a}") for a in _MEASURED),
                Port(name="innovation", description="normalised innovation squared; 0 when nothing was measured"),
                Port(name="healthy", description="a measurement was accepted in time", boolean=True),
            ),
            parameters=tuple(
                Port(
                    name=name, unit="rad", start=value, minimum=1e-9, maximum=math.pi, description="standard deviation"
                )
                for name, value in zip(_NOISE, self.noise, strict=True)
            ),
        )

    def initial_state(self, **parameters: float) -> State:
        """Return the state at the start; parameters are the noise levels by name."""
        return self.block().initial_state(**parameters)

    def step(self, state: State, inputs: ArrayLike) -> tuple[State, Vector]:
        """Return the next state and the outputs valid now; inputs and outputs as in `block()`."""
        return self.block().step(state, inputs)

    def filterpy(self) -> KalmanFilter:
        """Return a configured `filterpy.kalman.KalmanFilter` (2 inputs: delayed theta_i, phi_i; 2 measurements).

        Give `predict(u)` the inputs that act, (2, 1), and `update(None)` where nothing was measured: a NaN in
        `update` would stay in its state for good.
        """
        F, B, H, QM, QW, P0 = self.arrays[:6]
        measurement, model, disturbance = self.noise
        kf: Any = KalmanFilter(dim_x=F.shape[0], dim_z=2, dim_u=2)
        kf.F, kf.B, kf.H, kf.P = F.copy(), B.copy(), H.copy(), P0.copy()
        kf.Q = model**2 * QM + disturbance**2 * QW
        kf.R = measurement**2 * np.eye(2)
        return kf

    def estimate(self, recording: Recording) -> Estimates:
        """Run filterpy over a recording; each of its runs starts anew. Missing samples are predicted over.

        Raises:
            DataError: another sample time.
        """
        if not math.isclose(recording.sample_time, self.sample_time, rel_tol=1e-6):
            raise DataError(
                f"the recording has sample time {recording.sample_time:g} s, the observer {self.sample_time:g} s; "
                "resample it or design the observer for it."
            )
        rows = np.concatenate([self._estimate_run(run) for run in recording.runs()])
        pitch, roll, pitch_rate, roll_rate, innovation, accepted, healthy = rows.T.copy()
        return Estimates(recording.time, pitch, roll, pitch_rate, roll_rate, innovation, accepted > 0.5, healthy > 0.5)

    def _estimate_run(self, run: Recording) -> Matrix:
        F, B, H, P0, T, constants = (self.arrays[i] for i in (0, 1, 2, 5, 6, 7))
        kf = self.filterpy()
        inputs = run.set_points @ T.T
        rows = np.zeros((len(run), 7))
        misses, rejections = constants[4], 0
        for k, z in enumerate(_measured(run)):
            # At t_k the set-points of t_k-1 were held; those of t_k-1-delay act.
            u = np.array([[inputs[max(0, k - 1 - (delay - self._late)), i]] for i, delay in enumerate(self.delays)])
            kf.predict(u)
            forced = rejections >= constants[3]
            if forced or k <= max(self.delays) - self._late:
                kf.P = kf.P + P0
            nis, accepted = 0.0, False
            if np.isfinite(z).all():
                e = z[:, None] - H @ kf.x
                nis = float((e.T @ np.linalg.solve(H @ kf.P @ H.T + kf.R, e))[0, 0])
                accepted = forced or nis <= constants[2]
                rejections = 0 if accepted else rejections + 1
            kf.update(z[:, None] if accepted else None)
            misses = 0 if accepted else misses + 1
            angle = (H @ kf.x).ravel()
            rate = ((H @ (F @ kf.x + B @ u)).ravel() - angle) / self.sample_time
            rows[k] = [*angle, *rate, nis, accepted, misses < constants[4]]
        return rows

    @property
    def _late(self) -> int:
        """The sample that a Jacobi loop adds to the delays and a recording does not have."""
        return int(self.order == "jacobi")

    def summary(self) -> str:
        """Return some lines for people."""
        measurement, model, disturbance = (math.degrees(value) for value in self.noise)
        n = self.arrays[0].shape[0]
        d = self.delays
        return "\n".join(
            [
                f"kalman observer, {self.sample_time * 1e3:g} ms, {self.order} order, sensor {self.sensor}",
                f"  {n} states: model and disturbance of pitch and roll; set-points act after "
                f"{d[0] + 1} and {d[1] + 1} samples",
                f"  noise: measured {measurement:.3g} deg, model {model:.3g} deg, disturbance {disturbance:.3g} deg",
                f"  gate: chi-square level {self.gate_level:g} (innovation <= {self.arrays[7][2]:.3g}); "
                f"by force after {self.arrays[7][3]:g} rejections",
                f"  healthy until {self.arrays[7][4] * self.sample_time * 1e3:g} ms without an accepted measurement",
            ]
        )

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the observer to one `.npz` file."""
        block = self.block()
        header = {
            "kind": "kalman",
            "sample_time": self.sample_time,
            "noise": dict(zip(_NOISE, self.noise, strict=True)),
            "sensor": self.sensor,
            "order": self.order,
            "gate_level": self.gate_level,
            "inputs": [port.name for port in block.inputs],
            "outputs": [port.name for port in block.outputs],
            "units": {port.name: port.unit for port in (*block.inputs, *block.outputs)},
        }
        write_archive(path, header, dict(zip(_ARRAYS, self.arrays, strict=True)), force=force)

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> KalmanObserver:
        """Return the observer that `save` wrote; `softneck.core.load` calls this."""
        items = tuple(np.ascontiguousarray(arrays[name], dtype=np.float64) for name in _ARRAYS)
        n = items[0].shape[0]
        shapes = ((n, n), (n, 2), (2, n), (n, n), (n, n), (n, n), (2, 3), (6,))
        if any(item.shape != shape or not np.isfinite(item).all() for item, shape in zip(items, shapes, strict=True)):
            raise FileFormatError("the observer's arrays have wrong shapes or are not finite; design it again.")
        noise = header["noise"]
        return cls(
            sample_time=float(header["sample_time"]),
            arrays=items,
            noise=(float(noise[_NOISE[0]]), float(noise[_NOISE[1]]), float(noise[_NOISE[2]])),
            sensor=str(header["sensor"]),
            order=str(header["order"]),
            gate_level=float(header["gate_level"]),
        )


def _measured(run: Recording) -> Matrix:
    """Return the measured angles (time, 2): `pitch_measured` where a simulation logged it, else `pitch`."""
    columns = [run.channels.get(f"{axis}_measured", run.channels[axis]) for axis in _MEASURED]
    return np.column_stack(columns)
