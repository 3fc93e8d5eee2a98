"""What the plausibility supervisor is tried with: a commissioning run, closed and open loops, and what breaks."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softneck.drives import default_drives
from softneck.drives.commissioning._record import drive_limits
from softneck.drives.master import Phase
from softneck.drives.master._measured import Measurement
from softneck.drives.simulated import SimulatedNeck
from softneck.drives.simulated._servo_runtime import SERVO_POSITION, SERVO_SCALE, SERVO_ZERO
from softneck.drives.supervision._baseline import Baseline, load_baseline
from softneck.drives.supervision._calibrate import calibrate
from softneck.drives.supervision._log import MotionLog
from softneck.drives.supervision._motor_models import Motion
from softneck.plant import NeckParameters
from softneck.signals import prepare, signal

from .bench import TS, Bench, T
from .direct import DirectBus, direct

BASELINE = Path(__file__).with_name("paper.supervision.json")
# What a commissioning run plays: name, length [s], seed, farthest [rad] and fastest [rad/s] set-points. None of them
# overloads a motor: one at its current limit stands still as a jammed one does.
COMMISSIONING = (
    ("mixed", 60.0, 11, 6.0, 3.9),
    ("eq22", 60.0, 12, 6.0, 3.9),
    ("aprbs", 60.0, 13, 1.5, 12.0),
    ("multisine", 60.0, 14, 6.0, 3.9),
)
# What the neck carries in it [kg].
PAYLOADS = (0.0, 0.5)
PATH = math.radians(3.0)

# At rest before a loop moves, as after the ramp in of a real run [samples].
_CALM = 75


class Tracker:
    """A PI controller behind references that jump or ramp at random times; or slow random set-points.

    Attributes:
        reference: of the last sample [rad]; () while there is none.
    """

    def __init__(self, seed: int, kind: str, size: float = 1.0) -> None:
        self._size = 0.65 * size
        self._rng, self.kind = np.random.default_rng(seed), kind
        self._integral, self._aim, self._goal, self._next = (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), _CALM
        self.reference: tuple[float, ...] = ()
        self._phase = self._rng.uniform(0.0, 6.28, (3, 6))
        self._pace = np.exp(self._rng.uniform(math.log(0.3), math.log(4.0), (3, 6)))

    def __call__(self, measured: Measurement) -> tuple[float, ...]:
        if measured.index < _CALM:
            return 0.0, 0.0, 0.0
        if self.kind == "open":
            t = TS * max(0, measured.index - _CALM)
            P = min(1.0, t / 3.0) * self._size * np.sin(self._pace * t + self._phase).sum(axis=1)
            return tuple(np.clip(P - 0.7 * P.mean(), -4.0, 4.0))
        if measured.index >= self._next:
            way, far = self._rng.uniform(0.0, 2.0 * math.pi), math.radians(self._rng.uniform(3.0, 15.0))
            self._goal = far * math.cos(way), far * math.sin(way)
            self._next = measured.index + int(self._rng.integers(50, 300))
        left = [goal - now for goal, now in zip(self._goal, self._aim, strict=True)]
        most = math.inf if self.kind == "step" else TS * math.radians(12.0)
        share = min(1.0, most / max(math.hypot(*left), 1e-9))
        pitch, roll = (now + share * way for now, way in zip(self._aim, left, strict=True))
        self._aim = self.reference = pitch, roll
        # Eq. 31 is 0.091 rad/rad behind 0.19 s: crosses over at 2.4 rad/s.
        error = pitch - measured.tilt.values[0], roll - measured.tilt.values[1]
        self._integral = self._integral[0] + 21.0 * TS * error[0], self._integral[1] + 21.0 * TS * error[1]
        theta, phi = 5.0 * error[0] + self._integral[0], 5.0 * error[1] + self._integral[1]
        return 2.0 / 3.0 * theta, -theta / 3.0 + phi / math.sqrt(3.0), -theta / 3.0 - phi / math.sqrt(3.0)


@cache
def baseline() -> Baseline:
    """Of the paper's neck on default drives: `benchmarks/supervisor.py baseline` wrote it."""
    return load_baseline(BASELINE)


def commissioned(neck: NeckParameters | None = None, payloads: tuple[float, ...] = PAYLOADS) -> Baseline:
    """Play the commissioning run in virtual time with each payload [kg] and calibrate."""
    motions = [motion for payload in payloads for motion in experiments(neck, payload)]
    return calibrate(motions, cycle=T, sample_cycles=2, slack=default_drives().limits.slack)


