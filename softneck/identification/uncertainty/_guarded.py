"""Kind `guarded`: several models of one kind, and a base that takes over where they disagree or extrapolate."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    KINDS,
    DataError,
    FileFormatError,
    Matrix,
    Progress,
    SettingsError,
    SoftneckError,
    Vector,
    core_count,
    find_kind,
    one_blas_thread,
    require_one_of,
    require_positive,
    require_whole,
    resolve,
    side_by_side,
    silent,
)
from softneck.signals import Recording, concatenate

from ..models._arrays import COMPOSED, memory_of, prefixed_arrays, trained_set_points, within
from ..models._directions import NECK_SECONDS, time_constant_of
from ..models._fitting import robot_at_rest, row_hashes, training_recording
from ..models._model import WARM_UP, Model
from ..models._validity import with_validity_region
from ..networks._network import Network
from ..set_membership._set_membership import SetMembership
from ..structured._greybox import as_found
from ..structured._play import Play

# One thread for each matrix product: the processes share the cores already.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """A module's function and its arguments; `name` is for progress."""

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


def run_jobs(jobs: Sequence[Job], workers: int, progress: Progress) -> list[Any]:
    """Run the jobs in `workers` processes, or here for 1; return results in order. Whatever a job raises ends all."""
    if workers < 2:
        found = []
        for number, job in enumerate(jobs):
            progress(number / len(jobs), job.name)
            found.append(job.function(*job.arguments))
        return found
    from loky import ProcessPoolExecutor, as_completed

    pool = ProcessPoolExecutor(workers, timeout=None, initializer=_begin_worker, env=_ENVIRONMENT)
    try:
        futures = [pool.submit(job.function, *job.arguments) for job in jobs]
        progress(0.0, f"{len(jobs)} models in {workers} processes")
        for number, future in enumerate(as_completed(futures), start=1):
            future.result()
            progress(number / len(jobs), f"{number} of {len(jobs)} models")
    except BaseException:
        pool.shutdown(wait=True, kill_workers=True)
        raise
    pool.shutdown(wait=True)
    return [future.result() for future in futures]


def _begin_worker() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle


# What is left of a run is worth training on, or judging by, from here on [rows].
_MIN_BLOCK_ROWS = 3 * WARM_UP


def left_out(recording: Recording, parts: int) -> list[tuple[Recording, Recording]]:
    """Return (rest, part) for each part: whole runs where there are as many, else blocks of each run, never joined."""
    runs = recording.runs()
    if len(runs) >= parts:
        return [
            (concatenate([run for n, run in enumerate(runs) if n % parts != i]),
             concatenate([run for n, run in enumerate(runs) if n % parts == i]))
            for i in range(parts)
        ]  # fmt: skip
    return [_block(runs, i, parts) for i in range(parts)]


def _block(runs: Sequence[Recording], i: int, parts: int) -> tuple[Recording, Recording]:
    rest, part = [], []
    for run in runs:
        low, high = (round(len(run) * edge / parts) for edge in (i, i + 1))
        rest += [run.rows(a, b) for a, b in ((0, low), (high, len(run))) if b - a >= _MIN_BLOCK_ROWS]
        if high - low >= _MIN_BLOCK_ROWS:
            part.append(run.rows(low, high))
    # Too short to be cut: trained on and judged by all of it, as the kinds do themselves.
    return concatenate(rest or list(runs)), concatenate(part or list(runs))


def left_out_error(fit: Callable[[Recording], Model], parts: Sequence[tuple[Recording, Recording]]) -> Vector:
    """Return the rms error (outputs,) of simulations over parts that were left out in turn; inf where one diverges."""
    calls = [lambda rest=rest, part=part: _simulation_errors(fit(rest), part) for rest, part in parts]
    errors = np.concatenate(side_by_side(calls))
    return np.sqrt(np.nanmean(errors**2, axis=0))


def _simulation_errors(model: Model, recording: Recording) -> Matrix:
    """Return the errors (rows, outputs) of a simulation, without the samples that set its initial state."""
    Y = model.simulate(recording)[:, : recording.outputs.shape[1]]
    errors = np.where(np.isfinite(Y), recording.outputs - Y, np.where(np.isfinite(recording.outputs), np.inf, np.nan))
    starts = np.concatenate([np.arange(len(run)) < WARM_UP for run in recording.runs()])
    return errors[~starts]


