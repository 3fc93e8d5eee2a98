"""Choose a default on all necks but one and judge it on that one, in turn: the one way in which defaults are chosen.

`python benchmarks/leave_one_neck_out.py WHAT [--seed N] [--necks NECK...] [--specimens N] [--workers N] [--fresh]`

A score is divided by that of today's default on the same specimen, so that each neck counts alike; below 1 is better.
Scores are kept in `build/leave_one_neck_out`: a run that was stopped goes on where it was. They are of the code that
computed them: use --fresh after a change. What is chosen from where is the same for the same seed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import mpc_following
import numpy as np
from threadpoolctl import threadpool_limits

import softneck
from softneck.core import KINDS, Vector, load, resolve
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings
from softneck.identification import INFINITE, GreyBox, Model, Network, OutputError, Rls, validate
from softneck.identification.models._arrays import members
from softneck.identification.models._model import WARM_UP
from softneck.identification.models._validity import TRUST, tolerance_of, with_validity_region
from softneck.identification.uncertainty._guarded import Base, Guarded
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot
from softneck.runtime import Block
from softneck.signals import Excitation, Recording, signal
from tests.foreign_necks.choosing import choice, leave_one_out
from tests.foreign_necks.kept import keep, kept_lines
from tests.foreign_necks.necks import CHOOSING, ForeignNeck, record
from tests.foreign_necks.spoiled import errors_deg, filtered, logged, motions, moved, spoiled

OURS = ("paper", "rough", "lab")
OUT = Path("build/leave_one_neck_out")
TESTS = ("steps", "sine", "rotation")


@dataclass(frozen=True, slots=True)
class Run:
    """One specimen of a neck, to be moved.

    Attributes:
        name: of the neck.
        seed, number: which specimen, drawn from `seed`; number 0 is the nominal one.
    """

    name: str
    seed: int
    number: int

    def __call__(self, excitation: Excitation, noise: int | None) -> Recording:
        """Return what it makes of a signal; `noise` is the seed of its sensor's, None for a perfect one."""
        if self.name in OURS:
            return softneck.record(
                excitation, VirtualNeck(self._drawn()), seed=self.seeded(noise or 0), noise=noise is not None
            )
        return record(excitation, self._foreign(noise=noise is not None), seed=self.seeded(noise or 0))

    def seeded(self, noise: int) -> int:
        """Return a seed of noise that no other (seed, specimen) has."""
        return 10 * (1000 * self.seed + self.number) + noise

    def still(self) -> Block:
        """Return it as a plant whose sensor has no noise."""
        if self.name in OURS:
            return VirtualNeck(self._drawn().without_noise()).block()
        return self._foreign(noise=False).block()

    def _drawn(self) -> NeckParameters:
        parameters = NeckParameters.preset(self.name)
        return parameters.sample(np.random.default_rng([self.seed, self.number])) if self.number else parameters

    def _foreign(self, *, noise: bool) -> ForeignNeck:
        return ForeignNeck(name=self.name, seed=1000 * self.seed + self.number if self.number else 0, noise=noise)


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


def missed(model: Model, tests: list[Recording]) -> float:
    """Return the mean relative error of a model in free run: 1 is a straight line."""
    fits = [fit for test in tests for fit in validate(model, test, horizons=(INFINITE,)).fits[INFINITE].values()]
    # One that diverges is as bad as can be, and no worse than that.
    return float(np.mean([2.0 if fit is None else min(2.0, 1.0 - fit / 100.0) for fit in fits]))


def fitted(settings: Any, run: Run, train: Recording) -> Model:
    """Return what `settings` make of a specimen's Eq. 22; kept, as several questions ask the same."""
    told = hashlib.sha256(repr(settings).encode()).hexdigest()[:12]
    path = OUT / "models" / f"{run.name}-{run.seed}-{run.number}-{told}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        settings.fit(train).save(path, force=True)
    return load(path, role="model")


def free_run(run: Run, candidates: list[Any]) -> Vector:
    """Return each model's relative error in free run on the three tests, from 140 s of Eq. 22: 1 is a straight line."""
    train = run(signal("eq22"), 1).rows(0, 7000)
    tests = [run(signal(name), number) for number, name in enumerate(TESTS, start=2)]
    return np.array([missed(fitted(settings, run, train), tests) for settings in candidates])


@dataclass(frozen=True, slots=True)
class AnyRobot:
    """An estimator with a constant that only robots other than a neck know.

    Attributes:
        module: the constant's, in softneck.identification.
        constant: its name.
        estimator: of records of such robots.
        value: of the constant.
    """

    module: str
    constant: str
    estimator: Any
    value: Any

    def fit(self, recording: Recording) -> Model:
        """Return the model of a record."""
        module = import_module(f"softneck.identification.{self.module}")
        today = getattr(module, self.constant)
        setattr(module, self.constant, self.value)
        try:
            return self.estimator.fit(recording)
        finally:
            setattr(module, self.constant, today)


