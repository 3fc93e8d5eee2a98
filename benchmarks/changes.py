"""How soon a change detector over a `greybox` finds a payload, how often it cries wolf, and how it was chosen.

`python benchmarks/changes.py choose|found|alarms|curve|oracle [--several] [--minutes N] [--necks NECK...] [--hours H]`

Models are of 140 s of Eq. 22; thresholds of some 200 s of other motion of the same neck. `choose` leaves each neck out
in turn: seconds until a payload put on at 60 s is found during the paper's rotation (60 where it is not), and as many
again for each false alarm over other motion. `found` prints these seconds, and those of the next motion after a hold
at 14 deg. `alarms` counts false alarms over independent minutes of motion; it goes on where it was stopped
(`build/changes`). `found` and `alarms` take thresholds of `--minutes` of such motion as well. `curve` prints both for
several budgets of false alarms. With `--several` the model is one of 0, 0.5 and 1 kg, so that the detector tells the
payload: found is then `changed`, or a payload of more than 0.16 kg (half of the least that is put on) where there was
less before. `choose` then adds the seconds until what is told stays within
0.16 kg, and takes another 12 minutes of motion than `alarms`. `oracle` puts the true neck in the place of the model,
with and without the payload, sensor noise alone between them: what anyone could find, the rms shift that the payload
makes in the 10 s after it was put on, and the rms error there of the model of several payloads without one.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path

import numpy as np
from adaptation import trained
from payload import log as logged

from softneck.core import Matrix, Vector, load
from softneck.estimation.changes._change import ChangeDetector
from softneck.estimation.changes._settings import ChangeSettings
from softneck.identification import GreyBox, Model
from softneck.signals import Recording, concatenate, signal
from tests.foreign_necks.choosing import leave_one_out
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record_under

OUT, TS = Path("build/changes"), 0.02
LOADS = (0.32, 0.5, 1.0)
CANDIDATES = [
    ChangeSettings(period=period, clip=clip, ratio=ratio)
    for period in (0.2, 0.5)
    for clip in (1.5, 2.0, 3.0)
    for ratio in (2.0, 4.0)
]
CANDIDATES_OF_SEVERAL = [
    ChangeSettings(payload_sight=sight, payload_memory=memory)
    for sight in (1.5, 3.0, 5.0, 8.0)
    for memory in (0.5, 1.0, 2.0)
]
PUT_ON, NEXT = 60.0, 70.0
MOTIONS = ("aprbs", "multisine", "mixed")
# [kg] A payload told beyond it is one that was found.
TOLD = 0.5 * LOADS[0]


def moved(neck: str, P: Matrix, payload: float | Vector, seed: int) -> Recording:
    """Return what a specimen of a neck does under set-points (time, 3) and a payload, a number or (time,)."""
    return record_under(P, ForeignNeck(name=neck, seed=1), np.broadcast_to(payload, len(P)), seed=seed)


def motions(seed: int) -> list[Matrix]:
    """Return set-points (time, 3) of some 200 s: the paper's tests, and three that each seed makes anew."""
    own = [signal(name).set_points for name in ("steps", "sine", "rotation")]
    return own + [signal(name, duration=40.0, seed=seed).set_points for name in ("aprbs", "multisine", "mixed")]


def rotation(seconds: float) -> Matrix:
    """Return the paper's rotation (time, 3) for longer."""
    t = np.arange(round(seconds / TS)) * TS
    return np.stack(
        [2.8 * np.minimum(1.0, t / 3.0) * np.cos(1.2 * t - 2.0 * np.pi * j / 3.0) for j in range(3)], axis=1
    )


def hold(seconds: float) -> Matrix:
    """Return a hold at some 14 deg (time, 3), and the move to another side at `NEXT`."""
    t = np.arange(round(seconds / TS))[:, None] * TS
    there, other = np.array([1.6, -0.8, -0.8]), np.array([-0.8, 1.6, -0.8])
    return there * np.clip(t / 2.0, 0.0, 1.0) + (other - there) * np.clip((t - NEXT) / 0.5, 0.0, 1.0)


@cache
def baseline(neck: str) -> Recording:
    """Return undisturbed motion."""
    return concatenate([moved(neck, P, 0.0, 5) for P in motions(3)])


def first(detector: ChangeDetector, run: Recording, since: float) -> float:
    """Return the seconds from `since` to the first alarm; infinite where there is none, below 0 where it is false."""
    told = detector.watch(run)
    there = told[:, 0] > 0.5
    if detector.payloads is not None:
        there |= told[:, 3] > TOLD
    alarms = np.flatnonzero(there)
    return float(alarms[0]) * TS - since if alarms.size else np.inf


def settled(detector: ChangeDetector, run: Recording, payload: float) -> float:
    """Return the seconds from `PUT_ON` until the payload that is told stays near the true one."""
    away = np.flatnonzero(np.abs(detector.watch(run)[:, 3] - payload) > TOLD)
    return max(0.0, (away[-1] + 1) * TS - PUT_ON)


