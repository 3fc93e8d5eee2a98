"""Run a study: submit runs to workers, collect and write their rows, and repeat the runs of dead workers.

Workers are this process, local processes of loky, or a Dask cluster; all are executors.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import signal
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softneck.core import (
    OutputFileError,
    Progress,
    SettingsError,
    SoftneckError,
    core_count,
    require_package,
    shown_progress,
    silent,
    take_cores,
)

from ..loops._loop_file import make_loop
from ..loops._loop_table import with_values
from ..loops._simulate import run_setup
from ._store import Store
from ._study import Point, Source, Study, load_study, make_study

if TYPE_CHECKING:
    import pandas as pd


# One thread each: the processes share the cores already.
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_CONNECT_S = 10


@dataclass(slots=True, eq=False)
class WorkerPool:
    """The workers of a study or a search: their number, their executor, and how to start one of a given size."""

    size: int
    pool: Executor
    start: Callable[[int], Executor] | None = None

    def renew(self, *, alone: bool) -> None:
        """Start new workers after one broke the pool; a single one if `alone`."""
        if self.start is not None:
            _shut_down(self.pool, kill=True)
            self.pool = self.start(1 if alone else self.size)


class SameProcess(Executor):
    """Executor in this process, without sending of objects; a crash ends the process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Run the function now."""
        future: Future = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextlib.contextmanager
def open_workers(workers: int | None, dask: str | None) -> Iterator[WorkerPool]:
    """Yield the workers: a cluster, a number of local processes (default: one for each core), or this process for 0."""
    if dask is not None:
        if workers is not None:
            raise SettingsError("give workers or a Dask scheduler, not both: a cluster has its own workers.")
        with contextlib.closing(_client(dask)) as client:
            there = client.scheduler_info(n_workers=-1)["workers"].values()
            pool = client.get_executor(pure=False)
            try:
                yield WorkerPool(max(1, sum(int(worker["nthreads"]) for worker in there)), pool)
            finally:
                pool.shutdown(wait=False)
        return
    cores = core_count()
    number = cores if workers is None else workers
    if isinstance(number, bool) or not isinstance(number, int) or number < 0:
        raise SettingsError(f"`workers` must be a whole number of at least 1 (0: this process); got {number!r}.")
    if number == 0:
        yield WorkerPool(1, SameProcess())
        return
    with tempfile.TemporaryDirectory(prefix="softneck-study-", ignore_cleanup_errors=True) as folder:
        start = partial(_processes, folder)
        found = WorkerPool(number, start(number), start)
        try:
            yield found
        except BaseException:
            _shut_down(found.pool, kill=True)
            raise
        _shut_down(found.pool, kill=False)


def _client(address: str) -> Any:
    """Return the client of a Dask scheduler."""
    require_package("distributed")
    from distributed import Client

    try:
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        raise SettingsError(
            f"no Dask scheduler answers at {address} ({type(error).__name__}); start one with `dask scheduler`."
        ) from error


def _processes(folder: str, size: int) -> Executor:
    """Return a pool of loky, whose processes neither fork threads nor import the user's script again."""
    from loky import ProcessPoolExecutor

    return ProcessPoolExecutor(size, timeout=None, initializer=_begin_worker, initargs=(folder,), env=_ENVIRONMENT)


def _shut_down(pool: Any, *, kill: bool) -> None:
    pool.shutdown(wait=True, kill_workers=kill)


def check_sendable(thing: Any) -> None:
    """Raise SettingsError if an object cannot be sent to another process."""
    import cloudpickle

    try:
        cloudpickle.dumps(thing)
    except SoftneckError:
        raise
    except Exception as error:  # of the user's objects
        raise SettingsError(
            f"the loop holds a part that cannot be sent to another process ({error}); use workers = 0, "
            'or python = "package.module:factory".'
        ) from error


def _begin_worker(folder: str) -> None:
    # The parent handles Ctrl-C, and removes the folder with the unpacked FMUs. Its workers share the cores already.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tempfile.tempdir = folder
    take_cores(core_count())
    atexit.register(gc.freeze)  # else it looks for unused objects while it ends, and the parent waits