def experiments(neck: NeckParameters | None, payload: float) -> list[Motion]:
    """Play the commissioning run in virtual time."""
    motions: list[Motion] = []
    for name, seconds, seed, position, speed in COMMISSIONING:
        bench = Bench(neck=neck, seed=seed)
        bench.neck.set(payload=payload)
        direct(bench.start())
        log = MotionLog()
        bench.run.watches = (log,)
        bench.pilot.wanted = (0.0, 0.0, 0.0)
        bench.pass_time(2.0)
        limits = drive_limits(default_drives(), position=position, speed=speed)
        played, _ = prepare(signal(name, duration=seconds, seed=seed), limits, ramp_s=2.0)
        rows, begin = np.asarray(played.set_points), bench.pilot.steps
        bench.pilot.act = lambda _, b=bench, P=rows, k=begin: tuple(P[min(len(P) - 1, b.pilot.steps - k - 1)])
        bench.pass_time(seconds)
        assert bench.phase is Phase.RUNNING, bench.master.supervisor.fault
        motions.append(log.motion())
    return motions


def watched(
    seed: int,
    kind: str,
    payload: float = 0.0,
    *,
    off: frozenset[str] = frozenset(),
    gyro: bool = True,
    judged: Baseline | None = None,
    framed: bool = False,
) -> Bench:
    """Return a bench whose master compares with `judged`, where there is one, when its run has begun."""
    bench = Bench(seed=seed, change=lambda settings: replace(settings, baseline=judged), off=off)
    bench.neck.set(payload=payload)
    if not gyro:
        sampled(bench, lambda _, values, __: (values, (math.nan, math.nan)))
    bench.pilot.wanted = (0.0, 0.0, 0.0)
    bench.start()
    if not framed:
        direct(bench)
    # Under a load tendons hang earlier: open loops go less far, so as not to be stopped for it.
    bench.pilot.act = Tracker(seed, kind, 1.0 - 0.7 * payload)
    return bench


# -- what breaks ----------------------------------------------------------------------------------------------------

Spoil = Callable[[float, tuple[float, ...], tuple[float, ...]], tuple[tuple[float, ...], tuple[float, ...]]]


def sampled(bench: Bench, spoil: Spoil) -> None:
    """Change each sample of the inclinometer: `spoil(now, values, rates)` returns the two."""
    neck = bench.neck
    assert isinstance(neck, SimulatedNeck)
    take = neck._sampled

    def taken(now: float):
        sample = take(now)
        values, rates = spoil(now, sample.values, sample.rates)
        return sample._replace(pitch=values[0], roll=values[1], pitch_rate=rates[0], roll_rate=rates[1])

    neck._sampled = taken


def slips(bench: Bench, by: float = 1.0) -> None:
    m = bench.neck.motion[0]
    m[SERVO_ZERO] += by * m[SERVO_SCALE]
    m[SERVO_POSITION] += round(by * m[SERVO_SCALE])


def misreads(bench: Bench, cycles: int = 10, by: float = 1.0) -> None:
    """Ten frames of motor 1 that say it is elsewhere."""
    bus = bench.master.bus
    assert isinstance(bus, DirectBus)
    bus.counts_off[0] = round(by * bench.neck.motion[0, SERVO_SCALE])
    bench.at(bench.now + cycles * T, lambda _: bus.counts_off.__setitem__(0, 0))


def peak_current(bench: Bench, factor: float) -> None:
    axis = bench.neck.drives[0].axis
    axis.peak_current *= factor
    axis._configure()


def gear(bench: Bench, factor: float, motor: int = 0) -> None:
    """The winch has another gear than the file says: at rest, where it shows nothing."""
    bench.neck.motion[motor, SERVO_SCALE] *= factor


def stuck(bench: Bench, noise: float, *, rates: bool = True) -> None:
    held = bench.neck.newest.values
    rng = np.random.default_rng(bench.neck.settings.seed)
    # A gyro has a chip of its own: it goes on, or the whole unit hangs.
    sampled(bench, lambda _, __, r: (tuple(held + noise * rng.standard_normal(2)), r if rates else (0.0, 0.0)))