@cache
def learnt(neck: str, *, several: bool) -> tuple[Model, list[Recording]]:
    """Return a model without payload or of several, and undisturbed motion."""
    if not several:
        return trained(neck, "greybox"), [baseline(neck)]
    path = OUT / f"{neck}.several.npz"
    if not path.exists():
        OUT.mkdir(parents=True, exist_ok=True)
        GreyBox().fit([logged(neck, kg).rows(0, 5000) for kg in (0.0, 0.5, 1.0)]).save(path)
    return load(path, role="model"), [moved(neck, P, kg, 5) for kg in (0.0, 0.5, 1.0) for P in motions(3)]


def detector_of(neck: str, settings: ChangeSettings, *, several: bool, minutes: int = 0) -> ChangeDetector:
    """Return a detector over a model without payload, or over one of several, from so many further minutes."""
    model, undisturbed = learnt(neck, several=several)
    return settings.design(model, undisturbed + [minute(neck, 7000 + number) for number in range(minutes)])


def loaded(neck: str, P: Matrix, payload: float, seed: int = 9) -> Recording:
    """Return a run in which a payload is put on at `PUT_ON`."""
    return moved(neck, P, np.where(np.arange(len(P)) * TS >= PUT_ON, payload, 0.0), seed)


def minute(neck: str, seed: int) -> Recording:
    """Return undisturbed motion that a seed makes anew."""
    name, size = MOTIONS[seed % 3], np.random.default_rng(seed).uniform(0.5, 1.0)
    return moved(neck, size * signal(name, duration=60.0, seed=seed).set_points, 0.0, seed)


def choose(necks: list[str], *, several: bool) -> None:
    """Print what each neck left out gets from the others' choice."""
    candidates = CANDIDATES_OF_SEVERAL if several else CANDIDATES
    default, scores = next(i for i, c in enumerate(candidates) if c == ChangeSettings()), {}
    for neck in necks:
        runs = [(loaded(neck, rotation(80.0), payload), payload, PUT_ON) for payload in LOADS]
        quiet = [moved(neck, P, 0.0, seed) for seed in (11, 12) for P in motions(seed)]
        if several:
            runs += [(loaded(neck, hold(80.0), payload), payload, NEXT) for payload in LOADS]
            quiet += [minute(neck, seed) for seed in range(5000, 5012)]
        row = []
        for candidate in candidates:
            detector = detector_of(neck, candidate, several=several)
            delays = [first(detector, run, since) for run, _, since in runs]
            false = sum(np.isfinite(first(detector, run, 0.0)) for run in quiet)
            mean = np.mean([d if 0.0 < d < np.inf else PUT_ON for d in delays])
            late = np.mean([settled(detector, run, kg) for run, kg, _ in runs[:3]]) if several else 0.0
            row.append(float(mean + late + PUT_ON * false))
        scores[neck] = np.array([row])
        print(neck, np.round(row, 1), flush=True)
    for fold in leave_one_out(scores, default):
        print(f"left out {fold.left_out:8} others choose {said(candidates[fold.chosen], several=several)}: "
              f"{fold.ratios[fold.chosen]:.2f} of the code's; its own best {fold.ratios[fold.best]:.2f}, "
              f"{said(candidates[fold.best], several=several)}")  # fmt: skip


def said(c: ChangeSettings, *, several: bool) -> str:
    """Return a candidate in words."""
    if several:
        return f"sight {c.payload_sight:g}, memory {c.payload_memory:g} s"
    return f"period {c.period:g} s, clip {c.clip:g}, ratio {c.ratio:g}"


def curve(necks: list[str], hours: float, *, several: bool) -> None:
    """Print delays and false alarms for budgets of false alarms."""
    print(f"{'':10}{'budget':>12}{'false, of minutes':>20}{'rotation [s]':>26}{'after a hold [s]':>26}")
    for neck in necks:
        cases = [(loaded(neck, P, kg), since) for P, since in ((rotation(80.0), PUT_ON), (hold(80.0), NEXT))
                 for kg in LOADS]  # fmt: skip
        quiet = [minute(neck, 1000 + number) for number in range(round(60.0 * hours))]
        for budget in (1.0, 30.0, 300.0, 10_000.0):
            detector = detector_of(neck, ChangeSettings(hours=budget), several=several)
            false = sum(np.isfinite(first(detector, run, 0.0)) for run in quiet)
            delays = [first(detector, run, since) for run, since in cases]
            print(f"{neck:10}{budget:10g} h{f'{false} of {len(quiet)}':>20}"
                  + "".join(f"{'none' if d == np.inf else f'{d:.2f}':>{12 if i == 3 else 8}}"
                            for i, d in enumerate(delays)), flush=True)  # fmt: skip


