"""Kind `guarded`: members while they agree on what was seen, the base where they do not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.core import DataError, FileFormatError, Matrix, SettingsError, silent
from softneck.identification import Model, Network, OutputError, Rls
from softneck.identification.models._arrays import check_arrays
from softneck.identification.uncertainty._guarded import (
    Base,
    Guarded,
    Job,
    _least_missing,
    base_or_reason,
    covering,
    fitted_base,
    left_out,
    left_out_error,
    run_jobs,
)
from softneck.plant import VirtualNeck
from softneck.robot import Robot
from softneck.runtime import bundle, load_runtime
from softneck.runtime._bundle import add_prefix
from softneck.runtime._compile import Runtime, load_tangent
from softneck.signals import Recording, concatenate, signal

from ...data import TS, Truth, neck_recording, recording_from, short_neck

UNSEEN = neck_recording(100, seed=31)
SIGMA = 0.01


def line(gain: float) -> Model:
    """A neck whose answer is `gain` times the synthetic one's."""
    truth = Truth(gain=(0.011 * gain, 0.008 * gain))
    recording = recording_from(short_neck().set_points, truth=truth)
    return OutputError(nf=1, nb=1, delay=0.06).fit(recording)


def guarded(members: list[Model], *, base: Model | None = None, **settings: float) -> Model:
    """A guarded model around members that are there; its base's error is half a degree."""
    known = Base(base or line(0.8), np.full(2, SIGMA), np.array([90.0, 90.0]))
    return Guarded(**settings).around(known, members, short_neck())  # pyright: ignore[reportArgumentType]


def plain(model: Model) -> Runtime:
    """The runtime in plain Python, which needs no compiling."""
    return load_runtime(model.block().runtime, compiled=False)


def free_run(model: Model, U: Matrix) -> tuple[Matrix, Matrix]:
    """Return outputs (time, n_out) and what the blend goes by (time, 10): weight, spread and distance are last."""
    runtime, arrays = plain(model), model.block().arrays
    block = model.block()
    parameters = np.array([port.start or 0.0 for port in block.parameters])
    state, y = np.zeros(runtime.state_size(arrays)), np.zeros(len(block.outputs))
    runtime.initialise(arrays, parameters, state, y)
    outputs, states = [], []
    for u in U:
        runtime.step(arrays, parameters, state, np.concatenate([u, np.full(len(block.inputs) - u.size, np.nan)]), y)
        outputs.append(y.copy())
        states.append(state[:10].copy())
    return np.array(outputs), np.array(states)


WEIGHT, SPREAD, DISTANCE = 6, slice(7, 9), 9


def test_equal_members_within_what_was_seen_are_the_model_to_the_bit() -> None:
    member, U = line(1.0), short_neck().set_points[:100]
    outputs, states = free_run(guarded([member] * 3), U)
    assert (states[:, WEIGHT] == 1.0).all()
    assert (outputs[:, :2] == free_run(member, U)[0][:, :2]).all()


@pytest.mark.slow
def test_any_robot_has_it() -> None:
    robot = Robot.preset("antagonist")
    names, outputs = robot.set_points, robot.outputs.names
    rng = np.random.default_rng(2)
    U = np.repeat(rng.uniform(-2.0, 2.0, (60, len(names))), 10, axis=0)
    Y = np.zeros((600, len(outputs)))
    for k in range(599):
        Y[k + 1] = 0.9 * Y[k] + 0.01 * (U[max(k - 3, 0), 0] - U[max(k - 3, 0), 1])
    channels = dict(zip(names, U.T, strict=True)) | dict(zip(outputs, Y.T, strict=True))
    recording = Recording(TS * np.arange(600), TS, channels, robot=robot)
    member = OutputError(nf=1, nb=1, delay=0.06).fit(recording)
    model = Guarded(of="play").around(
        Base(member, np.full(len(outputs), SIGMA), np.array([90.0])), [member] * 2, recording
    )
    check_arrays("guarded", model.arrays)
    assert (free_run(model, U[:50])[0][:, :-1] == free_run(member, U[:50])[0][:, :-1]).all()


def test_members_far_apart_leave_the_output_to_the_base() -> None:
    base = line(0.8)
    outputs, states = free_run(guarded([line(g) for g in (-3.0, 1.0, 4.0)], base=base), UNSEEN.set_points)
    held = free_run(base, UNSEEN.set_points)[0]
    moving = np.abs(held[:, :2]).max(axis=1) > 0.1
    assert states[moving][-20:, WEIGHT].max() < 0.02
    np.testing.assert_allclose(outputs[-20:, :2], held[-20:, :2], rtol=0, atol=2e-3)
    # Motors are the base's, always.
    assert (outputs[:, 2:5] == held[:, 2:5]).all()


def test_agreement_beyond_what_was_seen_is_no_validity() -> None:
    member, base = line(1.0), line(0.8)
    U = np.tile([6.0, 6.0, 6.0], (120, 1))  # co-contraction, which the recording does not hold
    U[:, 0] -= 3.0
    _, states = free_run(guarded([member] * 3, base=base), U)
    assert states[-1, DISTANCE] > 1.0
    assert (states[:, SPREAD] == 0.0).all()
    assert states[-1, WEIGHT] < 0.1


