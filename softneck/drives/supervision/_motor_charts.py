"""Per motor: does its position follow its set-point as it did, does it jump, does its current fit its motion."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from softneck.core import Matrix, Vector
from softneck.runtime import load_functions

from ._baseline import Baseline
from ._charts_runtime import SUPERVISED_NOT
from ._detection import Charts, Filter, Whitening

RUNTIME = "softneck.drives.supervision._charts_runtime"
# Set-points that a step of a motor may still answer to [cycles]: the slowest drives' latency is 0.1 s.
_SET_POINTS = 12
# Speeds over which Coulomb friction is smoothed [rad/s]: which one the gear has is fitted.
EDGES = (0.1, 0.5)
# Changes of tension are taken over this many cycles: over one they are half a count of the drive's current.
_OVER = 3
# Of these, which the current answers to: what is left to the set-points some cycles ago is the speed that is asked now.
_ASKED = (2, 10)
_OWN = len(EDGES) + 3 + _ASKED[1] - _ASKED[0]
# Cycles after a jump until it shows whether the drive moved its winch after it, which it does after 10 ms or so.
_JUDGED = 4
# Of the way back that a drive is expected to lead its winch in these: less is none at all.
_BACK = 0.5
# A current scale that is wrong is wrong by the ratio of two peak currents.
SCALES = (2.0, 0.5)


class MotorRules(NamedTuple):
    """What the charts of motors go by.

    Attributes:
        usual: standard deviations by which a position jumped.
        excited: changes of tension below so many standard deviations say nothing of their scale: half of them is
            rounding, and motors that only tremble are not what the model was fitted on.
        sight: standard deviations that a change of tension counts for: its transients are the least well known, and a
            wrong scale is in all.
        known: part of a change that the models of the currents are good to.
        stands: slower than this a motor stands [rad/s]: a few counts of its encoder a cycle.
        near_top: part of the largest tension of all within which it may be cut off.
        rest: so long that tells in what follows, and a tendon that hung [cycles].
        carries: what the tendons carry is their mean over so long [cycles]: friction averages out, no payload changes.
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
    """What the models of drive and tendon are linear in.

    Attributes:
        past: set-points (12, motors), positions (5, motors) and tensions (4, motors) so far, the latest first.
        x: features of the last cycles (4, motors, features).
    """

    def __init__(self, motors: int, cycle: float) -> None:
        """Know nothing yet."""
        self._cycle, self._seen = cycle, 0
        self._functions: Any = load_functions(RUNTIME)
        self.past = (np.zeros((_SET_POINTS, motors)), np.zeros((5, motors)), np.zeros((_OVER + 1, motors)))
        self.x = np.zeros((_OVER + 1, motors, motors + _OWN))
        self._edges = np.array(EDGES)

    @property
    def full(self) -> bool:
        """Whether all that it looks back at was seen."""
        return self._seen > _SET_POINTS + _OVER

    def step(self, setpoints: Vector, positions: Vector, tensions: Vector) -> None:
        """Take one cycle, the set-points sent in the one before; all (motors,)."""
        now = (setpoints, positions, tensions)
        self._functions.supervised_features(now, self.past, self.x, self._edges, _ASKED, self._cycle)
        self._seen += 1

    @property
    def behind(self) -> Vector:
        """How far each motor was behind its set-points at most lately (motors,) [rad]."""
        return np.abs(self.past[0] - self.past[1][0]).max(axis=0)

    @property
    def moved(self) -> Vector:
        """Steps of the positions in this cycle [rad]."""
        return self.past[1][0] - self.past[1][1]

    @property
    def drive(self) -> Matrix:
        """What each step is predicted from (motors, regressors): what was left to set-points of the last cycles.

        Not from its last steps: of a motor that stands one would predict that it stands.
        """
        return (self.past[0] - self.past[1][1]).T

    @property
    def tension_change(self) -> Vector:
        """Over three cycles [N]."""
        return self.past[2][0] - self.past[2][_OVER]

    @property
    def current(self) -> Matrix:
        """What that follows from (motors, features)."""
        return self.x[0] - self.x[_OVER]

    def taut(self, model: Matrix) -> Vector:
        """Return what of the tensions friction and damping do not explain by `model` (motors, features) [N]."""
        return self.past[2][0] - np.einsum("ij,ij->i", model[:, self.x.shape[1] :], self.x[0][:, self.x.shape[1] :])


def motor_names(motors: int) -> list[tuple[str, int]]:
    """Return (event, motor from 0) of each chart."""
    alone = [(name, i) for name in ("motor_jammed", "jump") for i in range(motors)]
    return alone + [("current_scale", i) for _ in (*SCALES, *SCALES) for i in range(motors)]


class MotorCharts:
    """The charts of all motors.

    Attributes:
        features: of this cycle.
        scores: of the last cycle, in the order of `motor_names`.
        charts: their sums.
    """

    def __init__(self, baseline: Baseline, thresholds: Vector | None = None) -> None:
        """Begin; `thresholds` other than the baseline's are for calibrating."""
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
        """Whether the tendons carry no more than in the experiments: a scale that is wrong shows in all but its own."""
        return bool(self._load[1].max() >= self._b.load_low)

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
            return self._judged(self._jumped)
        self._functions.supervised_motors(
            self._model, _RULES, f.past, f.x, self._white, self._rest, self._scales, self._b.cycle, self.scores
        )
        at = (2 + len(SCALES)) * n
        self._functions.supervised_levels(
            self._levels, _RULES, f.past, f.x, self._rest, self._scales, self._load, self.scores[at:]
        )
        if not self.known_load:
            # As for the tilt: nobody saw how such a load is shared.
            self.scores[2 * n :] = SUPERVISED_NOT
        found = self.charts.step(self.scores)
        if found < 0:
            return None
        name, motor = self._names[found]
        if name == "jump":
            self._jump, self._jumped = (_JUDGED, float(f.moved[motor]), 0.0, 0.0, 0.0), motor
            return None
        if name == "current_scale":
            times = SCALES[(found // n - 2) % len(SCALES)]
            return name, motor, f"motor {motor + 1}: its current is about {times:g} times what its motion takes"
        return name, motor, f"motor {motor + 1} at {positions[motor]:.2f} rad, set-point {setpoints[motor]:.2f} rad"

    def _judged(self, motor: int) -> tuple[str, int, str] | None:
        """Say what a jump was: a drive whose encoder slipped leads its winch back, one that was misread does not."""
        f, (left, jumped, slipped, misread, went) = self.features, self._jump or (0, 0.0, 0.0, 0.0, 0.0)
        asked = float(self._model[0][motor] @ f.drive[motor])
        # A drive that is where it was, whatever it says, still has to go what it had to.
        slipped, misread = slipped + asked, misread + asked + float(self._model[0][motor].sum()) * jumped
        moved = float(f.moved[motor])
        went += moved
        text = f"motor {motor + 1} jumped by {jumped:.2f} rad in one cycle"
        if moved * jumped < 0.0 and abs(moved) > 0.5 * abs(jumped):
            return "position_bad", motor, f"{text}, and back in another"
        self._jump = (left - 1, jumped, slipped, misread, went)
        if left > 1:
            return None
        if abs(went - misread) > _BACK * abs(slipped - misread):
            return "encoder_slip", motor, f"{text}, and its drive turns the winch after it"
        return "position_bad", motor, f"{text}, and its drive does not answer to it"
