"""A loop is compared with what it made of its references before: the model, when it rests, and what is kept of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError
from softneck.drives import default_drives
from softneck.drives.logs._cycle import LoggedPilot
from softneck.drives.logs._log_file import read_run_log
from softneck.drives.logs._replay import logged_motion, replay
from softneck.drives.logs._run_log import RunLogger, run_facts
from softneck.drives.master import Phase
from softneck.drives.supervision._calibrate import _tracking, calibrate, require_loops
from softneck.drives.supervision._detection import Budget
from softneck.drives.supervision._motor_models import Motion
from softneck.drives.supervision._tracking import (
    LoopRun,
    TrackingCharts,
    fit_tracking,
    tracking_scores,
)

from ..bench import TS, Bench, T
from ..plausible import Tracker, baseline, experiments, looped, watched


def run_of(seed: int, *, seconds: float = 40.0, off: float = 0.0, noise: float = 1e-3) -> LoopRun:
    """Return a loop of two outputs that follow jumps with one lag of 0.32 s; `off` is added in its second half."""
    rng, rows = np.random.default_rng(seed), round(seconds / TS)
    reference = np.repeat(rng.uniform(-0.2, 0.2, (rows // 100 + 1, 2)), 100, axis=0)[:rows]
    y = np.zeros((rows, 2))
    for k in range(1, rows):
        y[k] = y[k - 1] + (1.0 - np.exp(-TS / 0.32)) * (reference[k] - y[k - 1])
    y += noise * rng.standard_normal(y.shape)
    y[rows // 2 :] += off
    none = np.zeros((rows, 3))
    motion = Motion(setpoints=none, positions=none, tensions=none, values=y, rates=y, due=np.ones(rows, dtype=bool),
                    references=reference)  # fmt: skip
    return LoopRun(motion, np.ones(rows, dtype=bool), TS)


def test_the_reference_model_finds_the_lag_behind_a_loop() -> None:
    model = fit_tracking([run_of(1), run_of(2)])
    # 0.32 s is the fourth of its lags. Noise of 1e-3 on jumps of 0.1 over 3,700 samples: some 1e-3 each, 20 times that.
    np.testing.assert_allclose(model.weights, [0, 0, 0, 1, 0, 0, 0], atol=0.02)
    _, residual = tracking_scores(model, run_of(3))
    # What is left is the noise: its standard deviation over 1,850 samples is known to 2 %, and the weights add little.
    np.testing.assert_allclose(residual.std(axis=0), 1e-3, rtol=0.1)


@pytest.mark.parametrize(("off", "found"), [(0.0, False), (0.06, True), (-0.06, True)])
def test_a_loop_astray_raises_the_charts_of_its_side_alone(off: float, found: bool) -> None:
    scores, _ = tracking_scores(fit_tracking([run_of(1), run_of(2)]), run_of(3, off=off))
    sums = np.maximum.accumulate(scores[len(scores) // 2 :].cumsum(axis=0), axis=0)[-1]
    upper, lower = sums[::2], sums[1::2]
    assert bool(np.max(upper if off >= 0.0 else lower) > 50.0) is found
    assert np.max(lower if off >= 0.0 else upper) < 5.0


def test_what_the_loop_is_off_by_itself_counts_for_no_fault() -> None:
    """0.02 rad off where 0.026 are astray: taken for it, unless undisturbed runs were off by as much."""
    model = fit_tracking([run_of(1), run_of(2)])
    run = run_of(3, off=0.02)
    for bias, astray in ((0.0, True), (0.02, False)):
        scores, _ = tracking_scores(model._replace(bias=(bias, bias)), run)
        assert bool(scores[len(scores) // 2 :].sum(axis=0).max() > 50.0) is astray
    # Each was off in its second half: so is what the other one did not know of.
    runs = [run_of(seed, off=0.02) for seed in (1, 2, 4)]
    known = _tracking(runs, Budget(charts=4, step=TS), np.random.default_rng(0))
    assert len(known.bias) == 2
    # Half of it goes into the weights, which have no constant, or not: at least half remains.
    assert all(0.01 < bias < 0.03 for bias in known.bias)
    assert all(np.isfinite(known.thresholds))


def test_without_a_reference_and_where_tendons_hung_nothing_is_compared() -> None:
    model = fit_tracking([run_of(1), run_of(2)])._replace(thresholds=(10.0,) * 4)
    charts = TrackingCharts(model, 2, TS)
    for _ in range(150 + 50):
        assert charts.step((), (0.3, 0.3), valid=True) == -1
        assert not charts.scores.any()
    # As long again after it came, and after tendons hung.
    assert [charts.step((0.0, 0.0), (0.3, 0.3), valid=True) for _ in range(150)] == [-1] * 150
    assert max(charts.step((0.0, 0.0), (0.3, 0.3), valid=True) for _ in range(50)) >= 0
    charts.step((0.0, 0.0), (0.3, 0.3), valid=False)
    assert [charts.step((0.0, 0.0), (0.3, 0.3), valid=True) for _ in range(150 - 1)] == [-1] * (150 - 1)
    assert charts.step((0.0, 0.0), None, valid=True) == -1
    assert max(charts.step((0.0, 0.0), (0.3, 0.3), valid=True) for _ in range(50)) >= 0


def test_a_run_out_is_not_compared_with_the_reference_before() -> None:
    """The ramp to rest follows no reference; the loop's last one must not judge it."""
    bench = watched(1, "ramp", judged=baseline())
    bench.pass_time(5.0)
    bench.master.finish()
    bench.finish(10.0)
    assert bench.phase is Phase.DONE, bench.master.supervisor.fault