def late(bench: Bench, by: float = 0.2) -> None:
    past: list[tuple[tuple[float, ...], tuple[float, ...]]] = []

    def spoil(_: float, values: tuple[float, ...], rates: tuple[float, ...]):
        past.append((values, rates))
        return past[max(0, len(past) - 1 - round(by / TS))]

    sampled(bench, spoil)


def drifts(bench: Bench, rate: float) -> None:
    begin = bench.now
    sampled(bench, lambda now, values, rates: ((values[0] + rate * (now - begin), values[1]), rates))


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        breaks: it, at a random time; from the start where `early`.
        names: of the events that name it; the first is the right one, others where sensors cannot tell it apart.
        excited: what must have happened since in the run without the fault: "position" of motor 1 and "tilt" moved so
            far [rad]; "pulls": in so many cycles its tension changed by 0.25 N within three.
        limit: time to the event after that [s].
        early: the fault is there before the run begins.
        gyro: whether the sensor has one.
    """

    breaks: Callable[[Bench], object]
    names: tuple[str, ...]
    excited: tuple[str, float]
    limit: float = 0.5
    early: bool = False
    gyro: bool = True


DEG = math.radians(1.0)
AT_ONCE, BY_TILT, BY_PULLS = ("", 0.0), ("tilt", 2 * DEG), ("pulls", 25.0)


def reversed_(bench: Bench) -> None:
    sampled(bench, lambda _, v, r: ((-v[0], v[1]), (-r[0], r[1])))


def swapped(bench: Bench) -> None:
    sampled(bench, lambda _, v, r: (v[::-1], r[::-1]))


# By the time it is found angles and gyro have wandered apart by half as much without any fault.
DRIFT = ("sensor_drift", "sensor_stuck", "tilt_unexplained")

# The names behind the first are of what looks the same, see docs/theory/plausibility.md.
ROWS: dict[str, Row] = {
    "motor jams": Row(lambda b: b.neck.block(1), ("motor_jammed",), ("position", 0.1)),
    "encoder slips 1 rad": Row(slips, ("encoder_slip",), AT_ONCE),
    "ten bad TPDO frames": Row(misreads, ("position_bad",), AT_ONCE),
    "peak current x 2": Row(lambda b: peak_current(b, 2.0), ("current_scale",), BY_PULLS),
    "peak current x 1/2": Row(lambda b: peak_current(b, 0.5), ("current_scale", "following", "motor_jammed"), BY_PULLS),
    "gear x 2": Row(lambda b: gear(b, 2.0), ("gear_wrong", "current_scale"), BY_TILT, early=True),
    "gear x 1/2": Row(lambda b: gear(b, 0.5), ("gear_wrong", "current_scale"), BY_TILT, early=True),
    "sensor stuck, 0.005 deg of noise": Row(
        lambda b: stuck(b, 0.005 * DEG), ("sensor_noise", "sensor_stuck", "sensor_drift"), AT_ONCE
    ),
    "sensor stuck, 0.05 deg of noise": Row(
        lambda b: stuck(b, 0.05 * DEG), ("sensor_stuck", "sensor_drift", "sensor_late"), BY_TILT
    ),
    "sensor 200 ms late": Row(late, ("sensor_late", "sensor_stuck"), BY_TILT),
    "sensor reversed": Row(reversed_, ("sensor_reversed",), BY_TILT, early=True),
    "sensor swapped": Row(swapped, ("sensor_swapped",), BY_TILT, early=True),
    "bias +0.5 deg/s": Row(lambda b: drifts(b, 0.5 * DEG), DRIFT, AT_ONCE, limit=4.0),
    "bias -0.5 deg/s": Row(lambda b: drifts(b, -0.5 * DEG), DRIFT, AT_ONCE, limit=4.0),
    "bias +0.5 deg/s, no gyro": Row(
        lambda b: drifts(b, 0.5 * DEG), ("tilt_unexplained", "sensor_stuck"), AT_ONCE, limit=4.0, gyro=False
    ),
}


@dataclass(frozen=True)
class Outcome:
    """How one run with a fault went.

    Attributes:
        event: that ended it, "" for none; after: it was excited [s].
        beyond: farthest that the true tilt went from the path without the fault until then [rad].
        excited: whether the run excited the fault at all.
    """

    event: str
    after: float
    beyond: float
    excited: bool


class Calm(NamedTuple):
    """A run without any fault, cycle by cycle: what its master saw, and the true tilt [rad]."""

    begin: float
    positions: np.ndarray
    tensions: np.ndarray
    tilt: np.ndarray


def kind_of(seed: int) -> str:
    return ("step", "ramp", "open")[seed % 3]


@lru_cache(maxsize=4)
def calm_run(seed: int, payload: float, seconds: float) -> Calm:
    bench = watched(seed, kind_of(seed), payload, judged=None)
    begin, rows = bench.now, []
    for _ in range(round(seconds / T)):
        bench.step()
        rows.append((bench.master.positions, bench.master.tensions, tuple(tilt_of(bench))))
    return Calm(begin, *(np.array(column) for column in zip(*rows, strict=True)))


def tilt_of(bench: Bench) -> np.ndarray:
    return bench.neck.outputs[:2]


def play(
    row: Row,
    seed: int,
    *,
    payload: float = 0.0,
    off: frozenset[str] = frozenset(),
    most: float = 12.0,
    judged: Baseline | None = None,
) -> Outcome:
    """Break it at a time that `seed` chooses, beside the same run without the fault."""
    calm = calm_run(seed, payload, 7.0 + most)
    bench = watched(seed, kind_of(seed), payload, off=off, gyro=row.gyro, judged=judged or baseline())
    k = 0 if row.early else break_at(seed)
    for _ in range(k):
        bench.step()
    return _broken(row, bench, calm, k, most)


def play_all(
    rows: Mapping[str, Row], seed: int, *, payload: float = 0.0, most: float = 12.0
) -> Iterator[tuple[str, Outcome]]:
    """Do what `play` does with each of `rows`; what is common to them is played once, and each goes on from a fork."""
    calm = calm_run(seed, payload, 7.0 + most)
    for gyro in (True, False):
        ours = {name: row for name, row in rows.items() if row.gyro is gyro}
        if not ours:
            continue
        bench = watched(seed, kind_of(seed), payload, gyro=gyro, judged=baseline())
        for name, row in ours.items():
            if row.early:
                yield name, _forked(row, bench, calm, 0, most)
        k = break_at(seed)
        for _ in range(k):
            bench.step()
        for name, row in ours.items():
            if not row.early:
                yield name, _forked(row, bench, calm, k, most)


def break_at(seed: int) -> int:
    """Return the cycle in which the fault comes."""
    return math.ceil(np.random.default_rng([seed, 77]).uniform(3.0, 7.0) / T)


def _forked(row: Row, bench: Bench, calm: Calm, k: int, most: float) -> Outcome:
    """Go on with the fault in a child, so that the bench stays as it is."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            found = json.dumps(asdict(_broken(row, bench, calm, k, most)))
            os.write(writer, found.encode())
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as file:
        text = file.read()
    os.waitpid(child, 0)
    return Outcome(**json.loads(text))


