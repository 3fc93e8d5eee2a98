"""Charts of each motor: following of the set-point, jumps of the position, and scale of the current."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

from ._baseline import Baseline
from ._charts_runtime import SUPERVISED_NOT
from ._detection import Charts, Filter, Whitening

RUNTIME = "softneck.drives.supervision._charts_runtime"
# Memory of the drive model [cycles]: the latency of the slowest drives is 0.1 s.
_SET_POINTS = 12
# Speeds over which Coulomb friction is smoothed [rad/s]; the fit selects among them.
EDGES = (0.1, 0.5)
# Cycles between two compared tensions: over one cycle the change is half a count of the drive's current.
_TENSION_CYCLES = 3
# Range of lags of the set-points in the model of the current: the distance to them is the requested speed.
_SET_POINT_LAGS = (2, 10)
_OWN = len(EDGES) + 3 + _SET_POINT_LAGS[1] - _SET_POINT_LAGS[0]
# Cycles after a jump until it is decided whether the drive moved its winch, which takes about 10 ms.
_DECISION_CYCLES = 4
# Share of the expected way back in these cycles below which the drive counts as not moving.
_LEAST_RETURN_SHARE = 0.5
# Hypotheses of a wrong current scale: ratios of two peak currents.
SCALES = (2.0, 0.5)


class MotorRules(NamedTuple):
    """Parameters of the charts of motors.

    Attributes:
        usual: standard deviations of a jump of the position.
        excited: standard deviations of a change of tension below which its scale is not evaluated: half of such a
            change is rounding, and the model was not fitted on motors that only tremble.
        sight: limit of a change of tension in standard deviations: transients are modelled worst, and a wrong scale is
            in all samples.
        known: relative accuracy of the models of the currents.
        stands: speed below which a motor stands still [rad/s]: a few encoder counts a cycle.
        near_top: share of the largest tension within which the current may be saturated.
        rest: cycles without evaluation after saturation or slack [cycles].
        carries: averaging time of the load of the tendons [cycles]: friction averages out, and the payload is constant.
    """

    usual: float = 4.0
    excited: float = 6.0
    sight: float = 3.0
    known: float = 0.1
    stands: float = 0.05
    near_top: float = 0.05
    rest: float = 10.0
    carries: float = 500.0


RULES = MotorRules()
_RULES = tuple(RULES)


class MotorFeatures:
    """Regressors of the models of drive and tendon.

    Attributes:
        past: set-points (12, motors), positions (5, motors) and tensions (4, motors), latest first.
        x: features of the last cycles (4, motors, features).
    """

    def __init__(self, motors: int, cycle: float) -> None:
        """Start with an empty memory."""
        self._cycle, self._seen = cycle, 0
        self._functions: Any = load_functions(RUNTIME)
        self.past = (np.zeros((_SET_POINTS, motors)), np.zeros((5, motors)), np.zeros((_TENSION_CYCLES + 1, motors)))
        self.x = np.zeros((_TENSION_CYCLES + 1, motors, motors + _OWN))
        self._edges = np.array(EDGES)

    @property
    def full(self) -> bool:
        """Whether its memory is filled."""
        return self._seen > _SET_POINTS + _TENSION_CYCLES

    def step(self, setpoints: Vector, positions: Vector, tensions: Vector) -> None:
        """Add one cycle, with the set-points sent in the cycle before; all (motors,)."""
        now = (setpoints, positions, tensions)
        self._functions.supervised_features(now, self.past, self.x, self._edges, _SET_POINT_LAGS, self._cycle)
        self._seen += 1

    @property
    def behind(self) -> Vector:
        """Largest recent distance of each motor from its set-points (motors,) [rad]."""
        return np.abs(self.past[0] - self.past[1][0]).max(axis=0)

    @property
    def moved(self) -> Vector:
        """Steps of the positions in this cycle [rad]."""
        return self.past[1][0] - self.past[1][1]

    @property
    def drive(self) -> Matrix:
        """Regressors of each step (motors, regressors): distances to the set-points of the last cycles.

        The last steps are not used: the model of a standing motor would predict that it stands.
        """
        return (self.past[0] - self.past[1][1]).T

    @property
    def tension_change(self) -> Vector:
        """Change of the tensions over three cycles [N]."""
        return self.past[2][0] - self.past[2][_TENSION_CYCLES]

    @property
    def current(self) -> Matrix:
        """Regressors of the change of tension (motors, features)."""
        return self.x[0] - self.x[_TENSION_CYCLES]

    def taut(self, model: Matrix) -> Vector:
        """Return the tensions without friction and damping by `model` (motors, features) [N]."""
        return self.past[2][0] - np.einsum("ij,ij->i", model[:, self.x.shape[1] :], self.x[0][:, self.x.shape[1] :])


def motor_names(motors: int) -> list[tuple[str, int]]:
    """Return (event, motor from 0) of each chart."""
    alone = [(name, i) for name in ("motor_jammed", "jump") for i in range(motors)]
    return alone + [("current_scale", i) for _ in (*SCALES, *SCALES) for i in range(motors)]


class MotorCharts:
    """The charts of all motors.

    `features`: of this cycle. `scores`: of the last cycle, in the order of `motor_names`. `charts`: their sums.
    """

    def __init__(self, baseline: Baseline, thresholds: Vector | None = None) -> None:
        """Start at zero; `thresholds` other than the baseline's are for the calibration."""
        b = self._b = baseline
        n = b.motors
        self._names = motor_names(n)
        self.features = MotorFeatures(n, b.cycle)
        rows = (
            b.drive,
            b.drive_spread,
            b.drive_fastest,
            b.current,
            b.current_spread,
            b.current_top,
            b.current_reach,
            b.slack,
        )
        self._model = tuple(np.array(row) for row in rows)
        self._levels = tuple(np.array(row) for row in (b.level, b.level_spread, b.load, *rows[-3:]))
        self._load = (np.zeros(n), np.zeros(n), np.zeros(1))
        filter_ = Filter([Whitening(row) for row in b.current_whitening], 1 + len(SCALES))
        self._white = (filter_.coefficients, filter_.past, np.zeros((1 + len(SCALES), n)))
        self._rest = np.zeros(n)
        self._scales = np.array(SCALES)
        self._functions: Any = load_functions(RUNTIME)
        self.scores = np.zeros(len(self._names))
        self.charts = Charts(np.array(b.motor_thresholds) if thresholds is None else thresholds)
        self._jump: tuple[int, float, float, float, float] | None = None
        self._jumped = 0

    @property
    def known_load(self) -> bool:
        """Whether the load of the tendons is calibrated; a wrong scale shows in the loads of all other motors."""
        return bool(self._load[1].max() >= self._b.load_low)

    @property
    def judging(self) -> bool:
        """Whether a position jumped and the cause is not yet decided."""
        return self._jump is not None

    def step(self, setpoints: Vector, positions: Vector, tensions: Vector) -> tuple[str, int, str] | None:
        """Process one cycle; return (event, motor from 0, detail) of a detected fault, or None."""
        f, n = self.features, self._b.motors
        f.step(setpoints, positions, tensions)
        if not f.full:
            return None
        if self._jump is not None:
            return self._classify_jump(self._jumped)
        self._functions.supervised_motors(
            self._model, _RULES, f.past, f.x, self._white, self._rest, self._scales, self._b.cycle, self.scores
        )
        at = (2 + len(SCALES)) * n
        self._functions.supervised_levels(
            self._levels, _RULES, f.past, f.x, self._rest, self._scales, self._load, self.scores[at:]
        )
        if not self.known_load:
            # As for the tilt: the distribution of such a load is not calibrated.
            self.scores[2 * n :] = SUPERVISED_NOT
        found = self.charts.step(self.scores)
        if found < 0:
            return None
        name, motor = self._names[found]
        if name == "jump":
            self._jump, self._jumped = (_DECISION_CYCLES, float(f.moved[motor]), 0.0, 0.0, 0.0), motor
            return None
        if name == "current_scale":
            times = SCALES[(found // n - 2) % len(SCALES)]
            return name, motor, f"motor {motor + 1}: its current is about {times:g} times what its motion takes"
        return name, motor, f"motor {motor + 1} at {positions[motor]:.2f} rad, set-point {setpoints[motor]:.2f} rad"

    def _classify_jump(self, motor: int) -> tuple[str, int, str] | None:
        """Decide the cause of a jump: a drive whose encoder slipped moves its winch back, a misread one does not."""
        f, (left, jumped, slipped, misread, went) = self.features, self._jump or (0, 0.0, 0.0, 0.0, 0.0)
        asked = float(self._model[0][motor] @ f.drive[motor])
        # After a misreading the drive has not moved, so that the expected motion remains.
        slipped, misread = slipped + asked, misread + asked + float(self._model[0][motor].sum()) * jumped
        moved = float(f.moved[motor])
        went += moved
        text = f"motor {motor + 1} jumped by {jumped:.2f} rad in one cycle"
        if moved * jumped < 0.0 and abs(moved) > 0.5 * abs(jumped):
            return "position_bad", motor, f"{text}, and back in another"
        self._jump = (left - 1, jumped, slipped, misread, went)
        if left > 1:
            return None
        if abs(went - misread) > _LEAST_RETURN_SHARE * abs(slipped - misread):
            return "encoder_slip", motor, f"{text}, and its drive turns the winch after it"
        return "position_bad", motor, f"{text}, and its drive does not answer to it"