def free_run_of_any_robot(run: Run, candidates: list[Any]) -> Vector:
    """Return as `free_run` what is left in free run from a few seconds of Eq. 22, the neck said to be none.

    Its directions and time constants are learned. Records are as short as those of slow robots are.
    """
    robot = Robot.from_dict(_UNKNOWN)
    whole = replace(run(signal("eq22"), 1), robot=robot)
    tests = [replace(run(signal(name), number), robot=robot) for number, name in enumerate(TESTS, start=2)]
    return np.array([
        np.mean([missed(settings.fit(whole.rows(0, rows)), tests) for rows in _SHORT]) for settings in candidates
    ])  # fmt: skip


def observed(run: Run, candidates: list[Any], over: Any = OutputError) -> Vector:
    """Return the rms error of each observer against the true angles [deg], of motions that a poor sensor saw.

    They know the neck by a model, `over()`, of 140 s of Eq. 22 with the same noise.
    """
    block = run.still()
    model = over().fit(logged(moved(block, signal("eq22"), run.seeded(1)).rows(0, 7000)))
    runs = [spoiled(block, motion, run.seeded(number)) for number, motion in enumerate(motions(), start=2)]
    found = []
    for settings in candidates:
        observer = settings.design(model)
        found.append(errors_deg(runs, [filtered(observer, item.recording) for item in runs])[0])
    return np.array(found)


def observed_grey(run: Run, candidates: list[Any]) -> Vector:
    """Return `observed` of observers over a grey box."""
    return observed(run, candidates, GreyBox)


def blended(run: Run, candidates: list[Any]) -> Vector:
    """Return as `free_run` does what guarded models are worth that differ in how they blend: trained only once."""
    train = run(signal("eq22"), 1).rows(0, 7000)
    tests = [run(signal(name), number) for number, name in enumerate(TESTS, start=2)]
    first = candidates[0].fit(train)
    parts = [Model(kind=kind, sample_time=first.sample_time, arrays=own) for kind, own in members(first.arrays)]
    base = Base(parts[0], first.arrays["sigma"], np.array(first.findings["base_fit_left_out"]))
    return np.array([missed(settings.around(base, parts[1:], train), tests) for settings in candidates])


def trusted(run: Run, candidates: list[Any], kinds: tuple[str, ...]) -> Vector:
    """Return the mean Brier score of `validity` on the three tests by each way to trust models: trained only once."""
    train = run(signal("eq22"), 1).rows(0, 7000)
    tests = [run(signal(name), number) for number, name in enumerate(TESTS, start=2)]
    found = np.zeros(len(candidates))
    for kind in kinds:
        model = fitted(_NN if kind == "nn" else resolve(KINDS[kind].settings)(), run, train)
        for place, trust in enumerate(candidates):
            told = with_validity_region(model, train, trust=trust)
            for test in tests:
                free, allowed = told.simulate(test)[WARM_UP:], tolerance_of(told)
                held = (np.abs(test.outputs[WARM_UP:] - free[:, :2]) <= allowed).all(axis=1)
                found[place] += np.mean((free[:, -1] - held) ** 2) / (len(tests) * len(kinds))
    return found


def lines_trusted(run: Run, candidates: list[Any]) -> Vector:
    """Return `trusted` of kinds whose error elsewhere is as their error here."""
    return trusted(run, candidates, ("oe", "greybox"))


def learned_trusted(run: Run, candidates: list[Any]) -> Vector:
    """Return `trusted` of kinds that are learnt from rows alone."""
    return trusted(run, candidates, ("play", "nn"))


def follows(run: Run, candidates: list[Any]) -> Vector:
    """Return what `mpc_following.py` says of predictive controllers that follow steps and circles."""
    number = 1000 * run.seed + run.number if run.number else 0
    return mpc_following.scores(mpc_following.neck(run.name, number), candidates)