# What a base may be where none is named: equations where they fit, else a line.
BASES = ("greybox", "oe")
# Of so many parts these are left out in turn to judge a base by: two say how much it misses, five would take longer.
_BLOCKS, _TEST_BLOCKS = 5, (1, 3)
# Of the outputs' spread: a base that misses more than this of it saves nothing.
_POOR_ERROR_RATIO = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Base:
    """Base trained on all rows; `error` (outputs,) rms of its simulation on rows left out [outputs'], as `fit` [%]."""

    model: Model
    error: Vector
    fit: Vector

    @property
    def remark(self) -> str:
        """A warning about a poor base; empty for a good one."""
        if self.fit.min() >= 100.0 * (1.0 - _POOR_ERROR_RATIO):
            return ""
        return (
            f"the base `{self.model.kind}` itself reaches {self.fit.min():.0f} % only on rows left out: where the "
            "members part, this model is no better than that"
        )


def fitted_base(kind: str, recording: Recording, settings: Any = None) -> Base:
    """Return a base of that kind, with the kind's defaults where no settings are given."""
    settings = resolve(KINDS[kind].settings)() if settings is None else settings
    model = settings.fit(recording)
    parts = left_out(recording, _BLOCKS)
    # Its dead time and parts are properties of the robot: known once, they need not be searched for again.
    again = as_found(settings, model) if kind == "greybox" else settings
    error = left_out_error(again.fit, [parts[i] for i in _TEST_BLOCKS])
    spread = np.nanstd(recording.outputs, axis=0)
    return Base(model, error, 100.0 * (1.0 - error / spread))


def base_or_reason(kind: str, recording: Recording) -> Base | str:
    """Return a base of that kind, or why there is none."""
    try:
        return fitted_base(kind, recording)
    except SoftneckError as error:
        return f"{kind}: {error}"


