"""The neck as one state space from its three motors to both angles, without redefinition."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    require_between,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.signals import Recording

from ..models._directions import directions_of
from ..models._drive import fit_drive
from ..models._fitting import fitted_model, training_recording
from ..models._free_run import delay_samples
from ..models._model import Model
from ..models._state_space import lss_arrays
from ._oe import SOURCES
from ._operating_point import about, operating_point, with_offset
from ._regression import condition
from ._subspace_fit import SubspaceFit, fit_subspace

# Motors that repeat each other to one part in a million: no method tells their effects apart.
_WORST_CONDITION = 1e6


@dataclass(frozen=True, slots=True, kw_only=True)
class Subspace:
    """State space of both angles over the three motors by past-output MOESP (of the N4SID family).

    Its gain K makes predictions from measured angles; its free run is fitted by B.

    Attributes:
        order: states, without the dead time.
        horizon: past and future samples that the projection looks at.
        delay: dead time of all motors [s]; None takes the one whose free run costs least.
        max_delay: end of that search [s], of another robot by its time constant over the neck's 0.2 s.
        source: "set_points", or "positions" of the motors, see `OutputError`.
    """

    order: int = 4
    horizon: int = 15
    delay: float | None = None
    max_delay: float = 0.2
    source: str = "set_points"

    def __post_init__(self) -> None:
        require_whole("order", self.order, 2, 30)
        require_whole("horizon", self.horizon, 2, 200)
        require_between("order / horizon", self.order / self.horizon, 0.0, 1.0)
        if self.delay is not None:
            require_between("delay", self.delay, 0.0, 2.0, "s")
        require_positive("max_delay", self.max_delay, "s")
        require_one_of("source", self.source, SOURCES)

    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify both angles at once; runs are never joined, missed samples are left out.

        Raises:
            DataError: too short, constant, or motors that repeat each other.
        """
        recording = training_recording(recordings, any_robot=True)
        if self.source == "positions" and not recording.has_motor_positions:
            raise DataError("no motor positions were logged; use `source=set_points`.")
        motors = recording.motor_positions if self.source == "positions" else recording.set_points
        number = condition(motors)
        if not number <= _WORST_CONDITION:
            raise DataError(
                f"the {motors.shape[1]} motors repeat each other (condition number {number:.2g}), so their effects cannot be told "
                "apart. Record with co-contraction in it (`mixed`), or identify `oe` or `srivc` over theta_i and phi_i."
            )
        outputs = len(recording.robot.outputs.names)
        if self.order < outputs:
            raise DataError(f"{outputs} outputs need at least {outputs} states; raise `order`.")
        point = operating_point(recording)
        best, curves, found = self._search(about(recording, point), progress)
        fit, d = best
        drive = fit_drive(recording)
        arrays = lss_arrays(
            (fit.A, fit.B, fit.C, fit.K), delay=d, drive=drive.array, source=int(self.source == "positions")
        )
        arrays = with_offset("subspace", arrays, recording, point)
        progress(1.0, "done")
        return fitted_model(
            "subspace",
            self,
            recording,
            arrays=arrays,
            findings={
                "delay_criterion": "output_error",
                "delay_curve": curves,
                "singular_values": fit.singular_values.tolist(),
                "condition_number": number,
                **found,
            },
        )

    def _search(
        self, recording: Recording, progress: Progress
    ) -> tuple[tuple[SubspaceFit, int], dict[str, Any], dict[str, Any]]:
        """Return fit and dead time of the least cost, the cost curves, and what was found of another robot's time."""
        Ts, names = recording.sample_time, recording.robot.outputs.names
        runs = [
            (run.motor_positions if self.source == "positions" else run.set_points, run.outputs)
            for run in recording.runs()
        ]
        directions = directions_of(recording, [U for U, _ in runs])
        outputs = recording.outputs
        spread = np.nansum((outputs - np.nanmean(outputs, axis=0)) ** 2, axis=0)
        best: tuple[SubspaceFit, int] | None = None
        curves: dict[str, list[list[float]]] = {name: [] for name in names}
        tried = delay_samples(self.delay, self.max_delay * directions.stretch, Ts, [(Y, U) for U, Y in runs])
        for number, d in enumerate(tried):
            progress(number / len(tried), f"{1e3 * d * Ts:.0f} ms")
            fit = fit_subspace([(_late(U, d), Y) for U, Y in runs], self.order, self.horizon)
            for axis, name in enumerate(names):
                percent = 100.0 * (1.0 - float(np.sqrt(fit.cost[axis] / spread[axis])))
                curves[name].append([d * Ts, percent, float(np.sqrt(fit.cost[axis] / len(outputs)))])
            if best is None or np.sum(fit.cost / spread) < np.sum(best[0].cost / spread):
                best = (fit, d)
        if best is None:
            raise DataError("no dead time could be tried; record longer.")
        found = {} if recording.robot.is_neck else {"time_constants_s": directions.seconds.tolist()}
        return best, curves, found


def _late(U: Matrix, d: int) -> Matrix:
    """Return the inputs `d` samples late, the first held before the record."""
    return np.vstack([np.repeat(U[:1], min(d, len(U)), axis=0), U[: len(U) - d]]) if d else U