def _broken(row: Row, bench: Bench, calm: Calm, k: int, most: float) -> Outcome:
    """Break a bench at cycle `k` of its run and say how it goes."""
    row.breaks(bench)
    first, last = k, k + round(most / T)
    excited = _excited(row, calm, first)
    beyond = 0.0
    while bench.phase is Phase.RUNNING and k < last:
        bench.step()
        beyond = max(beyond, float(np.hypot(*(tilt_of(bench) - calm.tilt[k]))))
        k += 1
    fault = bench.master.supervisor.fault
    if fault is None:
        return Outcome("", math.inf, beyond, excited < last)
    return Outcome(fault.name, (k - 1 - min(excited, k - 1)) * T, beyond, excited < k)


def _excited(row: Row, calm: Calm, first: int) -> int:
    """Return the cycle from which on the run without the fault excited it since `first`."""
    what, by = row.excited
    if not what:
        return first
    start = max(first - 1, 0)
    if what == "pulls":
        change = np.abs(calm.tensions[3:, 0] - calm.tensions[:-3, 0])
        moved = np.cumsum(np.concatenate([np.zeros(3), change > 0.25]) * (np.arange(len(calm.tensions)) >= first))
    elif what == "tilt":
        moved = np.abs(calm.tilt[:, 0] - calm.tilt[start, 0])
    else:
        moved = np.abs(calm.positions[:, 0] - calm.positions[start, 0])
    at = np.flatnonzero(moved[first:] > by)
    return first + int(at[0]) if len(at) else len(moved)