def test_logs_keep_references_and_give_them_back(tmp_path: Path) -> None:
    path, bench = tmp_path / "run.mcap", Bench()
    with RunLogger(path, wait=True) as log:
        log.describe(run_facts(bench.master.settings, {}, simulated=True))
        bench.pilot.act = Tracker(1, "ramp")
        pilot = LoggedPilot(bench.pilot)
        bench.master.pilot = pilot
        bench.run.watches = (log.watch(pilot),)
        bench.link.tap = log.frame
        bench.start()
        bench.pass_time(4.0)
        bench.master.finish()
        bench.finish(10.0)
    logged = read_run_log(path)
    replay(logged).require()
    motion = logged_motion(logged, bench.master.settings)
    assert motion.references is not None
    seen = motion.references[np.isfinite(motion.references).all(axis=1)]
    assert seen[-1] == pytest.approx(bench.pilot.reference)
    # A log from before, without them, replays as it did, also with the pilot computed again.
    cycles = tuple(
        cycle._replace(answers=tuple(answer for answer in cycle.answers if answer[0] != "reference"))
        for cycle in logged.cycles
    )
    replay(replace(logged, cycles=cycles)).require()
    again = Bench()
    again.pilot.act = Tracker(1, "ramp")
    replay(replace(logged, cycles=cycles), again.pilot).require()
    assert logged_motion(replace(logged, cycles=cycles), bench.master.settings).references is None


@pytest.mark.slow
def test_a_few_minutes_of_a_loop_are_refused() -> None:
    """From four of them the tracking cried wolf once in eight hours: they showed a third of its slow errors."""
    motions = [*experiments(None, 0.0)[:2], looped(15, "step", 0.0, 40.0), looped(16, "ramp", 0.0, 40.0)]
    with pytest.raises(DataError, match=r"^7\d s of a loop's motion .* at least 600 s, or leave its runs out"):
        calibrate(motions, cycle=T, sample_cycles=2, slack=default_drives().limits.slack)


def test_ten_minutes_of_a_loop_are_enough() -> None:
    require_loops(600.0)
    with pytest.raises(DataError, match=r"^599 s of a loop's motion"):
        require_loops(599.0)


def test_loops_alone_are_not_enough_to_compare_with() -> None:
    """Steps overload motors: what they do is for the tracking alone."""
    with pytest.raises(DataError, match="beside those of a loop are too few"):
        calibrate([looped(1, "ramp", 0.0, 5.0)], cycle=T, sample_cycles=2, slack=default_drives().limits.slack)
