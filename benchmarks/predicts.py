"""Print how well `identify auto` predicts: its scores beside what the kinds are then worth on tests it never saw.

`python benchmarks/predicts.py [--necks NECK...] [--seed N] [--workers N] [--fresh] [--two | --each [--kinds KIND...]]`

On each neck `choose` gets 140 s of Eq. 22, the last 30 % held out. What a kind is truly worth is its worst axis of
steps, sine and rotation in free run, trained with its defaults on the whole 140 s: from `benchmarks/baseline.py`, which
computes what is not kept. Printed for each neck: the rank correlation (Spearman) over the kinds between the scores and
the truth, that of the hold-out alone, what `auto` expects of the chosen model on other motions, and the regret: the
best kind's worst axis less that of the chosen model.
Choices are kept in `build/predicts`; they are of the code that made them: use --fresh after a change.

`--two`: what `auto` chooses of these 140 s and 60 s of `mixed`, what it expects and what the model is worth.

`--each`: how well the first figure that `identify KIND` prints predicts: what it expects of other motions. Each kind is
identified from 140 s of Eq. 22, and from these and 60 s of `mixed`. Printed: that figure, the same with factors of the
other necks alone, the worst part, the hold-out, and the truth of this very model: its worst axis of steps, sine and
rotation; then the share of neck x kind within 5 points of it.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy.stats import rankdata
from threadpoolctl import threadpool_limits

from benchmarks.baseline import MODELS, Job, compute, recorded, records_of_tests, training
from softneck.identification import INFINITE, Model, SetMembership, choose, identify, validate
from softneck.identification.selection._examination import MISSING, Examination, part_of_reference
from softneck.signals import Recording, signal
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import CHOOSING

SHOWN = (*CHOOSING, "paper", "rough")
OUT = Path("build/predicts")
# What is judged; `residual` and `ensemble` are made of these, and the baseline has the paper's form of `nlsm`.
KINDS = ("rls", "oe", "greybox", "play", "nn")
OTHER_FORM = "nlsm"


def worst_axis(model: Model, neck: str, seed: int) -> float:
    """Return the least free-run fit [%] over the tests and axes; -100 where one diverged."""
    judged = [validate(model, test, horizons=(INFINITE,)) for test in records_of_tests(neck, seed)]
    return _least(fit for test in judged for fit in test.fits[INFINITE].values())


def _least(fits: Any) -> float:
    return min(-100.0 if fit is None else max(fit, -100.0) for fit in fits)


def processor_seconds() -> float:
    """Return the processor time of this process and of those that it started and ended, as members of `guarded` are."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system


def chosen(neck: str, seed: int) -> dict[str, Any]:
    """Return the scores of all kinds, what `auto` took and what that is worth, and the processor time [s]."""
    whole = training(neck, seed)
    head, tail = whole.split(0.7)
    with threadpool_limits(1):
        begin = processor_seconds()
        choice = choose(head, tail, seed=seed)
        seconds = processor_seconds() - begin
        return {
            "scores": {one.kind: one.fit for one in choice.ranking if one.fit > float("-inf")},
            "hold_out": {one.kind: one.hold_out_fit for one in choice.ranking if one.fit > float("-inf")},
            "chosen": choice.chosen.kind,
            "said": cast(Examination, choice.chosen.examination).findings(choice.chosen.kind, whole.robot),
            "worth": worst_axis(cast(Model, choice.chosen.model), neck, seed),
            "form": worst_axis(SetMembership(form="residual").fit(whole), neck, seed),
            "seconds": seconds,
        }


def choices(necks: list[str], seed: int, workers: int, *, fresh: bool) -> dict[str, dict[str, Any]]:
    """Return what `chosen` finds on each neck; what an earlier run has computed is read."""
    kept = OUT / f"seed{seed}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    known = {line["neck"]: line["found"] for line in kept_lines(kept)}
    missing = [neck for neck in necks if neck not in known]
    with ProcessPoolExecutor(min(workers, max(1, len(missing))), mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(chosen, neck, seed): neck for neck in missing}
        for job in as_completed(jobs):
            known[jobs[job]] = job.result()
            keep(kept, {"neck": jobs[job], "found": job.result()})
    return {neck: known[neck] for neck in necks}


def print_two(necks: list[str], seed: int) -> None:
    """Print what `auto` chooses of two recordings, what it expects of other motions, and what the model is worth."""
    print(f"{'neck':8}{'chosen':>10}{'expected':>17}{'worth':>7}")
    for neck in necks:
        with threadpool_limits(1):
            model = identify("auto", two_motions(neck, seed), seed=seed)
        said = model.findings["examination"]
        expected, low, high = (_number(said[key]) for key in ("expected", "low", "high"))
        interval = f"{expected:.1f} ({low:.0f}..{high:.0f})"
        print(f"{neck:8}{model.kind:>10}{interval:>17}{worst_axis(model, neck, seed):7.1f}", flush=True)


def two_motions(neck: str, seed: int) -> list[Recording]:
    """Return 140 s of Eq. 22 and 60 s of `mixed` of a neck."""
    return [training(neck, seed), recorded(neck, signal("mixed", duration=60.0), 10 * seed + 5)]


# What a score may be off [points].
NEAR = 5.0


def each(neck: str, kind: str, motions: int, seed: int) -> dict[str, Any]:
    """Return what `identify KIND` prints of its model and what this model is worth, worst axis [%]."""
    parts = two_motions(neck, seed)[:motions]
    begin = processor_seconds()
    with threadpool_limits(1):
        model = identify(kind, parts)
    seconds = processor_seconds() - begin
    said = model.findings["examination"]
    # An examination that failed says nothing: it counts as one that says 0 %.
    least = {part: _least(fits.values()) for part, fits in said["parts"].items()}
    return {"said": said, "least": least, "worth": worst_axis(model, neck, seed), "seconds": seconds}


