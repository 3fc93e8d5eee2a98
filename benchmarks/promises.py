"""Hold what `softneck verify` promises against the truth: certified margins and those of the true (foreign) plant.

`python benchmarks/promises.py [--necks NECK...] [--kinds KIND...] [--workers N] [--fresh]`

For each neck, kind of controller and speed: a family from recordings of small and large amplitude at 0 and 1 kg (or of
Eq. 22 alone, `eq22`), a grey box of Eq. 22 as the user's own plant, a controller with defaults and one with `rise_s`
set fast, its certificate, and the margins by experiment on the plant that was recorded. A promise is false where a
requirement holds that the true plant breaks. Nothing is chosen here: held-out necks are shown in a block of their own.
Results are kept in `build/promises`: a run that was stopped goes on where it was; use --fresh after a change.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import astuple, dataclass
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any

from threadpoolctl import threadpool_limits

from softneck.core import KINDS, SoftneckError, resolve
from softneck.core._kinds import kinds_of
from softneck.identification import FamilySettings, GreyBox
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, concatenate, multisine_experiments, signal
from softneck.verification import make_requirements, verify
from softneck.verification._experiments import LoopUnderTest, crossing_values, crossings
from tests.foreign_necks.held_out import HELD_OUT
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import NECKS, ForeignNeck
from tests.foreign_necks.necks import record as record_foreign

OURS = ("paper", "rough")
SHOWN = (*OURS, *NECKS)
OUT = Path("build/promises")
# What `custom` is made of is one's own; `nmpc` is over a nonlinear model, and has no family to be certified on.
KINDS_JUDGED = tuple(kind for kind in kinds_of("controller") if kind not in ("custom", "nmpc"))
SPEEDS: dict[str, dict[str, float]] = {"default": {}, "fast": {"rise_s": 0.35}}
DATA = ("multisine", "eq22")
# The requirements whose truth an experiment can tell, and what one unit of the table is.
JUDGED = {"axes.gain_margin": 2.0, "axes.delay_margin_ms": 40.0}
# The truth is bisected to half a percent and found in windows of 4 s: nobody promises more closely.
ROUNDING = 1.02


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


def recorded(neck: str, excitation: Excitation, seed: int, payload: float) -> Recording:
    """Return a recording of one of our necks or of a foreign one."""
    if neck in OURS:
        return record(excitation, VirtualNeck(NeckParameters.preset(neck)), seed=seed, payload=payload)
    return record_foreign(excitation, ForeignNeck(name=neck), seed=seed, payload=payload)


@lru_cache(1)
def known(neck: str, data: str) -> tuple[Any, Any]:
    """Return the family and the grey box of what a user would record."""
    eq22 = [recorded(neck, signal("eq22", duration=80.0), n, kg) for n, kg in enumerate((0.0, 1.0))]
    played = list(eq22)
    if data == "multisine":
        for n, amplitude in enumerate((0.3, 2.5)):
            for m, kg in enumerate((0.0, 1.0)):
                runs = multisine_experiments(amplitude=amplitude, band=(0.5, 25.0), realisations=2, seed=n)
                played.append(concatenate([recorded(neck, run, 10 * n + m, kg) for run in runs]))
    family = FamilySettings().fit(played)
    return family, GreyBox().fit(eq22[0])


def judged(job: Job) -> dict[str, Any]:
    """Return what was certified of each requirement, and what is true."""
    family, own = known(job.neck, job.data)
    controller = resolve(KINDS[job.kind].settings)(**SPEEDS[job.speed]).design(family)
    # Without the observer, as margins are; loops over presets prove nothing here.
    few = {"sampling": {"plants": 100, "search_generations": 5}, "neck": {"necks": 0}}
    found = verify(controller, {"family": family, "greybox": own}, make_requirements(few))
    rows = {row["metric"]: row for row in found.contents()["requirements"]}
    truth = true_margins(job.neck, controller.block())
    return {
        "certified": {name: [rows[name]["value"], rows[name]["holds"]] for name in JUDGED},
        "true": truth,
        "margins": found.contents()["margins"],
        "whole": found.holds,
    }


def true_margins(neck: str, controller: Block) -> dict[str, float]:
    """Return the margins by experiment on the plant itself, without its noise and at both payloads."""

    def plant() -> BlockPart:
        if neck in OURS:
            return BlockPart(VirtualNeck(NeckParameters.preset(neck).without_noise()).block())
        return BlockPart(ForeignNeck(name=neck, noise=False).block())

    loops = [LoopUnderTest(name=neck, plant=plant, controller=controller, inputs={"payload": kg}) for kg in (0.0, 1.0)]
    return {name: float(values.min()) for name, (values, _) in crossing_values(crossings(loops)).items()}


def computed(unit: list[Job], kept: Path) -> list[dict[str, Any]]:
    """Return what the jobs of one neck find, or why they find nothing; keep each."""
    results = []
    with threadpool_limits(1):
        for job in unit:
            try:
                found = judged(job)
            except SoftneckError as error:
                found = {"failed": str(error)}
            results.append(found)
            keep(kept, {"job": astuple(job), "found": _finite(found)})
    return results


def _finite(value: Any) -> Any:
    """Return JSON values: what is infinite becomes a text."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return "inf" if isinstance(value, float) and math.isinf(value) else value


