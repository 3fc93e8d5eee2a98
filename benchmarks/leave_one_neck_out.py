"""Choose a default on all necks but one and judge it on that one, in turn: the one way in which defaults are chosen.

`python benchmarks/leave_one_neck_out.py WHAT [--seed N] [--specimens N] [--workers N] [--fresh]`

A score is divided by that of today's default on the same specimen, so that each neck counts alike; below 1 is better.
Scores are kept in `build/leave_one_neck_out`: a run that was stopped goes on where it was. They are of the code that
computed them: use --fresh after a change. What is chosen from where is the same for the same seed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

import softneck
from softneck.core import Vector
from softneck.estimation import KalmanSettings
from softneck.identification import INFINITE, Model, OutputError, Rls, validate
from softneck.identification.models._arrays import members
from softneck.identification.uncertainty._guarded import Guarded
from softneck.identification.uncertainty._guarded_base import Base
from softneck.plant import NeckParameters, VirtualNeck
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.choosing import choice, leave_one_out
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record

OURS = ("paper", "rough", "lab")
OUT = Path("build/leave_one_neck_out")
TESTS = ("steps", "sine", "rotation")
# (excitation, seed of the noise or None for a perfect sensor) -> what one specimen makes of it.
Run = Callable[[Excitation, int | None], Recording]


@dataclass(frozen=True, slots=True)
class Question:
    """A default to choose.

    Attributes:
        setting: its name.
        values: the candidates.
        settings: today's settings, whose value of that name is the default.
        score: what a specimen says of all candidates (candidate,); less is better.
    """

    setting: str
    values: tuple[Any, ...]
    settings: Any
    score: Callable[[Run, list[Any]], Vector]

    @property
    def default(self) -> int:
        """Place of today's default among the candidates."""
        return self.values.index(getattr(self.settings, self.setting))

    def candidates(self) -> list[Any]:
        """Return the settings with each value."""
        return [replace(self.settings, **{self.setting: value}) for value in self.values]


def free_run(run: Run, candidates: list[Any]) -> Vector:
    """Return each model's relative error in free run on the three tests, from 140 s of Eq. 22: 1 is a straight line."""
    train = run(signal("eq22"), 1).rows(0, 7000)
    tests = [run(signal(name), number) for number, name in enumerate(TESTS, start=2)]
    found = []
    for settings in candidates:
        model = settings.fit(train)
        fits = [fit for test in tests for fit in validate(model, test, horizons=(INFINITE,)).fits[INFINITE].values()]
        # One that diverges is as bad as can be, and no worse than that.
        found.append(np.mean([2.0 if fit is None else min(2.0, 1.0 - fit / 100.0) for fit in fits]))
    return np.array(found)


def observed(run: Run, candidates: list[Any]) -> Vector:
    """Return the rms error of each observer over the tests' measured angles without their noise [rad].

    They know the neck by an output-error model from 140 s of Eq. 22. A filter that follows its sensor does well here:
    what it makes of lost samples, outliers and rates is not asked.
    """
    model = OutputError().fit(run(signal("eq22"), 1).rows(0, 7000))
    pairs = [(run(signal(name), number), run(signal(name), None)) for number, name in enumerate(TESTS, start=2)]
    found = []
    for settings in candidates:
        observer = settings.design(model)
        errors = []
        for noisy, clean in pairs:
            estimates = observer.estimate(noisy)
            # A second for the filter to find its feet.
            errors.append((np.column_stack([estimates.pitch, estimates.roll]) - clean.outputs)[50:])
        found.append(np.sqrt(np.mean(np.concatenate(errors) ** 2)))
    return np.array(found)


def blended(run: Run, candidates: list[Any]) -> Vector:
    """Return as `free_run` does what guarded models are worth that differ in how they blend: trained only once."""
    train = run(signal("eq22"), 1).rows(0, 7000)
    tests = [run(signal(name), number) for number, name in enumerate(TESTS, start=2)]
    first = candidates[0].fit(train)
    parts = [Model(kind=kind, sample_time=first.sample_time, arrays=own) for kind, own in members(first.arrays)]
    base = Base(parts[0], first.arrays["sigma"], np.array(first.findings["base_fit_left_out"]))
    found = []
    for settings in candidates:
        model = settings.around(base, parts[1:], train)
        fits = [fit for test in tests for fit in validate(model, test, horizons=(INFINITE,)).fits[INFINITE].values()]
        found.append(np.mean([2.0 if fit is None else min(2.0, 1.0 - fit / 100.0) for fit in fits]))
    return np.array(found)


_DEGREES = (0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0)
QUESTIONS = {
    "rls.forgetting": Question("forgetting", (0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998, 1.0), Rls(), free_run),
    "rls.nb": Question("nb", (1, 2, 3, 5), Rls(), free_run),
    "oe.nf": Question("nf", (1, 2, 3), OutputError(), free_run),
    # Networks by `nss`, which trains a little faster than `nn`; minutes a specimen.
    "guarded.agreement": Question("agreement", (0.05, 0.1, 0.25, 0.5, 1.0), Guarded(of="nss", workers=1), blended),
    "guarded.unseen": Question("unseen", (0.025, 0.05, 0.1, 0.2, 0.4, 0.8), Guarded(of="nss", workers=1), blended),
    "observer.model_noise_std": Question(
        "model_noise_std", tuple(np.radians(_DEGREES).tolist()), KalmanSettings(), observed
    ),
    "observer.disturbance_noise_std": Question(
        "disturbance_noise_std", tuple(np.radians(_DEGREES).tolist()), KalmanSettings(), observed
    ),
}