Row = dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Some runs of a study with the data that a worker needs; runs with one `digest` share opened files."""

    digest: str
    loop: Mapping[str, Any]
    folder: Path
    points: Sequence[Point]
    metrics: Sequence[str]


def run_chunk(chunk: Chunk) -> list[Row]:
    """Return a row for each run: number, sample, seed, labels, metrics, whether limits hold, error, seconds."""
    return [_run_point(chunk, point) for point in chunk.points]


def _run_point(chunk: Chunk, point: Point) -> Row:
    begin = time.perf_counter()
    row: Row = {"run": point.run, "sample": point.sample, "seed": point.seed, **point.labels}
    row |= dict.fromkeys(chunk.metrics)
    row |= {"holds": None, "error": ""}
    try:
        row |= _run_loop(chunk, point)
    except SoftneckError as error:
        row["error"] = " ".join(str(error).split())
    except Exception as error:  # an error in a user's part ends its run, not the study
        row["error"] = " ".join(f"{type(error).__name__}: {error}".split())
    row["seconds"] = time.perf_counter() - begin
    return row


def release(digest: str) -> None:
    """Close the parts that this thread has opened for a study."""
    opened = _opened_parts(digest, threading.get_ident())
    for part in opened.values():
        if hasattr(part, "advance"):
            part.close()
    opened.clear()


def failed_row(point: Point, error: str, metrics: Sequence[str]) -> Row:
    """Return the row of a run that could not be finished."""
    row: Row = {"run": point.run, "sample": point.sample, "seed": point.seed, **point.labels}
    return row | dict.fromkeys(metrics) | {"holds": False, "error": error, "seconds": None}


def _run_loop(chunk: Chunk, point: Point) -> Row:
    opened = _opened_parts(chunk.digest, threading.get_ident())
    setup = make_loop(with_values(chunk.loop, point.values), chunk.folder, opened=opened)
    try:
        result = run_setup(setup, compiled=True, keep=True)
    finally:
        # FMUs stay loaded for the next run; parts of this run alone are closed.
        kept = [id(part) for part in opened.values()]
        for part in setup.loop.parts.values():
            if id(part) not in kept:
                part.close()
    table = result.metrics
    values = {f"{group}.{name}": value for group, metrics in table.items() for name, value in metrics.items()}
    return {**{name: values[name] for name in chunk.metrics}, "holds": result.holds if setup.limits else None}


@lru_cache(maxsize=64)
def _opened_parts(digest: str, thread: int) -> dict[Any, Any]:
    """Return this thread's cache of opened parts of a study: an FMU cannot serve two threads of a Dask worker."""
    del digest, thread
    return {}


# Work of a chunk [s]: lost if the worker is killed, and long beside the cost of sending it.
_CHUNK_S = 0.5
_MAX_CHUNK_RUNS = 200
# A run whose worker dies is repeated alone; after this many dead workers it is recorded as failed.
_MAX_TRIALS = 2


def study(
    loop: Source | Study,
    *,
    vary: Mapping[str, Any] | None = None,
    runs: int | None = None,
    seed: int = 0,
    objectives: Sequence[str] | None = None,
    workers: int | None = None,
    dask: str | None = None,
    output: str | Path | None = None,
    force: bool = False,
    report: Progress | None = None,
) -> pd.DataFrame:
    """Run a loop many times and return a row for each run: varied values, metrics, whether limits hold, error.

    The results depend only on the study and its seed, not on workers or the order in which runs end.

    Args:
        loop: a loop file, its table, a loop; or a study file or a `Study` without further settings.
        vary: dotted key -> {"grid": [...]}, {"choices": [...]}, {"uniform": [low, high]}, {"log_uniform": ...},
            {"normal": [mean, standard deviation]} or {"seed": True}; as [vary] in a study file.
        runs: number of runs; each random sample is run at all points of the grids.
        seed: of all random values.
        objectives: metrics to minimise.
        workers: number of local processes; default: one for each core; 0 for this process.
        dask: address of a Dask scheduler instead.
        output: folder for the results, `runs.csv`; default: nothing is kept.
        force: replace the study in `output`; else the same one is continued, and another is an error.
        report: called with the done fraction and a word; default: a progress bar in a terminal.

    Raises:
        SettingsError: a key that the loop does not have, an empty range, no runs, a folder with another study.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
        >>> controller = softneck.design_controller("pi", softneck.identify("rls", recording))
        >>> step = {"kind": "step", "pitch_deg": 10.0, "at_s": 0.5}
        >>> loop = {"duration_s": 3.0, "plant": "paper", "controller": controller, "reference": step}
        >>> sizes = {"reference.pitch_deg": {"grid": [5.0, 10.0]}}
        >>> runs = softneck.study(loop, vary=sizes, workers=0)
        >>> runs["reference.pitch_deg"].tolist()
        [5.0, 10.0]
    """
    # A file without `vary` is a study file.
    given = load_study(Path(loop)) if isinstance(loop, str | Path) and vary is None else loop
    made = given if isinstance(given, Study) else make_study(
        given, vary=vary or {}, runs=runs, seed=seed, objectives=objectives
    )  # fmt: skip
    if isinstance(given, Study) and (vary, runs, objectives) != (None, None, None):
        raise SettingsError("a study has its own vary, runs and objectives; make another one with `make_study`.")
    with shown_progress("study", report) as tell:
        if output is not None:
            return run_study(made, Path(output), workers=workers, dask=dask, force=force, report=tell)
        with tempfile.TemporaryDirectory(prefix="softneck-study-") as folder:
            return run_study(made, Path(folder), workers=workers, dask=dask, report=tell)


