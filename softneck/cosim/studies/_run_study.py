"""A study at work: runs given out, taken in, written down; a worker that dies loses nothing."""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softneck.core import OutputFileError, Progress, SettingsError, silent
from softneck.core._progress import shown_progress

from ._executors import Crew, check_sendable, crew
from ._store import Store
from ._study import Source, Study, load_study, make_study
from ._study_run import Chunk, Row, failed_row, release, run_chunk

if TYPE_CHECKING:
    import pandas as pd


# So much work at a time [s]: a kill loses no more than this, and giving out costs little of it.
_CHUNK_S = 0.5
_LARGEST_CHUNK = 200
# A run whose worker dies is tried alone; after so many dead workers it is the run's fault.
_TRIALS = 2


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
    """Run a loop many times and return a row for each run: what varied, metrics, whether limits hold, error.

    The numbers depend on the study and its seed alone, not on workers or the order in which runs end.

    Args:
        loop: a loop file, its table, a loop; or a study file or a `Study`, to which no other setting is added.
        vary: dotted key -> {"grid": [...]}, {"choices": [...]}, {"uniform": [low, high]}, {"log_uniform": ...},
            {"normal": [mean, standard deviation]} or {"seed": True}; as [vary] in a study file.
        runs: how many; each random sample meets every point of the grids before the next one.
        seed: of all that is drawn.
        objectives: metrics to be small.
        workers: local processes, as many as cores if not given; 0 for this process.
        dask: address of a Dask scheduler instead.
        output: folder that keeps the runs as they end, in `runs.csv`; nothing is kept without one.
        force: replace the study that `output` holds; else the same one goes on, and another is an error.
        report: called with the part done and a word; a bar in a terminal if not given.

    Raises:
        SettingsError: a key that the loop does not have, an empty range, no runs, another study's folder.

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
    # A file without `vary` is a study file: a loop file alone has nothing to vary.
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
    with crew(workers, study.dask if dask is None and workers is None else dask) as members:
        store = Store(study, folder, force=force)
        try:
            _Work(study, store, members, report).run()
        finally:
            release(study.digest)
    return store.finish()


class _Work:
    """The runs that are left, those that are out, and those whose worker died."""

    def __init__(self, study: Study, store: Store, members: Crew, report: Progress) -> None:
        self._study, self._store, self._crew, self._report = study, store, members, report
        self._left = deque(run for run in range(len(study.points)) if run not in store.done)
        self._suspects: deque[int] = deque()
        self._deaths: dict[int, int] = {}
        self._out: dict[Future, list[int]] = {}
        self._seconds, self._ended, self._failed = 0.0, 0, 0
        self._digest, self._alone = study.digest, False

    def run(self) -> None:
        """Give out and take in until all runs are written down."""
        while self._left or self._suspects or self._out:
            self._give()
            done, _ = wait(self._out, return_when=FIRST_COMPLETED)
            for future in done:
                if future in self._out:
                    self._take(future)

    def _give(self) -> None:
        if self._suspects:
            # Alone, so that a death says whose fault it is.
            if not self._out:
                self._submit([self._suspects.popleft()])
            return
        if self._alone and not self._out and self._left:
            self._alone = False
            self._crew.renew(alone=False)
        # Two chunks for each worker: one runs while the other waits.
        while self._left and not self._alone and len(self._out) < 2 * self._crew.size:
            self._submit([self._left.popleft() for _ in range(self._chunk())])

    def _chunk(self) -> int:
        """Return how many runs to give out at once: few at first, while their time is unknown, and at the end."""
        known = self._ended and self._seconds / self._ended
        wanted = int(_CHUNK_S / max(known, 1e-6)) if known else 1
        fair = -(-len(self._left) // (4 * self._crew.size))
        return max(1, min(wanted, fair, _LARGEST_CHUNK, len(self._left)))

    def _submit(self, runs: list[int]) -> None:
        points = [self._study.points[run] for run in runs]
        chunk = Chunk(self._digest, self._study.loop, self._study.folder, points, self._study.metrics)
        try:
            self._out[self._crew.pool.submit(run_chunk, chunk)] = runs
        except BrokenExecutor:
            # The pool broke since the last look; its other work comes back as suspect.
            self._suspects.extend(runs)
            self._broken()

    def _take(self, future: Future) -> None:
        runs = self._out.pop(future)
        try:
            self._write(future.result())
        except BrokenExecutor:
            self._died(runs)
            self._broken()
        except CancelledError as error:
            raise OutputFileError(
                "the Dask scheduler went away; what is done is kept; the same command goes on."
            ) from error
        except OutputFileError:
            raise
        except Exception as error:  # a worker died under Dask, or what it ran could not come back
            if len(runs) > 1:
                self._suspects.extend(runs)
            else:
                self._write([self._failed_row(runs[0], f"its worker failed: {type(error).__name__}: {error}")])

    def _failed_row(self, run: int, message: str) -> Row:
        return failed_row(self._study.points[run], message, self._study.metrics)

    def _died(self, runs: list[int]) -> None:
        """Try the runs of a worker that died again, each alone; give up on one that was alone already."""
        for run in runs:
            alone = len(runs) == 1 and not self._out
            self._deaths[run] = self._deaths.get(run, 0) + int(alone)
            if self._deaths[run] >= _TRIALS:
                message = f"its worker process died {_TRIALS} times with it alone"
                self._write([self._failed_row(run, message)])
            else:
                self._suspects.append(run)

    def _broken(self) -> None:
        """Take back all that was out and start new workers; what had ended is kept."""
        for future, runs in list(self._out.items()):
            del self._out[future]
            try:
                self._write(future.result(timeout=60.0))
            except Exception:  # went down with the pool
                self._suspects.extend(runs)
        self._alone = True
        self._crew.renew(alone=True)

    def _write(self, rows: list[Row]) -> None:
        self._store.add(rows)
        self._ended += len(rows)
        self._seconds += sum(row["seconds"] or 0.0 for row in rows)
        self._failed += sum(bool(row["error"]) for row in rows)
        total, done = len(self._study.points), len(self._store.done)
        said = f"{done} of {total}" + (f", {self._failed} failed" if self._failed else "")
        self._report(done / total, said)
