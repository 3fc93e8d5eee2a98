"""What breaks in front of the plausibility supervisor: the rows of its table, and how a run with one of them goes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from softneck.drives.master import Phase
from softneck.drives.master._master import Measurement
from softneck.drives.simulated import SimulatedNeck
from softneck.drives.simulated._servo_runtime import SERVO_POSITION, SERVO_SCALE, SERVO_ZERO
from softneck.drives.supervision._baseline import Baseline
from softneck.drives.supervision._tilt_charts import TiltModel

from .bench import TS, Bench, T
from .direct import DirectBus
from .plausible import Tracker, baseline, kind_of, sampled, watched

PATH = math.radians(3.0)


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


def freezes(bench: Bench) -> None:
    """The controller gives what it gave last, whatever its reference does."""
    act, held = bench.pilot.act, bench.master.wanted
    assert isinstance(act, Tracker)
    bench.pilot.act = Held(act, held)


class Held:
    """A controller that goes on, and whose answer nobody takes."""

    def __init__(self, act: Tracker, held: tuple[float, ...]) -> None:
        self._act, self._held = act, held

    @property
    def reference(self) -> tuple[float, ...]:
        return self._act.reference

    def __call__(self, measured: Measurement) -> tuple[float, ...]:
        self._act(measured)
        return self._held


@dataclass(frozen=True)
class Row:
    """One row.

    Attributes:
        breaks: it, at a random time; from the start where `early`.
        names: of the events that name it; the first is the right one, others where sensors cannot tell it apart.
        excited: what must have happened since in the run without the fault: "position" of motor 1 and "tilt" moved so
            far [rad], or "way", both axes together; "own": the part of motor 1 in the axis it moves most did; "pulls":
            in so many cycles its tension changed by 0.25 N within three.
        limit: time to the event after that [s].
        early: the fault is there before the run begins.
        gyro: whether the sensor has one.
        loop: whether it is a fault of loops only.
        shows: where that excites less than the fault is, how far the neck is from its path without the fault when it
            must show [rad].
    """

    breaks: Callable[[Bench], object]
    names: tuple[str, ...]
    excited: tuple[str, float]
    limit: float = 0.5
    early: bool = False
    gyro: bool = True
    loop: bool = False
    shows: float = math.inf


DEG = math.radians(1.0)
AT_ONCE, BY_TILT, BY_PULLS = ("", 0.0), ("tilt", 2 * DEG), ("pulls", 25.0)
BY_WAY, BY_OWN = ("way", 2 * DEG), ("own", 2 * DEG)
# Half of the 3 deg that a fault may lead the neck, beside the 0.6 deg of slow error that the tracking of the baseline
# takes for none.
APART = 2.1 * DEG


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
    "gear x 2": Row(lambda b: gear(b, 2.0), ("gear_wrong", "current_scale"), BY_OWN, early=True),
    "gear x 1/2": Row(lambda b: gear(b, 0.5), ("gear_wrong", "current_scale"), BY_OWN, early=True),
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
    # Of loops: an open one has no reference to follow.
    "controller freezes": Row(freezes, ("astray",), BY_WAY, loop=True, shows=APART),
}


@dataclass(frozen=True)
class Outcome:
    """How one run with a fault went.

    Attributes:
        event: that ended it, "" for none; after: it was excited [s].
        beyond: farthest that the true tilt went from the path without the fault until then [rad].
        excited: whether the run excited the fault at all.
        showed: by `Row.shows`, so long before the event, before the end without one [s]; -inf: not yet.
    """

    event: str
    after: float
    beyond: float
    excited: bool
    showed: float = -math.inf


NOTHING = Outcome("", math.inf, 0.0, False)


class Calm(NamedTuple):
    """A run without any fault, cycle by cycle: what its master saw, and the true tilt [rad]."""

    begin: float
    positions: np.ndarray
    tensions: np.ndarray
    tilt: np.ndarray


@lru_cache(maxsize=4)
def calm_run(seed: int, payload: float, seconds: float) -> Calm:
    bench = watched(seed, kind_of(seed), payload, judged=None)
    begin, rows = bench.now, []
    for _ in range(round(seconds / T)):
        bench.step()
        rows.append((bench.master.positions, bench.master.tensions, tuple(tilt_of(bench))))
    return Calm(begin, *(np.array(column) for column in zip(*rows, strict=True)))


def tilt_of(bench: Bench) -> np.ndarray:
    assert isinstance(bench.neck, SimulatedNeck)
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
    if row.loop and kind_of(seed) == "open":
        return NOTHING
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
        if kind_of(seed) == "open":
            yield from ((name, NOTHING) for name, row in ours.items() if row.loop)
            ours = {name: row for name, row in ours.items() if not row.loop}
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
    shown = last
    while bench.phase is Phase.RUNNING and k < last:
        bench.step()
        apart = float(np.hypot(*(tilt_of(bench) - calm.tilt[k])))
        beyond = max(beyond, apart)
        if apart > row.shows:
            shown = min(shown, k)
        k += 1
    showed = (k - 1 - shown) * T if shown < last else -math.inf
    fault = bench.master.supervisor.fault
    if fault is None:
        return Outcome("", math.inf, beyond, excited < last, showed)
    return Outcome(fault.name, (k - 1 - min(excited, k - 1)) * T, beyond, excited < k, showed)


def _own_part(calm: Calm, first: int) -> np.ndarray:
    """Return what motor 1 did of the output it moves most since cycle `first` (time,) [rad]."""
    model = baseline()
    walk = TiltModel(np.array(model.tilt), model.lags, model.motors)
    parts = np.array([walk.step(p)[0] for p in calm.positions[:: model.sample_cycles]])
    parts = np.repeat(parts, model.sample_cycles, axis=0)[: len(calm.positions)]
    return np.abs(parts - parts[first]).max(axis=1)


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
    elif what == "way":
        moved = np.hypot(*(calm.tilt - calm.tilt[start]).T)
    elif what == "own":
        moved = _own_part(calm, start)
    else:
        moved = np.abs(calm.positions[:, 0] - calm.positions[start, 0])
    at = np.flatnonzero(moved[first:] > by)
    return first + int(at[0]) if len(at) else len(moved)
