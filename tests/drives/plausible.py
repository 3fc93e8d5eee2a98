"""What the plausibility supervisor is tried with: a commissioning run, closed and open loops, and what breaks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from softneck.drives import default_drives
from softneck.drives.commissioning._record import drive_limits
from softneck.drives.master import Phase
from softneck.drives.master._master import Measurement
from softneck.drives.simulated import SimulatedNeck
from softneck.drives.supervision._baseline import Baseline, load_baseline
from softneck.drives.supervision._calibrate import calibrate
from softneck.drives.supervision._motor_models import Motion, MotionLog
from softneck.plant import NeckParameters
from softneck.signals import prepare, signal

from .bench import TS, Bench, T
from .direct import direct

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
# And of its loop, each with each payload: kind, seed; and how long [s].
LOOPS = (("step", 15), ("ramp", 16))
LOOP_TIME = 240.0

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
    if neck is None:
        motions += [looped(seed, kind, payload) for payload in payloads for kind, seed in LOOPS]
    return calibrate(motions, cycle=T, sample_cycles=2, slack=default_drives().limits.slack)


def looped(seed: int, kind: str, payload: float, seconds: float = LOOP_TIME) -> Motion:
    """Let the loop run undisturbed in virtual time."""
    bench, log = watched(seed, kind, payload), MotionLog()
    bench.run.watches = (log,)
    bench.pass_time(seconds)
    assert bench.phase is Phase.RUNNING, bench.master.supervisor.fault
    return log.motion()


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
        limits = replace(drive_limits(default_drives(), position=position), speed=speed)
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


def kind_of(seed: int) -> str:
    return ("step", "ramp", "open")[seed % 3]


Spoil = Callable[[float, tuple[float, ...], tuple[float, ...]], tuple[tuple[float, ...], tuple[float, ...]]]


def sampled(bench: Bench, spoil: Spoil) -> None:
    """Change each sample of the inclinometer: `spoil(now, values, rates)` returns the two."""
    neck = bench.neck
    assert isinstance(neck, SimulatedNeck)
    take = neck.sample

    def taken(now: float):
        sample = take(now)
        values, rates = spoil(now, sample.values, sample.rates)
        neck.newest = sample._replace(values=values, rates=rates)
        return neck.newest

    neck.sample = taken
