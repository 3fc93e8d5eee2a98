"""Hold what `softneck verify` promises against the truth: what it requires, and what the true (foreign) plant does.

`python benchmarks/promises.py [--necks NECK...] [--kinds KIND...] [--data DATA...] [--workers N] [--fresh | --table]`
or `--start [--necks NECK...]`

For each neck what docs/howto/payloads.md tells a user to do: the least co-contraction at which the large experiment is
heard with 1 kg, which recordings and loops then have; a family from recordings of small and large amplitude at 0 and 1
kg; and as the user's own plants a grey box of Eq. 22 at each payload where it is worth that. Beside it `eq22`: a family
of Eq. 22 alone, without co-contraction. For each kind of controller with defaults and set fast: its certificate, and on
the plant that was recorded, at both payloads, the margins by experiment and the steps. A promise is false where a
requirement holds that the true plant breaks; of what no experiment shows (Ms, disks, mu) the gain margin that it
implies is asked. Nothing is chosen here: held-out necks have a block of their own.
`--start` prints what `softneck start` certifies of one recording of `mixed` around 1.5 rad, beside the loop that it
delivers on the plant itself.
Families and results are kept in `build/promises`: a run that was stopped goes on where it was. Use --fresh after a
change, and --table to print what is there.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import softneck
from softneck.core import KINDS, SoftneckError, Vector, resolve
from softneck.core._kinds import kinds_of
from softneck.identification import FamilySettings, GreyBox, frequency_response
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, SetPointLimits, concatenate, multisine_experiments, prepare, signal
from softneck.signals.recording._files import write_recording
from softneck.verification import make_requirements, verify
from softneck.verification._experiments import LoopUnderTest, crossing_values, crossings
from softneck.verification._neck_loops import SimulationModel, run_loops
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import NECKS, ForeignNeck
from tests.foreign_necks.necks import record as record_foreign

# One thread for products of small matrices, where several only wait for each other; processes read it as they begin.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
OURS = ("paper", "rough")
SHOWN = (*OURS, *NECKS)
OUT = Path("build/promises")
# What `custom` is made of is one's own; `nmpc` is over a nonlinear model, and has no family to be certified on.
KINDS_JUDGED = tuple(kind for kind in kinds_of("controller") if kind not in ("custom", "nmpc"))
SPEEDS = ("default", "fast")
DATA = ("multisine", "eq22")
PAYLOADS = (0.0, 1.0)
# Of the multisines, and how far all motors are pulled at most [rad]; LARGEST is where motors end.
AMPLITUDES, COCONTRACTIONS, LARGEST = (0.3, 2.5), (0.0, 0.5, 1.0, 2.0, 3.0, 4.0), 6.0
# So many of the frequencies that any co-contraction makes known.
_AS_WELL = 0.95
# As few loops as say the same: the certificate's steps and the truth's have the same directions.
FEW = {
    "sampling": {"plants": 100, "search_generations": 5},
    "sim": {"necks": 0, "orientations_deg": [0.0, 45.0], "payloads_kg": list(PAYLOADS)},
}
# The truth is bisected to half a percent and found in windows of 4 s: nobody promises more closely.
ROUNDING = 1.02
_WORTH = 85.0


@dataclass(frozen=True, slots=True)
class Job:
    """One certificate.

    Attributes:
        neck: recorded, and the truth.
        data: what was recorded.
        kind: of controller.
        speed: one of `SPEEDS`.
    """

    neck: str
    data: str
    kind: str
    speed: str

    def settings(self, cocontraction: float) -> Any:
        """Return those of the controller: set fast, each kind's own bounds on the nominal loop are loosened.

        It holds the co-contraction [rad] of the recordings; `mpc` has no such setting.
        """
        own = resolve(KINDS[self.kind].settings)
        taut = {"least_cocontraction": cocontraction} if cocontraction > 0.0 and self.kind != "mpc" else {}
        if self.speed == "default":
            return own(**taut)
        loose = {"max_sensitivity": 1.5 * own().max_sensitivity, **taut}
        return own(**loose, phase_margin=0.7) if hasattr(own, "phase_margin") else own(**loose)


@dataclass(frozen=True, slots=True)
class Truth:
    """What of the true plant a requirement promises.

    Attributes:
        of: name of what was found of the true plant.
        bound: from the requirement's limit, what that must at least be (a gain or delay margin) or at most.
        least: whether that is a least value.
        whole: whether a plant that keeps it is fine; a gain margin alone does not make a disk.
    """

    of: str
    bound: Callable[[float], float]
    least: bool = True
    whole: bool = True

    def true(self, found: dict[str, Any], limit: float) -> bool:
        """Return whether the true plant keeps the promise, but for rounding."""
        value, bound = _number(found[self.of]), self.bound(limit)
        return value * ROUNDING >= bound if self.least else value <= bound * ROUNDING


_GAIN = "axes.gain_margin"
TRUTHS = {
    # At gain 1 the loop comes to rest; what does not has the margin 1.
    **{name: Truth(_GAIN, lambda _: 1.001 * ROUNDING) for name in ("stability.radius", "robust.mu")},
    "axes.sensitivity": Truth(_GAIN, lambda Ms: Ms / (Ms - 1.0), whole=False),
    **{name: Truth(_GAIN, lambda a: (2.0 + a) / (2.0 - a), whole=False)
       for name in ("axes.disk_margin", "mimo.disk_margin")},
    _GAIN: Truth(_GAIN, lambda limit: limit),
    "axes.delay_margin_ms": Truth("axes.delay_margin_ms", lambda limit: limit),
    **{f"{group}.{name}": Truth(f"sim.{name}", lambda limit: limit, least=False)
       for group, names in (("step", ("overshoot_pct", "settling_s")),
                            ("sim", ("overshoot_pct", "settling_s", "steady_rms_deg"))) for name in names},
}  # fmt: skip
# Margins, whose certified value stands beside the true one.
MARGINS = (_GAIN, "axes.delay_margin_ms")


def block_of(neck: str, noise: bool, seed: int = 0) -> Block:
    """Return one of our necks or a foreign one as a plant."""
    if neck in OURS:
        own = NeckParameters.preset(neck)
        return VirtualNeck(own if noise else own.without_noise()).block(noise_seed=seed)
    return ForeignNeck(name=neck, noise=noise).block(noise_seed=seed)


class Sensed(BlockPart):
    """A neck whose angles are those that its sensor tells: how the sensor is turned on it no recording knows."""

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        """Return the outputs at the start."""
        return self._told(super().start(time, parameters))

    def step(self, time: float, inputs: Vector) -> Vector:
        """Step once and return the outputs."""
        return self._told(super().step(time, inputs))

    def _told(self, outputs: Vector) -> Vector:
        names = [port.name for port in self.outputs]
        told = outputs.copy()
        for axis in ("pitch", "roll"):
            told[names.index(axis)] = outputs[names.index(f"{axis}_measured")]
        return told


def recorded(neck: str, excitation: Excitation, seed: int, payload: float, common: float = 0.0) -> Recording:
    """Return a recording of one of our necks or of a foreign one, played around a co-contraction [rad]."""
    around = replace(excitation, set_points=excitation.set_points + common)
    played, _ = prepare(around, SetPointLimits(position=LARGEST))
    if neck in OURS:
        return record(played, VirtualNeck(NeckParameters.preset(neck)), seed=seed, payload=payload)
    return record_foreign(played, ForeignNeck(name=neck), seed=seed, payload=payload)


def experiments(neck: str, amplitude: float, seed: int, payload: float, common: float) -> Recording:
    """Return what `softneck record multisine --amplitude --cocontraction --payload` does."""
    runs = multisine_experiments(amplitude=amplitude, band=(0.5, 25.0), seed=seed)
    return concatenate([recorded(neck, run, seed, payload, common) for run in runs])


def taut(neck: str) -> float:
    """Return the least co-contraction [rad] at which the large experiment is heard as well as at any with 1 kg."""
    counts = []
    for common in COCONTRACTIONS:
        found = frequency_response(experiments(neck, AMPLITUDES[-1], 0, PAYLOADS[-1], common))
        counts.append(sum(found.supported(name, found.own_input(name)).sum() for name in found.outputs))
    return COCONTRACTIONS[int(np.argmax(np.array(counts) >= _AS_WELL * max(counts)))]


def known(neck: str, data: str, common: float) -> dict[str, Any]:
    """Return the family and the grey boxes of what a user would record, by their names; made once and kept."""
    names = ("family", *(f"greybox_{kg:g}kg" for kg in PAYLOADS))
    files = [OUT / f"{neck}_{data}_{name}.npz" for name in names]
    if not all(file.exists() for file in files):
        eq22 = [recorded(neck, signal("eq22", duration=80.0), n, kg, common) for n, kg in enumerate(PAYLOADS)]
        for file, part in zip(files[1:], eq22, strict=True):
            if not file.exists():
                GreyBox().fit(part).save(file)
        played = [
            experiments(neck, amplitude, 10 * n, kg, common)
            for n, amplitude in enumerate(AMPLITUDES if data == "multisine" else ()) for kg in PAYLOADS
        ]  # fmt: skip
        FamilySettings().fit([*eq22, *played]).save(files[0])
    return {name: softneck.load(file) for name, file in zip(names, files, strict=True)}


def worth(neck: str, own: Any, payload: float, common: float) -> bool:
    """Return whether a user would take a grey box for the plant: 85 % in free run on steps, as `calibrate` asks."""
    from softneck.identification import INFINITE, validate

    steps = recorded(neck, signal("steps"), 5, payload, common)
    fits = validate(own, steps, horizons=(INFINITE,)).fits[INFINITE].values()
    return all(fit is not None and fit >= _WORTH for fit in fits)


def judged(job: Job, plants: dict[str, Any], common: float) -> dict[str, Any]:
    """Return what was certified of each requirement, and what is true."""
    controller = job.settings(common).design(plants["family"])
    # Without the observer, as margins are.
    found = verify(controller, plants, make_requirements(FEW)).contents()
    rows = {row["metric"]: row for row in found["requirements"]}
    return {
        "certified": {
            name: [row["value"], row["holds"], row["limit"], row["worst"].get("name", ""), row.get("note", "")]
            for name, row in rows.items()
        },
        "true": truth(job.neck, controller.block()),
        "cocontraction": common,
        "own": [name for name in plants if name != "family"],
        "margins": found["margins"],
        "whole": found["holds"],
    }


def truth(neck: str, controller: Block) -> dict[str, float]:
    """Return what the plant itself does at both payloads: margins by experiment without its noise, and steps.

    Angles are those of its sensor, which is all that a certificate can be of.
    """
    loops = [
        LoopUnderTest(name=neck, plant=lambda: BlockPart(block_of(neck, noise=False)), controller=controller,
                      constants={"plant_inputs": {"payload": kg}}) for kg in PAYLOADS
    ]  # fmt: skip
    found = crossing_values(crossings(loops, overall=True))
    own = SimulationModel(
        name=neck, payload="inputs", make=lambda seed, _: Sensed(block_of(neck, noise=True, seed=seed)),
        quiet=lambda _: Sensed(block_of(neck, noise=False)),
    )  # fmt: skip
    runs = run_loops(controller, make_requirements(FEW), order="sequential", observer=None, seed=0,
                     progress=softneck.core.silent, own=[own])  # fmt: skip
    steps = {f"sim.{name}": max(run.metrics[name] for run in runs)
             for name in ("overshoot_pct", "settling_s", "steady_rms_deg")}  # fmt: skip
    return {**{name: float(found[name][0].min()) for name in MARGINS}, **steps}


def computed(neck: str, data: str, jobs: list[Job], kept: Path) -> list[dict[str, Any]]:
    """Return what the jobs of one neck find, or why they find nothing; keep each."""
    results = []
    begin = time.process_time()
    common = taut(neck) if data == "multisine" else 0.0
    plants = known(neck, data, common)
    poor = [
        name for name, kg in zip(list(plants)[1:], PAYLOADS, strict=True) if not worth(neck, plants[name], kg, common)
    ]
    plants = {name: thing for name, thing in plants.items() if name not in poor}
    seconds = time.process_time() - begin
    print(f"  {neck}, {data}: {', '.join(plants)} at {common:g} rad after {seconds:.0f} s", file=sys.stderr, flush=True)
    for job in jobs:
        begin = time.process_time()
        try:
            found = judged(job, plants, common)
        except SoftneckError as error:
            found = {"failed": str(error)}
        found = _finite({**found, "processor_s": time.process_time() - begin})
        results.append(found)
        keep(kept, {"job": astuple(job), "found": found})
        print(f"  {', '.join(astuple(job))}: {found['processor_s']:.0f} s", file=sys.stderr, flush=True)
    return results


def _finite(value: Any) -> Any:
    """Return JSON values: what is infinite becomes a text."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return "inf" if isinstance(value, float) and math.isinf(value) else value