def _number(value: Any) -> float:
    """Return a margin; a certified one that is not known promises nothing."""
    return math.inf if value == "inf" else math.nan if value is None else float(value)


def false_rate(count: int, of: int, confidence: float = 0.95) -> float:
    """Return the upper bound of a rate of which `count` were seen in `of` (Clopper and Pearson 1934)."""
    from scipy.stats import beta

    return 1.0 if of == 0 or count == of else float(beta.ppf(confidence, count + 1, of - count))


def table(results: dict[Job, dict[str, Any]], necks: list[str]) -> None:
    """Print one block: false promises, refused though fine, pessimism."""
    for data in DATA:
        rows = {job: r for job, r in results.items() if job.neck in necks and job.data == data and "failed" not in r}
        failed = sum(job.neck in necks and job.data == data and "failed" in r for job, r in results.items())
        if not rows:
            continue
        print(f"\nFamily of {data}: {len(rows)} designs on {', '.join(necks)} ({failed} refused by the design)\n")
        print("| requirement | false promises | with 95 % at most | refused though fine | true/certified, median |")
        print("|---|---|---|---|---|")
        for name, limit in JUDGED.items():
            said = [(_number(r["certified"][name][0]), r["certified"][name][1], _number(r["true"][name]))
                    for r in rows.values()]  # fmt: skip
            held = [true for _, holds, true in said if holds]
            false = sum(true * ROUNDING < limit for true in held)
            fine = [holds for _, holds, true in said if true >= limit]
            over = sum(value > ROUNDING * true for value, holds, true in said if holds)
            ratios = [true / value for value, _, true in said if value > 0.0 and math.isfinite(true / value)]
            shown = f"{median(ratios):.2f}" if ratios else "-"
            print(
                f"| `{name}` >= {limit:g} | {false} of {len(held)} held ({over} certified above the truth) | "
                f"{100 * false_rate(false, len(held)):.0f} % | {sum(not h for h in fine)} of {len(fine)} | {shown} |"
            )
        print("\n| design | certified gain margin | true | certified delay margin [ms] | true |\n|---|---|---|---|---|")
        for job, r in rows.items():
            cells = [
                f"{_number(r['certified'][name][0]):.3g}{'' if r['certified'][name][1] else ' (refused)'} | "
                f"{_number(r['true'][name]):.3g}"
                for name in JUDGED
            ]
            print(f"| {job.neck} {job.kind} {job.speed} | {' | '.join(cells)} |")


def main() -> None:
    """Compute and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--necks", nargs="*", default=SHOWN, choices=SHOWN)
    parser.add_argument("--kinds", nargs="*", default=KINDS_JUDGED, choices=KINDS_JUDGED)
    parser.add_argument("--data", nargs="*", default=DATA, choices=DATA)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--fresh", action="store_true", help="Forget what is kept.")
    asked = parser.parse_args()
    kept = OUT / "results.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if asked.fresh:
        kept.unlink(missing_ok=True)
    results = {Job(*line["job"]): line["found"] for line in kept_lines(kept)}
    wanted = [Job(n, d, k, s) for n in asked.necks for d in asked.data for k in asked.kinds for s in SPEEDS]
    units: dict[tuple[str, str], list[Job]] = {}
    for job in wanted:
        if job not in results:
            units.setdefault((job.neck, job.data), []).append(job)
    # Started anew: a forked process would hold the locks of ours.
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(computed, unit, kept): unit for unit in units.values()}
        for done in as_completed(running):
            results |= zip(running[done], map(_finite, done.result()), strict=True)
            print(f"  {running[done][0].neck}, {running[done][0].data}", flush=True)
    shown = {job: results[job] for job in wanted}
    blocks: list[tuple[str, Callable[[str], bool]]] = [
        ("Necks on which defaults are chosen", lambda neck: neck not in HELD_OUT),
        ("Held out from every choice", lambda neck: neck in HELD_OUT),
    ]
    for title, part in blocks:
        necks = [neck for neck in asked.necks if part(neck)]
        if necks:
            print(f"\n## {title}")
            table(shown, necks)


if __name__ == "__main__":
    main()
