"""The small guarded moves of a commissioning: one motor after the other out of its slack, a little further, and back.

Sans-I/O: samples go in, set-points come out. Nothing here knows which way a tendon pulls, how large a count is, or how
the sensor sits: a tendon is taut where the size of the tilt, or the motor's current, says so.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Generator, Sequence

import numpy as np

from softneck.core import Vector

from ..master import Master
from ..master._fieldbus import DriveView
from ..master._master import Measurement, Motors
from ._features import answer
from ._moves import (
    BACK,
    BLIND,
    FREE,
    HANGS,
    PERIOD,
    PULLED,
    REST,
    SWEEP,
    WIGGLE,
    WIGGLES,
    Guards,
    MotorMoves,
    counts_per_turn,
)

# Standing before a motor moves, and at each end of a slow way, which a late sensor must have seen [s].
_REST, _STAND = 1.0, 0.7
# Slowly until the encoder's index came twice: some turns of the motor, also of one with twice the lines [rad].
_INDEX_WAY = 1.2
# A tilt, or a current, is the mean of so many samples; it has changed where it stands out of the noise by this.
_MEAN, _OUT_OF_NOISE = 5, 4.0
# The current of turning alone is known after these times of even motion [s]. A tendon counts as taut once it rose by
# this part, and is not pulled beyond `_MOST` of it where no tilt shows.
_EVEN, _KNOWN, _RISE, _MOST = 0.4, 1.0, 0.8, 1.6
# Of that rise a tilt needs this part to be believed at once, or it has to be so many times as large.
_CONFIRMED, _SURE = 0.3, 1.6
# Slow ways up and down; of the quick wiggle below the top largest amplitude and tilt to either side [rad].
_SWEEPS, _WIGGLE, _WIGGLE_TILT = 3, 0.15, math.radians(0.25)
# The wiggle goes on until the tilt for a turn is known to this part, or for so many blocks of it.
_GAIN_ERROR, _BLOCKS = 0.08, 5
# From one motor to the next the sensor may drift, and the neck not come back, by this [rad].
_DRIFT = math.radians(0.5)
# The guard of the tilt gives way to this much of noise at the most [rad].
_NOISE = math.radians(0.7)
# No farther than this beyond where the search ended, slowly, and back [rad].
_OVERTRAVEL_RAD = 1.0
# Below this part of the tilt at the top a tendon is nearly slack, or hysteresis keeps the neck there; and surely slack
# this much further out [rad].
_LOOSE, _SLACK = 0.45, 0.3

_Steps = Generator[Motors, None, None]
_Until = Callable[[], bool]


class Mover:
    """The pilot of a commissioning: gives set-points and stores measurements.

    `done`: moves of each motor that is over. `stopped`: which guard ended the moves, "" if none did. `motor`: which one
    moves, from 1 on; 0 before the first. `captured`: counts at the newest index pulse of the motor that moves, None
    before the first; set by the code that reads the drives' objects.
    """

    def __init__(
        self, guards: Guards, nodes: Sequence[int], counts_per_radian: Sequence[float], turns: Sequence[float], *,
        motors: Sequence[int], sample_time: float,
    ) -> None:  # fmt: skip
        """Move `motors` (from 1 on) of those on `nodes`.

        `guards`: limits. `nodes`: of all drives. `counts_per_radian`, `turns`: of each winch and of each motor's turn
        [counts], as the drives file has them. `motors`: those that are to move. `sample_time`: [s].
        """
        self.guards, self._nodes, self._motors, self._step = guards, tuple(nodes), tuple(motors), sample_time
        self._signs = [math.copysign(1.0, scale) for scale in counts_per_radian]
        self._per_radian = [abs(scale) for scale in counts_per_radian]
        self._turns = tuple(turns)
        self.done: list[MotorMoves] = []
        self.stopped, self.motor, self._over = "", 0, False
        self.captured: int | None = None
        self._wanted = [0.0] * len(self._nodes)
        self._views: tuple[DriveView, ...] = ()
        self._script = self._all()
        self._phase, self._rows, self._captures = REST, list[tuple[float, ...]](), list[int]()
        self._time = self._begun_at = 0.0
        self._tight, self._most = "", math.inf
        self._upright: Vector | None = None
        self._level, self._noise = np.zeros(0), 0.0
        self._tilts: deque[Vector] = deque(maxlen=_MEAN)
        self._currents: deque[float] = deque(maxlen=_MEAN)

    def watch(self, master: Master) -> None:
        """Read counts and currents from `master`; to be called before its first cycle."""
        self._views = master.bus.drives

    @property
    def progress(self) -> float:
        """Part of the motors that is done."""
        return len(self.done) / max(len(self._motors), 1)

    # -- a pilot ------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Begin with the first motor."""

    def is_finished(self, index: int) -> bool:
        """Return whether all motors were moved."""
        del index
        return self._over

    def step(self, measured: Measurement) -> Motors | None:
        """Return the set-points of this sample."""
        self._time = measured.index * self._step
        self._take(measured)
        if not self.stopped:
            self._over = next(self._script, None) is None
        return tuple(self._wanted)

    def _take(self, measured: Measurement) -> None:
        outputs = np.array(measured.tilt.values)
        if measured.fresh:
            self._tilts.append(outputs)
            self._guard_tilt()
        if not self.motor:
            return
        view = self._views[self.motor - 1]
        self._currents.append(view.current)
        told = outputs if measured.fresh else np.full(outputs.shape, np.nan)
        self._rows.append((self._phase, self._time, view.counts, view.current, *told.tolist()))
        if self.captured is not None and (not self._captures or self._captures[-1] != self.captured):
            self._captures.append(self.captured)
        self._guard_motor(measured.positions[self.motor - 1])

    # -- guards: what goes beyond is said once, and whoever runs this stops the drives ---------------------------

    def _guard_tilt(self) -> None:
        if self._upright is None or len(self._tilts) < 3:
            return
        # The median of three: one sample that is off stops nothing, and a tilt is told 20 ms later.
        recent = np.array(list(self._tilts)[-3:])
        # What the sensor's noise may add is not tilt.
        noise = min(2.0 * self._noise, _NOISE)
        for before, most in (
            (self._level, self.guards.tilt + noise),
            (self._upright, self.guards.tilt + noise + _DRIFT),
        ):
            size = float(np.median(np.linalg.norm(recent - before, axis=1)))
            if size > most:
                self.stopped = f"tilt: {math.degrees(size):.1f} deg, {math.degrees(most):.1f} are allowed"

    def _guard_motor(self, position: float) -> None:
        guards = self.guards
        if abs(position) > 1.05 * guards.travel + 0.2:
            self.stopped = f"travel: motor {self.motor} is {abs(position):.1f} rad from where it stood"
        if self._time - self._begun_at > guards.time:
            self.stopped = f"time: motor {self.motor} took longer than {guards.time:g} s"

    # -- the moves: generators that give a set-point each sample -------------------------------------------------

    def _all(self) -> _Steps:
        yield from self._stand(_REST)
        self._upright = self._level = np.mean(self._tilts, axis=0)
        for motor in self._motors:
            yield from self._one(motor)

    def _one(self, motor: int) -> _Steps:
        self.motor, self._begun_at, self.captured = motor, self._time, None
        self._phase, self._rows, self._captures = REST, [], []
        yield from self._stand(_REST)
        outputs = np.array([row[4:] for row in self._rows])
        self._level, self._noise = np.nanmean(outputs, axis=0), float(np.linalg.norm(np.nanstd(outputs, axis=0)))
        outcome, way = yield from self._search()
        if outcome == PULLED:
            yield from self._measure(way)
        self._phase = BACK
        yield from self._go(0.0, self.guards.speed)
        if not self._index_seen:
            # Where there was no slack: on a way out that pulls nothing.
            yield from self._go(-way * _INDEX_WAY, self.guards.speed, lambda: self._index_seen)
            yield from self._go(0.0, self.guards.speed)
        yield from self._stand(_STAND)
        self.done.append(self._collect_moves(outcome, way))
        self.motor = 0

    def _search(self) -> Generator[Motors, None, tuple[str, int]]:
        """Go the way that should pull, the other one, and the first again farther, until the tendon is taut."""
        self._phase, travel = FREE, self.guards.travel
        taut = self._contact(1)
        yield from self._go(_INDEX_WAY, self.guards.speed, lambda: bool(self._index_seen or taut()))
        for end in (0.6 * travel, -travel, travel):
            way = 1 if end > self._at else -1
            while self._tight or abs(end - self._at) > 1e-9:
                if not self._tight:
                    yield from self._go(end, self.guards.speed * self._scale, self._contact(way))
                if not self._tight:
                    break
                told, outcome = self._tight, (yield from self._taut(way))
                # A tilt that is gone while the motor stands was the sensor's noise.
                if outcome[0] == PULLED or told == "current":
                    return outcome
                self._tight = ""
        return HANGS, 0

    def _contact(self, way: int) -> _Until:
        """Return the test for a taut tendon on the move that begins now, by tilt or by current."""
        since, even = self._time, list[float]()
        sign = way * self._signs[self.motor - 1]
        self._tight, self._most = "", math.inf

        def taut() -> bool:
            passed, size = self._time - since, self._size()
            if passed < _KNOWN:
                even.extend([sign * self._currents[-1]] if passed > _EVEN else [])
                self._tight = "tilt" if size > _SURE * self._seen else ""
            else:
                turning, spread = float(np.mean(even)), float(np.std(even)) / math.sqrt(_MEAN)
                rise = max(_RISE * abs(turning), _OUT_OF_NOISE * spread, 1.0)
                self._most = turning + _MOST / _RISE * rise
                risen = (sign * float(np.mean(self._currents)) - turning) / rise
                # A tilt that the current does not confirm may be drift of the sensor, and has to be a larger one.
                if size > _SURE * self._seen or (size > self._seen and abs(risen) > _CONFIRMED):
                    self._tight = "tilt"
                elif risen > 1.0:
                    self._tight = "current"
            return bool(self._tight)

        return taut

    def _taut(self, way: int) -> Generator[Motors, None, tuple[str, int]]:
        """Check that the sensor sees the taut tendon; after contact by current alone, move a little farther."""
        yield from self._stand(_STAND)
        if self._tight == "current" and self._size() < self._seen:
            sign, most = way * self._signs[self.motor - 1], self._most
            end = self._at + way * _OVERTRAVEL_RAD * self._scale

            def enough() -> bool:
                return self._size() > self._seen or sign * float(np.mean(self._currents)) > most

            yield from self._go(end, self.guards.slow * self._scale, enough)
            yield from self._stand(_STAND)
        return (PULLED, way) if self._size() > 0.5 * self._seen else (BLIND, way)

    def _measure(self, way: int) -> _Steps:
        """Slowly back into the slack, up and down under tension, and wiggle at the top."""
        self._phase, slow, far = SWEEP, self.guards.slow * self._scale, way * _OVERTRAVEL_RAD * self._scale
        top, begin, pulled = self._at, 0, self._tilt() / self._size()

        def away() -> bool:
            """Whether it tilts to the side that it was pulled to: a tendon that was taut before lets it go beyond."""
            return float(self._tilt() @ pulled) > 0.0

        for _ in range(_SWEEPS):
            yield from self._go(self._at - far, slow, lambda: not away() or self._size() < _LOOSE * self.guards.target)
            yield from self._go(self._at - way * _SLACK * self._scale, slow)
            yield from self._stand(_STAND)
            begin = len(self._rows)
            yield from self._go(top + far, slow, lambda: away() and self._size() > self.guards.target)
            top = self._at
            yield from self._stand(_STAND)
        slope = self._slope(begin)
        begin, self._phase = len(self._rows), WIGGLE
        amplitude = way * min(_WIGGLE_TILT / slope, _WIGGLE * self._scale) if slope > 0.0 else 0.0
        for _ in range(_BLOCKS):
            for k in range(round(WIGGLES * PERIOD / self._step)):
                self._put(top - amplitude * (1.0 - math.cos(2.0 * math.pi * k * self._step / PERIOD)))
                yield tuple(self._wanted)
            rows = np.array(self._rows[begin:])
            if answer(rows[:, 1], rows[:, 2], rows[:, 4:]).error < _GAIN_ERROR:
                break
        self._put(top)
        yield from self._stand(_STAND)

    def _slope(self, begin: int) -> float:
        """Return the tilt for one radian of the set-point's own scale on the last way up [rad/rad]."""
        rows = np.array(self._rows[begin:])
        # Hysteresis leaves a tilt in the slack as well.
        size = np.linalg.norm(rows[:, 4:] - np.nanmean(rows[: max(len(rows) // 3, 1), 4:], axis=0), axis=1)
        upper = size > 0.4 * np.nanmax(size)
        if upper.sum() < 2 * _MEAN or np.ptp(rows[upper, 2]) == 0.0:
            return 0.0
        slopes = np.polyfit(rows[upper, 2], rows[upper, 4:], 1)[0]
        return float(np.linalg.norm(slopes)) * self._per_radian[self.motor - 1]

    # -- small things -------------------------------------------------------------------------------------------

    @property
    def _index_seen(self) -> bool:
        return len(self._captures) >= 3

    @property
    def _scale(self) -> float:
        """How many radians of the drives file one of the winch is, as far as the encoder's index tells: 1/4 to 4."""
        turn = counts_per_turn(self._captures)
        return min(max(turn / self._turns[self.motor - 1], 0.25), 4.0) if turn else 1.0

    @property
    def _at(self) -> float:
        return self._wanted[self.motor - 1]

    @property
    def _seen(self) -> float:
        """The least tilt that counts: `contact`, or the noise level if larger [rad]."""
        return max(self.guards.contact, _OUT_OF_NOISE * self._noise / math.sqrt(_MEAN))

    def _tilt(self) -> Vector:
        return np.mean(self._tilts, axis=0) - self._level

    def _size(self) -> float:
        return float(np.linalg.norm(self._tilt()))

    def _put(self, position: float) -> None:
        self._wanted[self.motor - 1] = position

    def _stand(self, seconds: float) -> _Steps:
        for _ in range(round(seconds / self._step)):
            yield tuple(self._wanted)

    def _go(self, end: float, speed: float, until: _Until = lambda: False) -> _Steps:
        """Move the motor to `end` [rad], or until a test says that it is far enough."""
        step = speed * self._step
        while abs(end - self._at) > 1e-9 and not until():
            self._put(self._at + min(max(end - self._at, -step), step))
            yield tuple(self._wanted)

    def _collect_moves(self, outcome: str, way: int) -> MotorMoves:
        rows = np.array(self._rows)
        return MotorMoves(
            self.motor, self._nodes[self.motor - 1], outcome, way, rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3],
            rows[:, 4:], tuple(self._captures),
        )  # fmt: skip