def _number(value: Any) -> float:
    """Return a number; what is not known is none."""
    return math.inf if value == "inf" else math.nan if value is None else float(value)


def false_rate(count: int, of: int, confidence: float = 0.95) -> float:
    """Return the upper bound of a rate of which `count` were seen in `of` (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    return 1.0 if of == 0 or count == of else float(beta.ppf(confidence, count + 1, of - count))


def table(results: dict[Job, dict[str, Any]], necks: list[str]) -> None:
    """Print one block: false promises, refused though fine, margins."""
    for data in DATA:
        rows = {job: r for job, r in results.items() if job.neck in necks and job.data == data and "failed" not in r}
        failed = sum(job.neck in necks and job.data == data and "failed" in r for job, r in results.items())
        if not rows:
            continue
        there = [neck for neck in necks if any(job.neck == neck for job in rows)]
        seconds = median(r["processor_s"] for r in rows.values())
        print(f"\nFamily of {data}: {len(rows)} designs on {', '.join(there)} ({failed} refused by the design); a "
              f"certificate and its truth take {seconds:.0f} s of processor time\n")  # fmt: skip
        _promises(rows)
        _margins(rows)


def _promises(rows: dict[Job, dict[str, Any]]) -> None:
    print("| requirement | held | false | 95 % bound of the rate | refused though fine |\n|---|---|---|---|---|")
    total = {"held": 0, "false": 0, "refused": 0, "fine": 0}
    for name, what in TRUTHS.items():
        said = [(r["certified"][name], r["true"]) for r in rows.values() if name in r["certified"]]
        told = [(holds, what.true(true, limit)) for (_, holds, limit, *_), true in said if holds is not None]
        held, fine = [true for holds, true in told if holds], [holds for holds, true in told if true]
        false, refused = held.count(False), fine.count(False)
        print(f"| `{name}` | {len(held)} of {len(told)} | {false} | {100 * false_rate(false, len(held)):.0f} % | "
              f"{f'{refused} of {len(fine)}' if what.whole else '-'} |")  # fmt: skip
        total["held"] += len(held)
        total["false"] += false
        total["refused"] += refused * what.whole
        total["fine"] += len(fine) * what.whole
    designs = [r["whole"] and not all(what.true(r["true"], r["certified"][name][2]) for name, what in TRUTHS.items()
               if name in r["certified"]) for r in rows.values()]  # fmt: skip
    held, wrong = sum(r["whole"] for r in rows.values()), sum(designs)
    rate, refused = 100 * false_rate(total["false"], total["held"]), f"{total['refused']} of {total['fine']}"
    print(f"| all of these | {total['held']} | {total['false']} | {rate:.1f} % | {refused} |")
    print(f"| whole certificates | {held} of {len(rows)} | {wrong} | {100 * false_rate(wrong, held):.0f} % | - |")


def _margins(rows: dict[Job, dict[str, Any]]) -> None:
    print()
    for name in MARGINS:
        pairs = [(_number(r["certified"][name][0]), r["certified"][name][1], _number(r["true"][name]))
                 for r in rows.values()]  # fmt: skip
        over = [holds for value, holds, true in pairs if value > ROUNDING * true]
        ratios = [true / value for value, holds, true in pairs if holds and math.isfinite(true / value)]
        shown = f"{median(ratios):.2f}" if ratios else "-"
        print(f"`{name}`: certified above the truth {over.count(True)} times where it holds, {len(over)} times in all; "
              f"true over certified, median of {len(ratios)} that hold: {shown}\n")  # fmt: skip
    print("| design | certified gain margin | true | certified delay margin [ms] | true |\n|---|---|---|---|---|")
    for job, r in rows.items():
        cells = [
            f"{_number(r['certified'][name][0]):.3g}{'' if r['certified'][name][1] else ' (refused)'} | "
            f"{_number(r['true'][name]):.3g}"
            for name in MARGINS
        ]
        print(f"| {job.neck} {job.kind} {job.speed} | {' | '.join(cells)} |")


# Of `--start`: the co-contraction of its recording [rad], the steps of the truth, and what is compared.
START_COCONTRACTION = 1.5
START_SIM = {"payloads_kg": [0.0], "orientations_deg": [45.0 * k for k in range(8)], "duration_s": 6.0}
STEPS = ("sim.rise_s", "sim.overshoot_pct", "sim.settling_s", "sim.steady_rms_deg")


def started(neck: str) -> Path:
    """Return the project that `softneck start` makes of one recording of a neck; made once and kept."""
    folder, log = OUT / f"{neck}_start", OUT / f"{neck}_start.csv"
    if not (folder / "start.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_recording(log, recorded(neck, signal("mixed", seed=1), 1, 0.0, START_COCONTRACTION), force=True)
        command = [sys.executable, "-m", "softneck", "start", str(log), "-o", str(folder), "--yes"]
        subprocess.run(command, check=False, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return folder


def delivered(neck: str, folder: Path) -> dict[str, float]:
    """Return metric -> the worst value of the loop that a project delivers, on the neck itself."""
    controller = softneck.load(folder / "tune/best.npz")
    told = tomllib.loads((folder / "tune/loop.toml").read_text(encoding="utf-8"))
    observer = softneck.load(folder / "tune/observer.npz").block() if "observer" in told else None
    order = str(getattr(controller, "order", "sequential"))
    own = SimulationModel(
        name=neck, payload="inputs", make=lambda seed, _: Sensed(block_of(neck, noise=True, seed=seed)),
        quiet=lambda _: Sensed(block_of(neck, noise=False)),
    )  # fmt: skip
    runs = run_loops(controller.block(), make_requirements({"sim": START_SIM}), order=order, observer=observer, seed=0,
                     progress=softneck.core.silent, own=[own])  # fmt: skip
    loop = LoopUnderTest(name=neck, plant=lambda: BlockPart(block_of(neck, noise=False)), controller=controller.block(),
                         observer=observer, order=order, constants={"plant_inputs": {"payload": 0.0}})  # fmt: skip
    margins = crossing_values(crossings([loop], overall=True))
    steps = {name: max(run.metrics[name.partition(".")[2]] for run in runs) for name in STEPS}
    return steps | {name: float(margins[name][0].min()) for name in MARGINS}


def start_table(necks: Sequence[str]) -> None:
    """Print certified and true values of what `softneck start` delivers, and how many are true."""
    names = (*STEPS, *MARGINS)
    head = " | ".join(f"{name}: certified, true" for name in names)
    print(f"| neck | loosened | {head} |\n|{'---|' * (2 + len(names))}")
    within, below, farthest, total = 0, 0, 0.0, 0
    for neck in necks:
        folder = started(neck)
        file, true = folder / "tune/best.certificate.json", delivered(neck, folder)
        told = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {"requirements": [], "loosened": {}}
        rows = {row["metric"]: row for row in told["requirements"]}
        eased = ", ".join(told["loosened"]) or ("none" if rows else "no certificate")
        cells = [f"{_number(rows[n]['value']):.3g}, {true[n]:.3g}" if n in rows else f"-, {true[n]:.3g}" for n in names]
        print(f"| `{neck}` | {eased} | {' | '.join(cells)} |", flush=True)
        for name in (name for name in names if name in rows):
            limit, value = _number(rows[name]["limit"]), rows[name]["value"]
            value = math.inf if value is None and name in MARGINS else _number(value)  # no end of it was found
            sign = -1.0 if name in MARGINS else 1.0
            within += sign * true[name] <= sign * limit
            below += sign * true[name] <= sign * value
            farthest, total = max(farthest, sign * (true[name] - value) / limit), total + 1
    print(f"\ntrue within the certified limit: {within} of {total}; within the certified value: {below} of {total}, "
          f"the farthest by {100.0 * farthest:.0f} % of its limit")  # fmt: skip


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--necks", nargs="*", default=SHOWN, choices=SHOWN)
    parser.add_argument("--kinds", nargs="*", default=KINDS_JUDGED, choices=KINDS_JUDGED)
    parser.add_argument("--data", nargs="*", default=DATA, choices=DATA)
    parser.add_argument("--speeds", nargs="*", default=SPEEDS, choices=SPEEDS)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--fresh", action="store_true", help="Forget what is kept.")
    parser.add_argument("--start", action="store_true", help="Print what `softneck start` certifies, beside the truth.")
    parser.add_argument("--table", action="store_true", help="Compute nothing; print what is kept.")
    asked = parser.parse_args()
    if asked.start:
        start_table(asked.necks)
        return
    kept = OUT / "results.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if asked.fresh:
        for old in OUT.iterdir():
            old.unlink()
    results = {Job(*line["job"]): line["found"] for line in kept_lines(kept)}
    wanted = [Job(n, d, k, s) for n in asked.necks for d in asked.data for s in asked.speeds for k in asked.kinds]
    units: dict[tuple[str, str], list[Job]] = {}
    for job in wanted if not asked.table else ():
        if job not in results:
            units.setdefault((job.neck, job.data), []).append(job)
    os.environ |= ONE_THREAD
    # Started anew: a forked process would hold the locks of ours.
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(computed, *place, jobs, kept): jobs for place, jobs in units.items()}
        for done in as_completed(running):
            results |= zip(running[done], done.result(), strict=True)
    shown = {job: results[job] for job in wanted if job in results}
    blocks: list[tuple[str, Callable[[str], bool]]] = [
        ("Necks on which defaults are chosen", lambda neck: neck not in HELD_OUT),
        ("Held out from every choice", lambda neck: neck in HELD_OUT),
    ]
    for title, part in blocks:
        necks = [neck for neck in asked.necks if part(neck)]
        if any(job.neck in necks for job in shown):
            print(f"\n## {title}")
            table(shown, necks)


if __name__ == "__main__":
    main()