def run_study(
    study: Study,
    folder: Path,
    *,
    workers: int | None = None,
    dask: str | None = None,
    force: bool = False,
    report: Progress = silent,
) -> pd.DataFrame:
    """Run a study into `folder`; see `study`."""
    study.check()
    if workers != 0:
        check_sendable((dict(study.loop), [item.values for item in study.vary.values()]))
    with open_workers(workers, study.dask if dask is None and workers is None else dask) as members:
        store = Store(study, folder, force=force)
        try:
            _StudyRun(study, store, members, report).run()
        finally:
            release(study.digest)
    return store.finish()


class _StudyRun:
    """The runs of a study that are left, that are running, and those whose worker died."""

    def __init__(self, study: Study, store: Store, members: WorkerPool, report: Progress) -> None:
        self._study, self._store, self._workers, self._report = study, store, members, report
        self._left = deque(run for run in range(len(study.points)) if run not in store.done)
        self._suspects: deque[int] = deque()
        self._deaths: dict[int, int] = {}
        self._running: dict[Future, list[int]] = {}
        self._seconds, self._ended, self._failed = 0.0, 0, 0
        self._digest, self._alone = study.digest, False

    def run(self) -> None:
        """Submit runs and collect rows until all are written."""
        while self._left or self._suspects or self._running:
            self._submit_next()
            done, _ = wait(self._running, return_when=FIRST_COMPLETED)
            for future in done:
                if future in self._running:
                    self._collect(future)

    def _submit_next(self) -> None:
        if self._suspects:
            # Alone, so that another death shows which run is at fault.
            if not self._running:
                self._submit([self._suspects.popleft()])
            return
        if self._alone and not self._running and self._left:
            self._alone = False
            self._workers.renew(alone=False)
        # Two chunks for each worker: one runs while the other waits.
        while self._left and not self._alone and len(self._running) < 2 * self._workers.size:
            self._submit([self._left.popleft() for _ in range(self._chunk())])

    def _chunk(self) -> int:
        """Return the number of runs to submit at once: few while their duration is unknown, and at the end."""
        known = self._ended and self._seconds / self._ended
        wanted = int(_CHUNK_S / max(known, 1e-6)) if known else 1
        fair = -(-len(self._left) // (4 * self._workers.size))
        return max(1, min(wanted, fair, _MAX_CHUNK_RUNS, len(self._left)))

    def _submit(self, runs: list[int]) -> None:
        points = [self._study.points[run] for run in runs]
        chunk = Chunk(self._digest, self._study.loop, self._study.folder, points, self._study.metrics)
        try:
            self._running[self._workers.pool.submit(run_chunk, chunk)] = runs
        except BrokenExecutor:
            # The pool broke in the meantime; its other runs become suspects.
            self._suspects.extend(runs)
            self._restart()

    def _collect(self, future: Future) -> None:
        runs = self._running.pop(future)
        try:
            self._write(future.result())
        except BrokenExecutor:
            self._retry_alone(runs)
            self._restart()
        except CancelledError as error:
            raise OutputFileError(
                "the Dask scheduler is gone; finished runs are kept; run the same command again to continue."
            ) from error
        except OutputFileError:
            raise
        except Exception as error:  # a worker of Dask died, or its result could not be sent
            if len(runs) > 1:
                self._suspects.extend(runs)
            else:
                self._write_failure(runs[0], f"its worker failed: {type(error).__name__}: {error}")

    def _write_failure(self, run: int, message: str) -> None:
        self._write([failed_row(self._study.points[run], message, self._study.metrics)])

    def _retry_alone(self, runs: list[int]) -> None:
        """Repeat the runs of a dead worker, each alone; record one as failed that was alone already."""
        for run in runs:
            alone = len(runs) == 1 and not self._running
            self._deaths[run] = self._deaths.get(run, 0) + int(alone)
            if self._deaths[run] >= _MAX_TRIALS:
                self._write_failure(run, f"its worker process died {_MAX_TRIALS} times with it alone")
            else:
                self._suspects.append(run)

    def _restart(self) -> None:
        """Take back all running chunks, keep the finished ones, and start new workers."""
        for future, runs in list(self._running.items()):
            del self._running[future]
            try:
                self._write(future.result(timeout=60.0))
            except Exception:  # went down with the pool
                self._suspects.extend(runs)
        self._alone = True
        self._workers.renew(alone=True)

    def _write(self, rows: list[Row]) -> None:
        self._store.add(rows)
        self._ended += len(rows)
        self._seconds += sum(row["seconds"] or 0.0 for row in rows)
        self._failed += sum(bool(row["error"]) for row in rows)
        total, done = len(self._study.points), len(self._store.done)
        text = f"{done} of {total}" + (f", {self._failed} failed" if self._failed else "")
        self._report(done / total, text)