def found(necks: list[str], *, several: bool, minutes: int) -> None:
    """Print how soon a payload is found."""
    print(f"{'':22}" + "".join(f"{payload:>9g} kg" for payload in (0.0, *LOADS)))
    for neck in necks:
        detector = detector_of(neck, ChangeSettings(), several=several, minutes=minutes)
        for name, P, since in (("rotation", rotation(80.0), PUT_ON), ("hold", hold(80.0), NEXT)):
            delays = [first(detector, loaded(neck, P, payload), since) for payload in (0.0, *LOADS)]
            print(f"{neck:14}{name:8}" + "".join(f"{'none' if d == np.inf else f'{d:.2f} s':>12}" for d in delays),
                  flush=True)  # fmt: skip


def alarms(necks: list[str], hours: float, *, several: bool, minutes: int) -> None:
    """Count false alarms, minute by minute of motion that each seed makes anew; kept where it stopped."""
    OUT.mkdir(parents=True, exist_ok=True)
    for neck in necks:
        detector = detector_of(neck, ChangeSettings(), several=several, minutes=minutes)
        path = OUT / f"{neck}{'.several' if several else ''}{f'.{minutes}' if minutes else ''}.alarms.json"
        done: list[bool] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else []
        while len(done) < 60.0 * hours:
            run = minute(neck, 1000 + len(done))
            at = first(detector, run, 0.0)
            done.append(bool(np.isfinite(at)))
            if done[-1]:
                before = slice(round((at - 2.0) / TS), round(at / TS))
                off = np.degrees(detector.model.simulate(run)[before, :2] - run.outputs[before]).mean(axis=0)
                print(f"{neck:14}minute {len(done)} ({MOTIONS[(999 + len(done)) % 3]}), {at:.2f} s: "
                      f"the model was {off[0]:.1f}/{off[1]:.1f} deg off in the 2 s before", flush=True)  # fmt: skip
            part = path.with_suffix(".part")
            part.write_text(json.dumps(done), encoding="utf-8")
            part.replace(path)
        print(f"{neck:14}{sum(done)} false alarms in {len(done) / 60.0:.2f} h of motion", flush=True)


def oracle(necks: list[str]) -> None:
    """Print how soon a cumulative sum of the true likelihood ratio finds a payload, and what hides it from a model."""
    hours, after = ChangeSettings().hours, slice(round(PUT_ON / TS), round((PUT_ON + 10.0) / TS))
    print(f"{'found after [s]; shift [deg]':30}" + "".join(f"{kg:>16g} kg" for kg in LOADS) + f"{'model misses':>18}")
    for neck in necks:
        P, still = rotation(80.0), ForeignNeck(name=neck, seed=1, noise=False)
        without = record_under(P, still, np.zeros(len(P))).outputs
        quiet = loaded(neck, P, 0.0)
        noise = np.std(quiet.outputs - without, axis=0)
        cells = []
        for payload in LOADS:
            bears = np.where(np.arange(len(P)) * TS >= PUT_ON, payload, 0.0)
            apart = record_under(P, still, bears).outputs - without
            missed = loaded(neck, P, payload).outputs - without
            # Of each sample: ln p(y | payload)/p(y | none), summed from its least on.
            total = np.concatenate([[0.0], np.cumsum(((missed - 0.5 * apart) * apart / noise**2).sum(axis=1))])
            found = np.flatnonzero(total - np.minimum.accumulate(total) > np.log(3600.0 * hours / TS))
            shift = np.degrees(np.sqrt(np.mean(apart[after] ** 2)))
            cells.append(f"{found[0] * TS - PUT_ON:.2f}; {shift:.2f}" if found.size else f"none; {shift:.2f}")
        off = (learnt(neck, several=True)[0].simulate(quiet)[:, :2] - quiet.outputs)[after]
        misses = np.degrees(np.sqrt(np.mean(off**2)))
        print(f"{neck:30}" + "".join(f"{cell:>19}" for cell in cells) + f"{misses:14.2f} deg", flush=True)  # fmt: skip


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=["choose", "found", "alarms", "curve", "oracle"])
    parser.add_argument("--necks", nargs="*", choices=CHOOSING, default=list(CHOOSING))
    parser.add_argument("--hours", type=float, default=30.0, help="of motion of each neck")
    parser.add_argument("--minutes", type=int, default=0, help="of further undisturbed motion to `found` and `alarms`")
    parser.add_argument("--several", action="store_true", help="a model of several payloads, which is told as well")
    asked = parser.parse_args()
    if asked.what == "choose":
        choose(asked.necks, several=asked.several)
    elif asked.what == "found":
        found(asked.necks, several=asked.several, minutes=asked.minutes)
    elif asked.what == "oracle":
        oracle(asked.necks)
    elif asked.what == "curve":
        curve(asked.necks, asked.hours, several=asked.several)
    else:
        alarms(asked.necks, asked.hours, several=asked.several, minutes=asked.minutes)


if __name__ == "__main__":
    main()
