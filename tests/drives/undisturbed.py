"""Hours of undisturbed motion: what a master and its drives do while nothing is wrong, and nothing else.

Limits, gate and watches are the master's own objects; phases, frames and objects of the drives, which do not change,
are left out. `test_plausibility` holds it to the bench, bit by bit.
"""

from __future__ import annotations

import math

import numpy as np

from softneck.core import Matrix
from softneck.drives.master._events import Event, Reaction
from softneck.drives.master._gate import Reading
from softneck.drives.master._master import Measurement
from softneck.drives.simulated._servo_runtime import (
    SERVO_CURRENT,
    SERVO_DEMAND,
    SERVO_LEFT,
    SERVO_POSITION,
    SERVO_SLOPE,
    SERVO_TARGET,
    SERVO_TRIPPED,
)
from softneck.drives.supervision._motor_models import Motion

from .bench import Bench
from .direct import DirectBus

# Current in internal units, as in the drives.
_RANGE = 65520.0


def undisturbed(bench: Bench, seconds: float) -> tuple[Motion, Matrix, str]:
    """Let a running bench without frames move for so long.

    Return what its master saw, the references of its loop (time, outputs), NaN where there are none, and what stopped
    it ("").

    The bench is used up: its master's own counters stay behind.
    """
    master, link, pilot = bench.master, bench.link, bench.pilot
    bus, gate, watches, limiters = master.bus, master._gate, master._watches, master._limiters
    assert isinstance(bus, DirectBus)
    settings, m, cycles = master.settings, bench.neck.motion, master.settings.sample_cycles
    nodes, following, tension = settings.bus.nodes, settings.watch.following, settings.limits.tension
    axes = [(newton, 2.0 * drive.axis.peak_current) for (_, _, newton, _), drive in
            zip(master._scales, bench.neck.drives, strict=True)]  # fmt: skip
    scales = [(per_radian, zero) for _, per_radian, _, zero in master._scales]
    ticks = float(round(settings.bus.cycle / bench.neck.drives[0].axis.tick))
    columns = m[:, SERVO_POSITION], m[:, SERVO_CURRENT], m[:, SERVO_DEMAND], m[:, SERVO_TRIPPED]
    target, slope, left = m[:, SERVO_TARGET], m[:, SERVO_SLOPE], m[:, SERVO_LEFT]
    assert pilot.act is not None
    act, index, part, before, wanted = pilot.act, master._index, master._part, master._from, master.wanted
    sent, counts = master.setpoints, [counts for _, counts, _ in bus._told]
    units = [current for _, _, current in bus._told]
    rows, none, waits, tilt = [], (math.nan,) * len(watches.angles), False, None
    for number in range(round(seconds / settings.bus.cycle)):
        now, due = link.now, (master.cycle + number) % cycles == 0
        # What the loop wanted when this cycle's measurement was taken: the pilot is asked after it.
        asked = getattr(act, "reference", ()) or none
        events: list[Event] = []
        positions = tuple([(c - zero) / per_radian for c, (per_radian, zero) in zip(counts, scales, strict=True)])
        tensions = tuple([u * newton for u, (newton, _) in zip(units, axes, strict=True)])
        fresh = False
        if due:
            link.neck.sample(now)
            tilt = link.newest
            fresh = gate.step(now, tilt, events)
        beyond = any(abs(s - p) > following or abs(f) > tension for s, p, f in
                     zip(sent, positions, tensions, strict=True))  # fmt: skip
        if beyond or waits:
            watches.motors(now, sent, positions, nodes, tensions, events)
        waits = beyond
        last = gate.last
        assert isinstance(last, Reading)
        if due:
            watches.tilt(now, cycles * settings.bus.cycle, positions, last.values if fresh else None, events)
            index, part = index + 1, 0
            before, wanted = wanted, tuple(act(Measurement(index, last, fresh, positions)) or ())
        part += 1
        share = min(part / cycles, 1.0)
        values, why = [], ""
        for limiter, a, b, pull, led in zip(limiters, before, wanted, tensions, watches.led, strict=True):
            values.append(limiter.step(a + share * (b - a), pull, led))
            why = why or limiter.clamped
        if master._clamped.over(bool(why)):
            events.append(Event(now, "clamp_persistent", 0, why))
        seen = (tilt.values, tilt.rates) if due and tilt and tilt.valid else (none, none)
        rows.append((sent, positions, tensions, *seen, due, asked))
        if any(columns[3].tolist()):
            events.append(Event(now, "drive_fault", 0))
        stops = [event.name for event in events if event.rule.reaction not in (Reaction.COUNT, Reaction.HOLD)]
        if stops:
            return *_motion(rows[:-1]), stops[0]
        sent = tuple(values)
        # What set-points and SYNC do in the drives, and what these say to it.
        aims = [round(p * per_radian) + zero for p, (per_radian, zero) in zip(values, scales, strict=True)]
        target[:] = aims
        slope[:] = [(aim - demand) / ticks for aim, demand in zip(aims, columns[2].tolist(), strict=True)]
        left[:] = ticks
        counts = [int(c) for c in columns[0].tolist()]
        units = [round(c * _RANGE / peak) for c, (_, peak) in zip(columns[1].tolist(), axes, strict=True)]
        link.pass_time()
    return *_motion(rows), ""


def _motion(rows: list) -> tuple[Motion, Matrix]:
    s, p, tension, values, rates, due, reference = (np.array([row[k] for row in rows], dtype=float) for k in range(7))
    return Motion(setpoints=s, positions=p, tensions=tension, values=values, rates=rates, due=due > 0.5), reference