_UNKNOWN: dict[str, Any] = {
    "name": "unknown",
    "motors": {"names": ["a", "b", "c"], "unit": "rad"},
    "outputs": {"names": ["pitch", "roll"], "unit": "rad"},
    "directions": {"kind": "identified"},
}
_SHORT = (250, 600)  # rows of records: 5 and 12 s
# Fewer starts and steps stand for those of a whole training.
_NN = Network(starts=1, iterations=10)
_DEGREES = (0.05, 0.15, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
QUESTIONS = {
    "rls.forgetting": Question("forgetting", (0.99, 0.995, 0.998, 0.999, 0.9995, 0.9998, 1.0), Rls(), free_run),
    "rls.nb": Question("nb", (1, 2, 3, 5), Rls(), free_run),
    "oe.nf": Question("nf", (1, 2, 3), OutputError(), free_run),
    # Minutes a specimen.
    "guarded.agreement": Question("agreement", (0.05, 0.1, 0.25, 0.5, 1.0), Guarded(workers=1), blended),
    "guarded.unseen": Question("unseen", (0.025, 0.05, 0.1, 0.2, 0.4, 0.8), Guarded(workers=1), blended),
    # Constants that only robots other than a neck know.
    "robot.rows_each": Question(
        "value", (1, 2, 4, 8, 16), AnyRobot("networks._network", "_ROWS_EACH", _NN, 4), free_run_of_any_robot
    ),
    "nn.prior": Question("prior", (0.0, 0.03, 0.1, 0.3), _NN, free_run),
    "validity.lines": Question("growth", (0.0, 0.3, 1.0, 2.0, 4.0), TRUST["oe"], lines_trusted),
    "validity.lines.ratio": Question("ratio", (0.5, 0.7, 1.0, 1.5, 2.0), TRUST["oe"], lines_trusted),
    "validity.learned": Question(
        "slope", (0.002, 0.005, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1), TRUST["nn"], learned_trusted
    ),
    "validity.learned.ratio": Question("ratio", (0.7, 1.0, 1.5, 2.0, 3.0, 5.0), TRUST["nn"], learned_trusted),
    "observer.disturbance_noise_std": Question(
        "disturbance_noise_std", tuple(np.radians(_DEGREES).tolist()), KalmanSettings(), observed
    ),
    "observer.measurement_noise_std": Question(
        "measurement_noise_std", (None, *np.radians((0.02, 0.1, 0.25, 0.5)).tolist()), KalmanSettings(), observed
    ),
    "mpc.taut_pole": Question("taut_pole", (6.0, 9.0, 12.0), MpcNumbers(), follows),
    "mpc.least_delay": Question("least_delay", (0.08, 0.1, 0.12), MpcNumbers(), follows),
    "mpc.reference_time": Question("reference_time", (0.0, 0.05, 0.1, 0.2), MpcNumbers(), follows),
    "mpc.minimum_tautness": Question("minimum_tautness", (None, 0.0, 0.5, 0.75), MpcNumbers(), follows),
    "mpc.payload_tautness": Question("payload_tautness", (0.0, 1.5, 3.0), MpcNumbers(), follows),
    "mpc.max_sensitivity": Question("max_sensitivity", (1.4, 1.5, 1.6), MpcNumbers(), follows),
    "observer.sensor_delay": Question("sensor_delay", (0.0, 0.03, 0.04, 0.05, 0.06, 0.07), KalmanSettings(), observed),
}


def scored(what: str, name: str, seed: int, number: int) -> list[float]:
    """Return the scores of all candidates on one specimen."""
    # One thread each: there are as many processes as cores.
    with threadpool_limits(1):
        return QUESTIONS[what].score(Run(name, seed, number), QUESTIONS[what].candidates()).tolist()


def all_scores(
    what: str, necks: list[str], seed: int, specimens: int, workers: int, *, fresh: bool
) -> dict[str, np.ndarray]:
    """Return (specimen, candidate) for each neck; what an earlier run has computed is read."""
    kept = OUT / f"{what}-seed{seed}.jsonl"
    kept.parent.mkdir(parents=True, exist_ok=True)
    if fresh:
        kept.unlink(missing_ok=True)
        for model in OUT.glob("models/*.npz"):
            model.unlink()
    values, known = list(QUESTIONS[what].values), _known(kept, list(QUESTIONS[what].values))
    wanted = [(name, number) for name in necks for number in range(specimens)]
    missing = [job for job in wanted if job not in known]
    print(f"{what}, seed {seed}: {len(wanted) - len(missing)} of {len(wanted)} specimens are in {kept}", flush=True)
    # Started anew: a forked process would hold the locks of ours.
    with ProcessPoolExecutor(min(workers, max(1, len(missing))), mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(scored, what, name, seed, number): (name, number) for name, number in missing}
        for job in as_completed(jobs):
            known[jobs[job]] = job.result()
            keep(kept, {"neck": jobs[job], "values": values, "scores": known[jobs[job]]})
            print(f"  {jobs[job][0]} {jobs[job][1]}", flush=True)
    return {name: np.array([known[name, number] for number in range(specimens)]) for name in necks}


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
    names = ["own" if value is None else f"{value:.4g}" for value in question.values]
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
    everywhere = (*CHOOSING, *OURS)
    parser.add_argument("--necks", nargs="+", choices=everywhere, default=everywhere, help=f"{', '.join(everywhere)}")
    parser.add_argument("--specimens", type=int, default=3, help="of each neck (3)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (all cores)")
    parser.add_argument("--fresh", action="store_true", help="compute everything again")
    wanted = parser.parse_args()
    scores = all_scores(
        wanted.what, list(wanted.necks), wanted.seed, wanted.specimens, wanted.workers, fresh=wanted.fresh
    )
    table(QUESTIONS[wanted.what], scores)


if __name__ == "__main__":
    main()
