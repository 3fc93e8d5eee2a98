"""Per motor: does its position follow its set-point as it did, does it jump, does its current fit its motion."""

from __future__ import annotations

import numpy as np

from softneck.core import Matrix, Vector
from softneck.signals.detection._cusum import Charts, shift_score
from softneck.signals.detection._whitening import Filter, Whitening

from ._baseline import Baseline

# Set-points that a step of a motor may still answer to [cycles]: the slowest drives' latency is 0.1 s.
_SET_POINTS = 12
# Speeds over which Coulomb friction is smoothed [rad/s]: which one the gear has is fitted.
EDGES = (0.1, 0.5)
# Changes of tension are taken over this many cycles: over one they are half a count of the drive's current.
_OVER = 3
# Of these, which the current answers to: what is left to the set-points some cycles ago is the speed that is asked now.
_ASKED = slice(2, 10)
_OWN = len(EDGES) + 3 + _ASKED.stop - _ASKED.start
# A position that moved more than was predicted and is this many standard deviations off counts for a jump.
_USUAL = 4.0
# Cycles after a jump until it shows whether the drive moved its winch after it, which it does after 10 ms or so.
_JUDGED = 4
# Changes of tension below this many standard deviations say nothing of their scale: half of them is rounding, and
# motors that only tremble are not what the model was fitted on.
_EXCITED = 6.0
# A current counts for little in each cycle: its transients are the least well known, and a wrong scale is in all.
_SIGHT = 3.0
# The models of the currents are good to this part of a change.
_GOOD = 0.1
# Slower than this a motor stands [rad/s]: a few counts of its encoder a cycle.
_STANDS = 0.05
_NOT = -1e6
# So near to the largest tension of all it may be cut off, and so long it tells in what follows [cycles].
_NEAR_TOP, _CUT = 0.05, 10
# A current scale that is wrong is wrong by the ratio of two peak currents.
SCALES = (2.0, 0.5)


class MotorFeatures:
    """What the models of drive and tendon are linear in."""

    def __init__(self, motors: int, cycle: float) -> None:
        """Know nothing yet."""
        self._cycle, self._seen = cycle, 0
        self._p = np.zeros((5, motors))
        self._s = np.zeros((_SET_POINTS, motors))
        self._x = np.zeros((_OVER + 1, motors, motors + _OWN))
        self._tension = np.zeros((_OVER + 1, motors))

    @property
    def full(self) -> bool:
        """Whether all that it looks back at was seen."""
        return self._seen > _SET_POINTS + _OVER

    def step(self, setpoints: Vector, positions: Vector, tensions: Vector) -> None:
        """Take one cycle, the set-points sent in the one before; all (motors,)."""
        for past, value in ((self._p, positions), (self._s, setpoints), (self._tension, tensions)):
            past[1:] = past[:-1]
            past[0] = value
        p, n = self._p, positions.size
        v = (p[:3] - p[1:4]) / self._cycle
        self._x[1:] = self._x[:-1]
        x = self._x[0]
        x[:, :n] = positions
        for j, edge in enumerate(EDGES):
            x[:, n + j] = np.tanh(v[0] / edge)
        x[:, n + len(EDGES) : n + len(EDGES) + 3] = v.T
        x[:, n + len(EDGES) + 3 :] = (self._s[_ASKED] - positions).T
        self._seen += 1

    @property
    def behind(self) -> Vector:
        """How far each motor was behind its set-points at most lately (motors,) [rad]."""
        return np.abs(self._s - self._p[0]).max(axis=0)

    @property
    def moved(self) -> Vector:
        """Steps of the positions in this cycle [rad]."""
        return self._p[0] - self._p[1]

    @property
    def drive(self) -> Matrix:
        """What each step is predicted from (motors, regressors): what was left to set-points of the last cycles.

        Not from its last steps: of a motor that stands one would predict that it stands.
        """
        return (self._s - self._p[1]).T

    @property
    def tension_change(self) -> Vector:
        """Over three cycles [N]."""
        return self._tension[0] - self._tension[_OVER]

    @property
    def current(self) -> Matrix:
        """What that follows from (motors, features)."""
        return self._x[0] - self._x[_OVER]

    @property
    def speeds(self) -> Matrix:
        """Those of the features that motion makes, not place (motors, features)."""
        return self._x[0][:, self._p.shape[1] :]

    def taut(self, model: Matrix) -> Vector:
        """Return what of the tensions friction and damping do not explain by `model` (motors, features) [N]."""
        n = self._p.shape[1]
        return self._tension[0] - np.sum(model[:, n:] * self.speeds, axis=1)


def motor_names(motors: int) -> list[tuple[str, int]]:
    """Return (event, motor from 0) of each chart."""
    alone = [(name, i) for name in ("motor_jammed", "jump") for i in range(motors)]
    return alone + [("current_scale", i) for _ in SCALES for i in range(motors)]