def specimen(name: str, seed: int, number: int) -> Run:
    """Return specimen `number` of a neck, drawn from `seed`; number 0 is the nominal one."""
    # Seeds of tolerances and of noise that no other (seed, specimen) has.
    own = 1000 * seed + number
    if name in OURS:
        parameters = NeckParameters.preset(name)
        drawn = parameters.sample(np.random.default_rng([seed, number])) if number else parameters

        def ours(excitation: Excitation, noise: int | None) -> Recording:
            neck = VirtualNeck(drawn)
            return softneck.record(excitation, neck, seed=10 * own + (noise or 0), noise=noise is not None)

        return ours

    def foreign(excitation: Excitation, noise: int | None) -> Recording:
        neck = ForeignNeck(name=name, seed=own if number else 0, noise=noise is not None)
        return record(excitation, neck, seed=10 * own + (noise or 0))

    return foreign


def scored(what: str, name: str, seed: int, number: int) -> list[float]:
    """Return the scores of all candidates on one specimen."""
    # One thread each: there are as many processes as cores.
    with threadpool_limits(1):
        return QUESTIONS[what].score(specimen(name, seed, number), QUESTIONS[what].candidates()).tolist()


def all_scores(what: str, seed: int, specimens: int, workers: int, *, fresh: bool) -> dict[str, np.ndarray]:
    """Return (specimen, candidate) for each neck; what an earlier run has computed is read."""
    kept = OUT / f"{what}-seed{seed}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
    values, known = list(QUESTIONS[what].values), _known(kept, list(QUESTIONS[what].values))
    wanted = [(name, number) for name in (*CHOOSING, *OURS) for number in range(specimens)]
    missing = [job for job in wanted if job not in known]
    print(f"{what}, seed {seed}: {len(wanted) - len(missing)} of {len(wanted)} specimens are in {kept}", flush=True)
    # Started anew: a forked process would hold the locks of ours.
    with ProcessPoolExecutor(min(workers, max(1, len(missing))), mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(scored, what, name, seed, number): (name, number) for name, number in missing}
        for job in as_completed(jobs):
            known[jobs[job]] = job.result()
            keep(kept, {"neck": jobs[job], "values": values, "scores": known[jobs[job]]})
            print(f"  {jobs[job][0]} {jobs[job][1]}", flush=True)
    return {name: np.array([known[name, number] for number in range(specimens)]) for name in (*CHOOSING, *OURS)}


def _known(kept: Path, values: list[Any]) -> dict[tuple[str, int], list[float]]:
    """Return what is kept of these candidates."""
    found = {}
    for line in kept_lines(kept):
        if line["values"] == values:
            found[line["neck"][0], line["neck"][1]] = line["scores"]
    return found


def table(question: Question, scores: dict[str, np.ndarray]) -> None:
    """Print each fold, and what all necks together choose."""
    default = question.default
    names = [f"{value:.4g}" for value in question.values]
    folds = leave_one_out(scores, default)
    print(
        f"\n{question.setting}: today {names[default]}, with the score of `today`; others over that, below 1 is better"
    )
    heads = ("left out", "today", *names, "chosen", "so judged", "its own", "at best")
    print("  ".join(f"{cell:>10}" for cell in heads))
    for fold in folds:
        cells = [f"{np.median(scores[fold.left_out][:, default]):.3g}", *(f"{ratio:.3f}" for ratio in fold.ratios)]
        cells += [names[fold.chosen], f"{fold.ratios[fold.chosen]:.3f}", names[fold.best], f"{min(fold.ratios):.3f}"]
        print("  ".join(f"{cell:>10}" for cell in (fold.left_out, *cells)))
    judged = np.array([fold.ratios[fold.chosen] for fold in folds])
    together = choice({fold.left_out: fold.ratios for fold in folds}, default)
    print(
        f"all necks together choose {names[together]}; chosen without the neck it is judged on, a default is worth "
        f"{np.exp(np.mean(np.log(judged))):.3f} of today's (worst neck {judged.max():.3f})"
    )
    if together != default and together in (0, len(names) - 1):
        print(
            f"{names[together]} is the last of the candidates: add some beyond it, or ask whether the score says enough"
        )


def main() -> None:
    """Read the command line, compute what is missing, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=sorted(QUESTIONS), metavar="WHAT", help=", ".join(sorted(QUESTIONS)))
    parser.add_argument("--seed", type=int, default=0, help="of specimens and noise (0)")
    parser.add_argument("--specimens", type=int, default=3, help="of each neck (3)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("--fresh", action="store_true", help="compute everything again")
    wanted = parser.parse_args()
    scores = all_scores(wanted.what, wanted.seed, wanted.specimens, wanted.workers, fresh=wanted.fresh)
    table(QUESTIONS[wanted.what], scores)


if __name__ == "__main__":
    main()
