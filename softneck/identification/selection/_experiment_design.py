"""The next experiment: motions on which the members disagree, or which leave the training range.

A sample's doubt, `s^2 = spread of the members^2 + (slope d)^2` with d the distance from the set-points seen, falls by
`1 - k^2` where the nearest recorded sample has the correlation k with it (a kernel of length `_KERNEL_LENGTH`). The sum
is submodular: taking the best motion first reaches 63 % of the best choice at least (Nemhauser, Wolsey and Fisher 1978;
Krause, Singh and Guestrin 2008). What the members share, they do not know.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    ReprMixin,
    SettingsError,
    Vector,
    one_blas_thread,
    require_between,
    silent,
    to_si,
)
from softneck.robot import Robot
from softneck.signals import Excitation, Recording, SetPointLimits, prepare, signal

from ..models._arrays import members, own_arrays
from ..models._fitting import in_display_unit
from ..models._model import Model

# Of what each signal asks for: small motions show friction, large ones what bends.
_SIZE_FACTORS = (0.5, 0.75, 1.0)
# Of the signals' own pace; `rotation`, `aprbs` and `multisine` are as fast as the paper's at 1.
_SPEED_FACTORS = (0.5, 1.0, 2.0)
_SIGNAL_NAMES = ("eq22", "aprbs", "multisine", "rotation")
# Parts of `mixed` in which one motor moves at a time, and all alike: from which to which part of its length.
_PARTS_OF_MIXED = {"single_tendon": (0.88, 0.95), "cocontraction": (0.95, 1.0)}
# How long that is [s]: each part of it is played again and again.
_MIXED_LENGTH_S = 120.0
# [s] from rest into each motion and back.
RAMP = 1.0


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Bounds:
    """The limits of set-points (motors,) in SI; `speed` is the largest change by the time, of any motor."""

    lowest: Vector
    highest: Vector
    speed: float

    @classmethod
    def of(cls, robot: Robot, limits: SetPointLimits | None = None) -> Bounds:
        """Return the bounds of a robot, and `limits` within them; SettingsError where nothing is left between them."""
        motors, scale, inside = robot.motors, to_si(robot.motors.unit)[0], limits or SetPointLimits(position=math.inf)
        count = len(motors.names)
        low, high = (
            scale * np.array(given) if given is not None else np.full(count, side)
            for given, side in ((motors.setpoint_min, -math.inf), (motors.setpoint_max, math.inf))
        )
        speed = min(inside.speed, scale * min(motors.rate_limit) if motors.rate_limit else math.inf)
        low, high = np.maximum(low, inside.lowest), np.minimum(high, inside.position)
        if (low >= high).any():
            j = int(np.argmax(low >= high))
            raise SettingsError(f"motor {j + 1} may move from {low[j]:g} to {high[j]:g} only; widen its limits.")
        return cls(lowest=low, highest=high, speed=speed)

    @property
    def rest(self) -> Vector:
        """Set-points at start and end (motors,): zero, or the nearest within the limits."""
        return np.clip(0.0, self.lowest, self.highest)

    def within(self, P: Matrix, sample_time: float) -> Matrix:
        """Return set-points (time, motors) that begin and end at rest and keep the bounds."""
        moved = Excitation("", np.arange(len(P)) * sample_time, np.clip(P, self.lowest, self.highest) - self.rest,
                           sample_time)  # fmt: skip
        return (
            prepare(moved, SetPointLimits(position=math.inf, speed=self.speed), ramp_s=RAMP)[0].set_points + self.rest
        )


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """One motion: a signal, its size and speed factors, and its set-points (time, motors)."""

    signal: str
    size: float
    speed: float
    set_points: Matrix

    def __str__(self) -> str:
        return f"{self.signal}, {self.size:g} of its size at {self.speed:g} times its speed"


def motions(robot: Robot, sample_time: float, rows: int, bounds: Bounds, seed: int) -> list[Motion]:
    """Return motions of `rows` rows each: every signal in every size and speed."""
    found = []
    for name, speed, P in _signals(robot, sample_time, rows, seed):
        found += [Motion(name, size, speed, bounds.within(size * P, sample_time)) for size in _SIZE_FACTORS]
    return found


def _signals(robot: Robot, sample_time: float, rows: int, seed: int) -> Iterator[tuple[str, float, Matrix]]:
    """Yield name, speed and set-points (rows, motors)."""
    # At the sample time of the data, which a robot file need not give.
    robot = replace(robot, sample_time_s=sample_time)
    longest = (rows * max(_SPEED_FACTORS) + 1) * sample_time
    mixed = signal("mixed", duration=_MIXED_LENGTH_S, seed=seed, robot=robot).set_points
    for number, speed in enumerate(_SPEED_FACTORS):
        # Slower or faster: read at other instants.
        at = np.arange(rows) * speed
        for name in _SIGNAL_NAMES:
            # Other levels and phases at each speed.
            P = signal(name, duration=longest, seed=seed + number, robot=robot).set_points
            yield name, speed, np.column_stack([np.interp(at, np.arange(len(P)), column) for column in P.T])
        for name, share in _PARTS_OF_MIXED.items():
            start, stop = (round(part * len(mixed)) for part in share)
            yield name, speed, mixed[start + (at.astype(int) % (stop - start))]


# Of a motion, ramps included [s]; a sequence has whole ones.
_MOTION_LENGTH_S = 10.0
_MIN_DURATION_S, _MAX_DURATION_S = 4.0 * RAMP, 3600.0
# Samples are compared so often, and their change taken over so long [s].
_FEATURE_PERIOD_S, _CHANGE_PERIOD_S = 0.2, 0.4
# Of the kernel, in standard deviations of set-points and changes over all motions.
_KERNEL_LENGTH = 0.5


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Known:
    """The models that run free, and the data before the experiment.

    seen: (points, motors) set-points that stand for all that were seen; reach: how far any was from the nearest of
    them; slope: (outputs,) how the doubt grows with the distance from them; sample_time: [s]; said: where this is from.
    """

    models: tuple[Model, ...]
    seen: Matrix
    reach: float
    slope: Vector
    sample_time: float
    robot: Robot
    said: str

    @classmethod
    def of_model(cls, model: Model) -> Known:
        """Return the members and the training set-points of a guarded model; SettingsError for one of one piece."""
        if model.kind != "guarded":
            raise SettingsError(
                f"a model of kind `{model.kind}` has no members that could part; give one of kind `guarded`."
            )
        # The first is the base: it is another kind, and parts from the others everywhere.
        parts = [
            Model(kind=kind, sample_time=model.sample_time, arrays=arrays, robot=model.robot)
            for kind, arrays in members(model.arrays)[1:]
        ]
        own = own_arrays(model.arrays)
        return cls(
            models=tuple(parts),
            seen=own["seen"],
            reach=float(own["reach"][0]),
            slope=own["slope"],
            sample_time=model.sample_time,
            robot=model.robot,
            said=f"{len(parts)} members of {model.kind}",
        )


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """One motion of an experiment.

    Attributes:
        start_s: when it begins [s].
        motion: what is played.
        spread: rms over it of the members' spread, in SI.
        unseen: rms over it of the doubt for what was not seen, in SI.
        outside: the farthest of its set-points from what was seen, in SI.
    """

    start_s: float
    motion: Motion
    spread: float
    unseen: float
    outside: float


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class NextExperiment(ReprMixin):
    """The next experiment: its recording holds set-points, and as outputs what the members expect.

    before, after: rms doubt over all motions [SI], now and expected once this is recorded; said: who doubts.
    """

    recording: Recording
    parts: tuple[Part, ...]
    before: float
    after: float
    said: str

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON entry, in the display unit of the outputs."""
        robot, unit = self.recording.robot, self.recording.robot.outputs.display_unit
        shown = in_display_unit(robot, np.array([self.before, self.after]))
        parts = []
        for part in self.parts:
            spread, unseen = in_display_unit(robot, np.array([part.spread, part.unseen]))
            parts.append({
                "start_s": part.start_s, "signal": part.motion.signal, "size": part.motion.size,
                "speed": part.motion.speed, f"disagreement_{unit}": spread, f"unseen_{unit}": unseen,
                "why": _why(part, spread, unit, robot),
            })  # fmt: skip
        return {
            "members": self.said,
            f"disagreement_{unit}": {"before": shown[0], "expected_after": shown[1]},
            "parts": parts,
        }