def print_each(necks: list[str], kinds: list[str], seed: int, *, fresh: bool) -> None:
    """Print what each kind says of itself beside what it is worth; what an earlier run has computed is read."""
    kept = OUT / f"each{seed}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    known = {tuple(line["job"]): line["found"] for line in kept_lines(kept)}
    for motions in (1, 2):
        for job in (found := [(neck, kind, motions) for neck, kind in product(necks, kinds)]):
            if job not in known:
                known[job] = each(*job, seed)
                keep(kept, {"job": job, "found": known[job]})
        heads = "".join(f"{head:>10}" for head in ("by others", "worst", "hold-out", "truth"))
        print(f"\n{motions} motion(s)\n{'neck':9}{'kind':9}{'expected':>16}{heads}")
        table = []
        for neck, kind, _ in found:
            one = known[neck, kind, motions]
            fit, expected, low, high = (_number(one["said"][key]) for key in ("fit", "expected", "low", "high"))
            # Where the paper's tests were simulated, there is no factor.
            alike = [job for job in found if job[0] != neck and MISSING.get(job[1]) == MISSING.get(kind)]
            others = [known[job] for job in alike if not _simulated(known[job]["said"])]
            factors = [(100.0 - other["worth"]) / (100.0 - _number(other["said"]["fit"])) for other in others]
            factor = np.median(factors) if factors else MISSING.get(kind, (1.0, 1.0))[motions - 1]
            elsewhere = expected if _simulated(one["said"]) else 100.0 - factor * (100.0 - fit)
            hold_out, worth = one["least"]["hold-out"], one["worth"]
            table.append(
                [*(abs(said - worth) <= NEAR for said in (expected, elsewhere, fit, hold_out)), low <= worth <= high]
            )
            parts = ", ".join(f"{part} {value:.0f}" for part, value in one["least"].items())
            print(
                f"{neck:9}{kind:9}{f'{expected:.1f} ({low:.0f}..{high:.0f})':>16}{elsewhere:10.1f}{fit:10.1f}"
                f"{hold_out:10.1f}{worth:10.1f}  {parts}; {one['seconds']:.0f} s",
                flush=True,
            )
        near = [f"{share:.0f} %" for share in 100.0 * np.mean(table, axis=0)]
        print(
            f"within {NEAR:g} points of the truth, of {len(table)}: what is expected {near[0]}, by factors of other "
            f"necks {near[1]}, the worst part {near[2]}, the hold-out {near[3]}; the interval holds {near[4]} of them"
        )


def _simulated(said: dict[str, Any]) -> bool:
    return any(part.startswith(part_of_reference("")) for part in said["parts"])


def _number(said: float | None) -> float:
    return -100.0 if said is None else said


def _rank_correlation(a: list[float], b: list[float]) -> float:
    return float(np.corrcoef(rankdata(a), rankdata(b))[0, 1])


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--necks", nargs="+", choices=SHOWN, default=list(SHOWN))
    parser.add_argument("--seed", type=int, default=0, help="of noise and of kinds that start at random (0)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("--fresh", action="store_true", help="choose again; the baseline stays")
    parser.add_argument("--two", action="store_true", help="what `auto` chooses of two recordings")
    parser.add_argument("--each", action="store_true", help="what `identify KIND` prints of each kind")
    parser.add_argument("--kinds", nargs="+", choices=MODELS, default=list(MODELS), help="of --each (all)")
    wanted = parser.parse_args()
    if wanted.each:
        print_each(wanted.necks, wanted.kinds, wanted.seed, fresh=wanted.fresh)
        return
    if wanted.two:
        print_two(wanted.necks, wanted.seed)
        return
    jobs = [Job(neck, kind, wanted.seed) for neck in wanted.necks for kind in KINDS]
    truths = {
        job: _least(np.ravel(found["fits"]).tolist())
        for job, found in compute(jobs, wanted.workers, fresh=False).items()
    }
    found = choices(wanted.necks, wanted.seed, wanted.workers, fresh=wanted.fresh)
    print(f"\n{'neck':8}{'rho':>7}{'hold-out':>10}{'chosen':>10}{'expected':>17}{'worth':>7}", end="")
    print(f"{'best':>10}{'regret':>8}{'cpu s':>7}")
    rhos = []
    for neck, one in found.items():
        truth = {job.kind: fit for job, fit in truths.items() if job.neck == neck} | {OTHER_FORM: one["form"]}
        kinds = [kind for kind in truth if kind in one["scores"]]
        worth = [truth[kind] for kind in kinds]
        rho, held = (_rank_correlation([one[what][kind] for kind in kinds], worth) for what in ("scores", "hold_out"))
        best = max(truth, key=lambda kind: truth[kind])
        rhos.append(rho)
        expected, low, high = (_number(one["said"][key]) for key in ("expected", "low", "high"))
        interval = f"{expected:.1f} ({low:.0f}..{high:.0f})"
        print(
            f"{neck:8} {rho:6.2f} {held:9.2f} {one['chosen']:>9} {interval:>16} {one['worth']:6.1f} {best:>9} "
            f"{truth[best] - one['worth']:7.1f} {one['seconds']:6.0f}"
        )
        print("         " + ", ".join(f"{kind} {one['scores'][kind]:.0f} ({truth[kind]:.0f})" for kind in kinds))
    print(f"rank correlation: median {np.median(rhos):.2f}, {min(rhos):.2f} to {max(rhos):.2f} over {len(rhos)} necks")


if __name__ == "__main__":
    main()