OF = ("nn", "play", "nlsm")
# Weight decays of `nn`, one after the other over the members, as over the starts of one network.
_WEIGHT_DECAYS = (0.03, 0.1, 0.01)
# Scaled seconds from members to base: one and a half time constants.
_FADE_S = 0.3
# Motor positions that stand for all that were seen.
_MAX_COVERING_POINTS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarded:
    """Members of one learned kind that fade to a base where they disagree, or where motors leave the training range.

    Each member starts differently, with one start of its own, and leaves out another block of the recordings, on which
    it is chosen. The base is trained on all rows, and its error judged on blocks left out. All run free by themselves;
    their outputs are blended by weights of inverse variance that move at a limited rate.

    Attributes:
        of: kind of the members: "nn", "play" or "nlsm" (in its form `residual`, which can run free).
        members: how many.
        base: kind to fall back to; None takes `greybox` or `oe`, whichever misses less on blocks left out.
        agreement: weight of the squared spread of the members beside the base's squared error.
        unseen: how fast the members' error is taken to grow beyond what was seen, in spreads of the output a spread of
            the motors.
        fade: time in which the weight can go from members to base [s]; None: 1.5 time constants (of a neck 0.3 s).
        seed: of the first member; the next have the next seeds.
        workers: processes to train `nn` in; None takes all cores, 1 none. It changes no result.
    """

    of: str = "nn"
    members: int = 5
    base: str | None = None
    agreement: float = 0.25
    unseen: float = 0.1
    fade: float | None = None
    seed: int = 0
    workers: int | None = None

    def __post_init__(self) -> None:
        require_one_of("of", self.of, OF)
        require_whole("members", self.members, 2, 20)
        if self.base is not None:
            find_kind(self.base, "model")
            if self.base in (*COMPOSED, "nlsm"):
                raise SettingsError(f"a model of kind `{self.base}` cannot be a base; take {' or '.join(BASES)}.")
        require_positive("agreement", self.agreement)
        require_positive("unseen", self.unseen)
        if self.fade is not None:
            require_positive("fade", self.fade, "s")
        require_whole("seed", self.seed, 0, 2**62)
        if self.workers is not None:
            require_whole("workers", self.workers, 1, 1000)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify base and members; Ctrl-C ends it without a model. DataError: a member's, or no base that fits."""
        recording = training_recording(recordings)
        jobs = [Job("base", base_or_reason, (kind, recording)) for kind in BASES]
        if self.base is not None:
            jobs = [Job("base", fitted_base, (self.base, recording))]
        wanted = len(jobs)
        for number, (rest, part) in enumerate(left_out(recording, self.members)):
            jobs.append(Job(f"member {number + 1}", _member, (self.of, self.seed + number, rest, part)))
        # The others are trained sooner than processes start.
        workers = min(self.workers or core_count(), len(jobs)) if self.of == "nn" else 1
        found = run_jobs(jobs, workers, progress)
        model = self.around(_least_missing(found[:wanted]), found[wanted:], recording)
        progress(1.0, "done")
        return model

    def around(self, base: Base, members: list[Model], recording: Recording) -> Model:
        """Return the guarded model of a base and members that are there already."""
        robot, Ts = recording.robot, recording.sample_time
        outputs, motors = len(robot.outputs.names), len(robot.motors.names)
        M = base.model.simulate(recording)[:, outputs : outputs + motors]
        seen, reach = covering(M, _MAX_COVERING_POINTS)
        seconds = time_constant_of(recording) or NECK_SECONDS
        fade = _FADE_S * (seconds / NECK_SECONDS) if self.fade is None else self.fade
        parts = [base.model, *members]
        arrays = {
            "history": np.array([1.0] if (outputs, motors) == (2, 3) else [1.0, outputs, motors]),
            "memory": np.array([float(max(memory_of(part.arrays) for part in parts))]),
            "sigma": base.error,
            "slope": self.unseen * np.nanstd(recording.outputs, axis=0) / np.sqrt(np.mean(M.var(axis=0))),
            "fading": np.array([self.agreement, Ts / fade]),
            "seen": seen,
            "reach": np.array([reach]),
            **prefixed_arrays([(part.kind, part.arrays) for part in parts]),
        }
        findings: dict[str, Any] = {
            "members": f"{len(members)} of {members[0].kind}",
            "base": base.model.kind,
            "base_fit_left_out": base.fit.tolist(),
            **({"remark": base.remark} if base.remark else {}),
            **trained_set_points(recording),
        }
        model = Model(
            kind="guarded",
            sample_time=Ts,
            arrays=arrays,
            settings=asdict(replace(self, base=base.model.kind, workers=None)),
            findings=findings,
            training_rows=row_hashes(recording),
            robot=robot_at_rest(recording),
        )
        return with_validity_region(model, recording)


def _member(kind: str, seed: int, rest: Recording, part: Recording) -> Model:
    """Return one member; `part` is its hold-out."""
    if kind == "nn":
        # The members are each other's starts: one of its own costs each a third of what a network alone takes.
        # No prior: where nothing was recorded they are to part.
        settings = Network(
            seed=seed, starts=1, iterations=20, decay=_WEIGHT_DECAYS[seed % len(_WEIGHT_DECAYS)], prior=0.0
        )
        return settings.fit(rest, hold_out=part)
    return (Play() if kind == "play" else SetMembership(form="residual")).fit(rest)


def _least_missing(found: list[Base | str]) -> Base:
    """Return the base of the lowest error on rows left out."""
    bases = [base for base in found if isinstance(base, Base) and np.isfinite(base.error).all()]
    if not bases:
        reasons = "; ".join(base if isinstance(base, str) else f"{base.model.kind} diverges" for base in found)
        raise DataError(f"there is no base to fall back to: {reasons}. Record with more excitation, or set `base`.")
    return max(bases, key=lambda base: float(base.fit.mean()))


def covering(points: Matrix, most: int) -> tuple[Matrix, float]:
    """Return up to `most` points (rows, n), each farthest from those before (Gonzalez 1985), and how far any is."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most and distance.max() > 0.0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.ascontiguousarray(points[chosen]), float(distance.max())


def check_guarded(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["points"]]), 1, np.inf, "the number of points that were seen")
    low = {"sigma": np.nextafter(0.0, 1.0), "slope": 0.0, "fading": np.nextafter(0.0, 1.0), "reach": 0.0}
    for name, least in low.items():
        if (arrays[name] < least).any():
            raise FileFormatError(f"its array `{name}` must be {'positive' if least else '0 or positive'}.")