@one_blas_thread
def next_experiment(
    known: Known, *, duration: float, seed: int = 0, bounds: Bounds | None = None, progress: Progress = silent
) -> NextExperiment:
    """Choose motions of `duration` [s] one after the other, each for the doubt that it removes beside those before.

    Motions that would lead an output beyond the robot's range are left out. `bounds` None takes the robot's.

    Raises:
        SettingsError: too short or too long, or no motion within the outputs' range.
        DataError: no member runs free.
    """
    require_between("duration", duration, _MIN_DURATION_S, _MAX_DURATION_S, "s")
    robot, Ts = known.robot, known.sample_time
    count = max(1, round(duration / _MOTION_LENGTH_S))
    rows, bounds = round(duration / Ts) // count, bounds or Bounds.of(robot)
    drawn, tried = motions(robot, Ts, rows, bounds, seed), []
    for number, motion in enumerate(drawn):
        progress(number / len(drawn), str(motion))
        tried.append(_Candidate.of(motion, known))
    tried = [one for one in tried if one.inside]
    if not tried:
        raise SettingsError("every motion leads an output out of the robot's range; lower --max-position.")
    doubt = np.concatenate([one.doubt for one in tried])
    cover = _coverage([one.features for one in tried])
    chosen, reached = _greedy(doubt, cover, count)
    parts, P, Y = [], [], []
    for number, i in enumerate(chosen):
        one = tried[i]
        parts.append(Part(number * rows * Ts, one.motion, one.spread, one.unseen, one.outside))
        P.append(one.motion.set_points)
        Y.append(one.expected)
    # What is left of whole parts: at rest.
    left = round(duration / Ts) - rows * count
    P.append(np.tile(bounds.rest, (left, 1)))
    Y.append(np.tile(Y[-1][-1], (left, 1)))
    before, after = (float(np.sqrt(np.mean(doubt * (1.0 - part)))) for part in (np.zeros(doubt.size), reached))
    progress(1.0, "done")
    return NextExperiment(_recording(robot, Ts, np.vstack(P), np.vstack(Y)), tuple(parts), before, after, known.said)


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A motion with its squared doubt and its features (samples, n), every `_FEATURE_PERIOD_S`."""

    motion: Motion
    expected: Matrix
    doubt: Vector
    features: Matrix
    spread: float
    unseen: float
    outside: float
    inside: bool

    @classmethod
    def of(cls, motion: Motion, known: Known) -> _Candidate:
        """Run the members over a motion."""
        from scipy.spatial import KDTree

        robot, Ts, P = known.robot, known.sample_time, motion.set_points
        outputs = len(robot.outputs.names)
        blank = _recording(robot, Ts, P, np.zeros((len(P), outputs)))
        runs = np.array([model.simulate(blank, warm_up=1)[:, :outputs] for model in known.models])
        runs = np.where(np.isfinite(runs), runs, np.inf)
        expected = np.median(runs, axis=0)
        if not np.isfinite(expected).all():
            raise DataError("most members diverge; record with `mixed`, or train others.")
        # One that diverges is as wrong as the motion is large.
        apart = np.minimum(np.abs(runs - expected), max(float(np.ptp(expected, axis=0).max()), 1e-9))
        variance = np.mean(apart**2, axis=0)
        distance = np.maximum(KDTree(known.seen).query(P)[0] - known.reach, 0.0)
        unseen = (distance[:, None] * known.slope) ** 2
        every = slice(None, None, max(round(_FEATURE_PERIOD_S / Ts), 1))
        back = max(round(_CHANGE_PERIOD_S / Ts), 1)
        change = P - np.vstack([np.repeat(P[:1], back, axis=0), P])[: len(P)]
        low, high = (
            np.full(outputs, side) if ends is None else np.array(ends)
            for ends, side in ((robot.outputs.min, -np.inf), (robot.outputs.max, np.inf))
        )
        scale = to_si(robot.outputs.unit)[0]
        return cls(
            motion, expected, np.mean(variance + unseen, axis=1)[every], np.hstack([P, change])[every],
            float(np.sqrt(variance.mean())), float(np.sqrt(unseen.mean())), float(distance.max()),
            bool((expected >= scale * low).all() and (expected <= scale * high).all()),
        )  # fmt: skip


def _coverage(features: Sequence[Matrix]) -> Matrix:
    """Return (samples, motions): the share of each sample's doubt that a record of each motion would remove."""
    from scipy.spatial import KDTree

    every = np.vstack(features)
    half = every.shape[1] // 2
    # Set-points among themselves, and changes: a motor that moves less says less.
    scale = np.repeat([max(float(every[:, part].std()), 1e-12) for part in (slice(half), slice(half, None))], half)
    distances = [KDTree(own / scale).query(every / scale)[0] for own in features]
    # k^2 = exp(-d^2 / length^2).
    return np.exp(-((np.column_stack(distances) / _KERNEL_LENGTH) ** 2))


def _greedy(doubt: Vector, cover: Matrix, count: int) -> tuple[list[int], Vector]:
    """Return `count` motions and the part of each sample's doubt (samples,) that they remove together."""
    reached, chosen = np.zeros(doubt.size), []
    for _ in range(count):
        gains = doubt @ np.maximum(cover - reached[:, None], 0.0)
        # Once all is known, again what was most in doubt.
        best = int(np.argmax(gains))
        chosen.append(best)
        reached = np.maximum(reached, cover[:, best])
    return chosen, reached


def _recording(robot: Robot, sample_time: float, P: Matrix, Y: Matrix) -> Recording:
    channels = dict(zip((*robot.set_points, *robot.outputs.names), (*P.T, *Y.T), strict=True))
    return Recording(np.arange(len(P)) * sample_time, sample_time, channels, robot=robot)


def _why(part: Part, spread: float, unit: str, robot: Robot) -> str:
    said = [f"members part by {spread:.2g} {unit}"] if part.spread > 0.0 else []
    if part.outside > 0.0:
        said.append(f"up to {part.outside / to_si(robot.motors.unit)[0]:.2g} {robot.motors.unit} from what was seen")
    return "; ".join(said) or "nothing is in doubt"