class MotorCharts:
    """The charts of all motors.

    Attributes:
        features: of this cycle.
        scores: of the last cycle, in the order of `motor_names`.
        charts: their sums.
    """

    def __init__(self, baseline: Baseline, thresholds: Vector | None = None) -> None:
        """Begin; `thresholds` other than the baseline's are for calibrating."""
        self._b, n = baseline, baseline.motors
        self._names = motor_names(n)
        self._drive, self._current = np.array(baseline.drive), np.array(baseline.current)
        self._drive_spread, self._current_spread = np.array(baseline.drive_spread), np.array(baseline.current_spread)
        self._cut = np.zeros(n)
        self._reach = np.array(baseline.current_reach)
        self._top = np.array(baseline.current_top)
        self.features = MotorFeatures(n, baseline.cycle)
        self._tensions = Filter([Whitening(row) for row in baseline.current_whitening], (1 + len(SCALES),))
        self.scores = np.zeros(len(self._names))
        self.charts = Charts(np.array(baseline.motor_thresholds) if thresholds is None else thresholds)
        self._jump: tuple[int, int, float, float] | None = None

    @property
    def judging(self) -> bool:
        """Whether a position jumped and it does not show yet why."""
        return self._jump is not None

    def step(self, setpoints: Vector, positions: Vector, tensions: Vector) -> tuple[str, int, str] | None:
        """Take one cycle; return (event, motor from 0, detail) of the fault that is found, None for none."""
        f, n = self.features, self._b.motors
        f.step(setpoints, positions, tensions)
        if not f.full:
            return None
        if self._jump is not None:
            return self._judged(positions)
        expected = np.sum(self._drive * f.drive, axis=1)
        moved = f.moved
        residual, still = moved - expected, -expected
        spread = self._drive_spread[:, 0] + self._drive_spread[:, 1] * expected**2
        self.scores[:n] = shift_score(residual[:, None], still[:, None], spread[:, None])
        # More than was asked, or the other way: less is what a jam or too little current does.
        more = np.abs(moved) > np.abs(expected)
        self.scores[n : 2 * n] = np.where(more, np.abs(residual) / np.sqrt(spread), 0.0) - _USUAL
        change = np.sum(self._current * f.current, axis=1)
        wrong = [(scale - 1.0) * change for scale in SCALES]
        white = self._tensions.step(np.stack([f.tension_change - change, *wrong]))
        spread = self._current_spread[:, 0] + self._current_spread[:, 1] * change**2
        # Nor does a current at its limit, or that was there a moment ago.
        self._cut = np.where(np.abs(np.abs(tensions) / self._top - 1.0) < _NEAR_TOP, _CUT, self._cut - 1)
        # Nor where more is asked than in nearly all of the commissioning run.
        asked = f.behind > self._reach
        quiet = asked | (self._cut > 0) | (change**2 < _EXCITED**2 * self._current_spread[:, 0])
        for j in range(len(SCALES)):
            at = slice((2 + j) * n, (3 + j) * n)
            wrong = white[1 + j][:, None]
            # What passes for right is not one scale but all within a tenth of it.
            allowed = np.minimum(_GOOD / abs(SCALES[j] - 1.0) * white[1 + j] ** 2 / spread, _GOOD * _SIGHT**2)
            self.scores[at] = shift_score(white[0][:, None], wrong, spread[:, None], sight=_SIGHT) - allowed
            self.scores[at][quiet] = 0.0
        # What turns is not jammed, however late it is: an overloaded motor still creeps.
        self.scores[:n][np.abs(moved) > _STANDS * self._b.cycle] = _NOT
        found = self.charts.step(self.scores)
        if found < 0:
            return None
        name, motor = self._names[found]
        if name == "jump":
            self._jump = (motor, _JUDGED, float(positions[motor]), float(moved[motor]))
            return None
        if name == "current_scale":
            times = SCALES[found // n - 2]
            return name, motor, f"motor {motor + 1}: its current is about {times:g} times what its motion takes"
        return name, motor, f"motor {motor + 1} at {positions[motor]:.2f} rad, set-point {setpoints[motor]:.2f} rad"

    def _judged(self, positions: Vector) -> tuple[str, int, str] | None:
        """Say what a jump was: a drive whose encoder slipped leads its winch back, one that was misread does not."""
        motor, left, there, jumped = self._jump or (0, 0, 0.0, 0.0)
        self._jump = (motor, left - 1, there, jumped)
        if left > 1:
            return None
        back = (there - float(positions[motor])) / jumped if jumped else 0.0
        # A drive goes back a part of the way in these cycles; all of it at once is a number that came back.
        text = f"motor {motor + 1} jumped by {jumped:.2f} rad in one cycle"
        if 0.05 < back < 0.8:
            return "encoder_slip", motor, f"{text}, and its drive turns the winch after it"
        return "position_bad", motor, f"{text}, and its drive does not answer to it"