def test_the_weight_is_that_of_inverse_variances_and_moves_at_a_limited_rate() -> None:
    model = guarded([line(g) for g in (0.9, 1.0, 1.2)], agreement=0.5, unseen=0.3, fade=0.4)
    _, states = free_run(model, UNSEEN.set_points)
    w, s, d = states[:, WEIGHT], states[:, SPREAD], states[:, [DISTANCE]]
    wanted = 1.0 / (1.0 + ((0.5 * s**2 + (model.arrays["slope"] * d) ** 2) / SIGMA**2).max(axis=1))
    step = 0.02 / 0.4
    before = np.concatenate([[1.0], w[:-1]])
    # Rounding only: two programs of one equation.
    np.testing.assert_allclose(w, before + np.clip(wanted - before, -step, step), rtol=0, atol=1e-12)
    assert np.abs(wanted - w).max() > 1e-3  # the limit was felt


def test_nothing_feeds_back() -> None:
    """Members run as they do alone, whatever the weight: their median between them is that of their own runs."""
    members, base = [line(g) for g in (0.9, 1.0, 1.2)], line(0.8)
    outputs, states = free_run(guarded(members, base=base), UNSEEN.set_points)
    alone = np.array([free_run(m, UNSEEN.set_points)[0][:, :2] for m in members])
    w = states[:, [WEIGHT]]
    expected = (1.0 - w) * free_run(base, UNSEEN.set_points)[0][:, :2] + w * np.median(alone, axis=0)
    np.testing.assert_allclose(outputs[:, :2], expected, rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def fitted() -> Model:
    """Three members of `nn` on 500 rows, in this process."""
    small = Network(hidden=(3, 2), starts=1, iterations=4, refine=3)
    parts = left_out(short_neck(), 3)
    members = [replace(small, seed=i).fit(rest, hold_out=part) for i, (rest, part) in enumerate(parts)]
    return guarded(members, base=Rls(delay=0.06).fit(short_neck()))


@pytest.mark.slow
def test_a_file_gives_the_same_bits_again(fitted: Model, tmp_path: Path) -> None:
    fitted.save(tmp_path / "g.npz")
    again = softneck.load(tmp_path / "g.npz")
    assert (again.simulate(UNSEEN) == fitted.simulate(UNSEEN)).all()
    assert (again.predict(UNSEEN) == fitted.predict(UNSEEN)).all()
    assert "3 of nn" in again.summary()


@pytest.mark.slow
def test_compiled_is_plain(fitted: Model) -> None:
    U = np.full((60, 8), np.nan)
    U[:, :3] = UNSEEN.set_points[:60]
    block = fitted.block()
    compiled = block.run(block.initial_state(), U)[1]
    # Rounding of sums in another order.
    np.testing.assert_allclose(compiled, free_run(fitted, UNSEEN.set_points[:60])[0], rtol=0, atol=1e-9)


def test_the_base_is_the_one_that_misses_least_and_a_poor_one_is_named() -> None:
    good = Base(line(1.0), np.full(2, 0.01), np.array([92.0, 90.0]))
    poor = Base(line(0.5), np.full(2, 0.1), np.array([50.0, 60.0]))
    diverged = Base(line(0.5), np.full(2, np.inf), np.full(2, -np.inf))
    assert _least_missing([poor, good, diverged, "play: no"]) is good
    assert not good.remark
    assert "reaches 50 % only" in poor.remark
    with pytest.raises(DataError, match="no base to fall back to: oe diverges; play: no"):
        _least_missing([diverged, "play: no"])


def test_parts_left_out_are_whole_runs_where_there_are_enough_and_blocks_else() -> None:
    one = short_neck()
    parts = left_out(one, 5)
    assert [len(part) for _, part in parts] == [100] * 5
    assert [len(rest.runs()) for rest, _ in parts] == [1, 2, 2, 2, 1]
    assert np.concatenate([part.set_points for _, part in parts]).tolist() == one.set_points.tolist()
    runs = concatenate([one.rows(0, 200), one.rows(200, 300), one.rows(300, 500)])
    assert [len(part) for _, part in left_out(runs, 3)] == [200, 100, 200]


def test_the_error_on_parts_left_out_is_the_noise_of_a_perfect_model() -> None:
    recording = neck_recording(600, seed=3, noise=1e-3)
    error = left_out_error(Rls(max_delay=0.12).fit, left_out(recording, 3))
    # The noise of 1e-3 rad, and no less; what 400 rows leave unknown of a line is as much again.
    assert (error > 0.9e-3).all()
    assert (error < 3e-3).all()


def test_points_that_stand_for_all_reach_all() -> None:
    points = np.random.default_rng(0).standard_normal((500, 3))
    some, reach = covering(points, 50)
    nearest = np.linalg.norm(points[:, None] - some[None], axis=2).min(axis=1)
    assert nearest.max() == pytest.approx(reach, rel=1e-12)
    assert len(some) == 50
    assert covering(points[:3], 50)[1] == 0.0


def test_play_is_guarded_by_name_and_a_robot_may_have_it() -> None:
    model = softneck.identification.identify(
        "guarded", neck_recording(1200), train=1.0, of="play", members=2, base="rls"
    )
    assert (model.kind, model.findings["members"], model.findings["base"]) == ("guarded", "2 of play", "rls")
    assert model.training_rows.size == 1200
    assert model.settings["of"] == "play"
    check_arrays("guarded", model.arrays)


@pytest.mark.slow
def test_processes_change_no_result() -> None:
    jobs = [Job(kind, fitted_base, (kind, short_neck())) for kind in ("rls", "oe")]
    here, there = run_jobs(jobs, 1, silent), run_jobs(jobs, 2, silent)
    for one, other in zip(here, there, strict=True):
        assert (one.error == other.error).all()
        assert all((one.model.arrays[name] == array).all() for name, array in other.model.arrays.items())


@pytest.mark.slow
def test_its_derivative_is_what_differences_say() -> None:
    model = guarded([line(g) for g in (0.9, 1.0, 1.3)])
    arrays, runtime = model.block().arrays, plain(model)
    parameters, x = np.zeros(len(model.block().parameters)), np.zeros(runtime.state_size(arrays))
    y, u = np.zeros(6), np.full(8, np.nan)
    runtime.initialise(arrays, parameters, x, y)
    for row in UNSEEN.set_points[:60]:
        u[:3] = row
        runtime.step(arrays, parameters, x, u, y)
    rng = np.random.default_rng(0)
    X, U, Y = rng.standard_normal((x.size, 4)), np.zeros((8, 4)), np.zeros((6, 4))
    U[:3] = rng.standard_normal((3, 4))
    X[np.abs(x) > 1e3] = 0.0  # generators of random numbers
    moved, rows, out = x.copy(), X.copy(), y.copy()
    load_tangent(model.block().runtime, compiled=False)(arrays, parameters, moved, u, out, rows, U, Y, 4)
    for d in range(4):

        def run(h: float, d: int = d) -> Matrix:
            state, outputs = x + h * X[:, d], y.copy()
            runtime.step(arrays, parameters, state, u + h * U[:, d], outputs)
            return outputs

        # Central differences: h^2 of curvature and eps / h of rounding are about 1e-9.
        np.testing.assert_allclose(Y[:, d], (run(1e-6) - run(-1e-6)) / 2e-6, rtol=1e-5, atol=1e-6)


def test_what_cannot_be_is_refused(fitted: Model) -> None:
    with pytest.raises(SettingsError, match="of"):
        Guarded(of="rls")
    with pytest.raises(SettingsError, match="cannot be a base"):
        Guarded(base="guarded")
    arrays = dict(fitted.arrays)
    with pytest.raises(FileFormatError, match="`sigma` must be positive"):
        check_arrays("guarded", {**arrays, "sigma": np.zeros(2)})
    alone = {name: array for name, array in arrays.items() if not name[0].isdigit() or name[0] == "0"}
    with pytest.raises(FileFormatError, match="cannot have 1 members"):
        check_arrays("guarded", alone)


@pytest.mark.slow
@pytest.mark.nightly
def test_another_robot_that_tendons_bend_can_have_equations_as_base() -> None:
    robot = Robot.preset("antagonist")
    moved = softneck.record(signal("eq22", duration=30.0, robot=robot), VirtualNeck.of(robot), seed=1)
    base = base_or_reason("greybox", moved)
    assert isinstance(base, Base), base
    # 99 % on 40 s; a line has as much there, and 3 points less on four tendons.
    assert base.fit.min() > 95.0


def test_crafted_members_are_refused(models: dict[str, Model]) -> None:
    arrays = dict(models["guarded"].arrays)
    check_arrays("guarded", arrays)
    renamed = {name.replace("1.rls", "1.guarded"): array for name, array in arrays.items()}
    with pytest.raises(FileFormatError, match="belongs to no member in order"):
        check_arrays("guarded", renamed)
    alone = {name: array for name, array in arrays.items() if name[0] not in "123"}
    with pytest.raises(FileFormatError, match="cannot have 1 members"):
        check_arrays("guarded", alone)
    swapped = {**arrays, "0.rls.delay": arrays["0.rls.delay"] + 1e6}
    with pytest.raises(FileFormatError, match="a dead time"):
        check_arrays("guarded", swapped)


def test_names_of_a_member_get_a_prefix_and_nothing_else_changes() -> None:
    text = "SIZE = 2\nCOMPILED = 0\n\ndef size(SIZE):\n    return SIZE\n\ndef f(x):\n    return size(x) + SIZE"
    space: dict = {}
    exec(add_prefix(text, "m0_"), space)
    assert space["m0_f"](3) == 5
    assert space["COMPILED"] == 0
    assert "f" not in space


def test_a_module_without_members_takes_none() -> None:
    plain = "softneck.identification.linear._rls_runtime"
    with pytest.raises(SettingsError, match="does not declare its Arrays"):
        bundle(f"softneck.runtime._members_runtime({plain}:6)")
