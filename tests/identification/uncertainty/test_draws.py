"""Draws of a robot: independent by seed, kept by a file, and wide enough for motions that the fit has not seen."""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from softneck.core import DataError, FileFormatError, SettingsError, load
from softneck.identification import Draws, Family, Model, make_draws
from softneck.identification.models._fitting import sensor_noise
from softneck.identification.structured import _play
from softneck.identification.structured._play import RIDGE_WEIGHTS, Play
from softneck.identification.structured._play_draws import PlayDraws
from softneck.identification.uncertainty import _draws
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

from ...data import neck_recording

QUICK = Play(rate=6.0, order=3, widths=(), degree=1)
GOLDEN = Path(__file__).parents[2] / "golden" / "family.npz"


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [neck_recording(900, seed=seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def made(recordings: list[Recording]) -> Callable[..., Draws]:
    """Make draws of kind `play`, whose fit takes a second where that of the grey box takes a minute."""
    source = PlayDraws.fit(_draws._split(_draws.concatenate(recordings), 1.0)[0], settings=QUICK)

    @cache
    def make(seed: int = 0) -> Draws:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(_draws, "_sources", lambda *_: [source])
            patch.setattr(_draws, "_FACTORS", (1.0, 2.0))
            patch.setattr(_draws, "_CALIBRATION_DRAWS", 10)
            return make_draws(recordings, count=3, seed=seed)

    return make


def bits(models: list[Model]) -> list[bytes]:
    return [model.arrays["weights"].tobytes() for model in models]


def test_draws_follow_their_seed_and_no_two_are_the_same(made: Callable[..., Draws]) -> None:
    one, other = made(), made(seed=1)
    same = made.__wrapped__()  # pyright: ignore[reportFunctionMemberAccess] - computed again, not from the cache
    assert bits(one.for_certificate(1)) == bits(same.for_certificate(1))
    every = [*bits(one.for_search()), *(b for k in range(one.attempts) for b in bits(one.for_certificate(k + 1)))]
    # A search, and each attempt at a certificate, have draws of their own.
    assert len(set(every)) == len(every) == _draws.SEARCH_DRAWS + _draws.ATTEMPTS * 3
    assert not set(every) & set(bits(other.for_certificate(1)))
    with pytest.raises(SettingsError, match="has draws for 5 certificates and this is attempt 7"):
        one.for_certificate(7)


def test_a_factor_is_as_good_as_the_best_within_one_standard_error() -> None:
    best, spread = np.full(4, 0.1), np.array([-0.1, 0.1, -0.1, 0.1])
    error = spread.std(ddof=1) / 2.0  # four segments
    assert _draws.no_worse(best, best)
    assert _draws.no_worse(best + spread + 0.99 * error, best)
    assert not _draws.no_worse(best + spread + 1.01 * error, best)
    assert not _draws.no_worse(best + 1e-9, best)  # worse in every segment alike
    assert not _draws.no_worse(np.full(4, np.inf), best)
    # One segment has no standard error.
    assert _draws.no_worse(best[:1], best[:1])
    assert not _draws.no_worse(best[:1] + 1e-9, best[:1])


def test_every_amplitude_is_covered_and_its_width_is_said(made: Callable[..., Draws]) -> None:
    found = made()
    assert {row["class"] for row in found.coverage} <= {"small", "middle", "large"}
    for row in found.coverage:
        assert row["covered"] >= found.level
        # A band as wide as the motion says nothing; this neck is linear and `play` fits it.
        assert 0.0 < row["width"] < 0.5 * row["motion"]
    said = "\n".join(found.summary(180.0 / np.pi, "deg"))
    assert f"{100 * found.coverage[-1]['covered']:.0f} % within" in said


def test_a_family_file_keeps_its_draws_to_the_bit(made: Callable[..., Draws], tmp_path: Path) -> None:
    plain = load(GOLDEN, role="family")
    assert isinstance(plain, Family)
    assert plain.draws is None  # a file of before
    found = made()
    replace(plain, draws=found).save(tmp_path / "f.npz")
    again = load(tmp_path / "f.npz", role="family").draws
    assert bits(again.for_certificate(2)) == bits(found.for_certificate(2))
    np.testing.assert_array_equal(again.share, found.share)
    np.testing.assert_array_equal(again.noise, found.noise)
    assert (again.keep, again.factor, again.coverage) == (found.keep, found.factor, found.coverage)
    start = recordings_start(found)
    np.testing.assert_array_equal(again.for_search()[0].simulate(start), found.for_search()[0].simulate(start))


def recordings_start(found: Draws) -> np.ndarray:
    return np.ones((50, len(found.model.robot.motors.names)))


@pytest.mark.parametrize("spoil", ["shape", "nan", "last nan", "few", "share", "noise", "share inf", "noise nan"])
def test_draws_that_do_not_fit_their_model_are_refused(made: Callable[..., Draws], spoil: str) -> None:
    found = made()
    header, arrays = found.to_archive()
    if spoil == "shape":
        arrays["drawn_weights"] = arrays["drawn_weights"][:, :, :-1]
    elif spoil == "nan":
        arrays["drawn_weights"] = np.full_like(arrays["drawn_weights"], np.nan)
    elif spoil == "last nan":
        arrays["drawn_weights"] = arrays["drawn_weights"].copy()
        arrays["drawn_weights"][-1, -1, -1] = np.nan
    elif spoil == "few":
        arrays["drawn_weights"] = arrays["drawn_weights"][:4]
    else:
        name, _, value = spoil.partition(" ")
        arrays[name] = arrays[name] * float(value) if value else -arrays[name]
    with pytest.raises(FileFormatError, match="draws"):
        Draws.from_archive(header, arrays)


@pytest.mark.parametrize(("more", "count", "fits"), [(2, 3, False), (3, 3, True), (3, 4, False), (3, 0, False)])
def test_a_file_has_the_draws_of_a_search_and_of_one_certificate(
    made: Callable[..., Draws], more: int, count: int, fits: bool
) -> None:
    header, arrays = made().to_archive()
    arrays["drawn_weights"] = arrays["drawn_weights"][: _draws.SEARCH_DRAWS + more]
    if fits:
        assert Draws.from_archive({**header, "count": count}, arrays).attempts == 1
    else:
        with pytest.raises(FileFormatError, match="fewer than one certificate needs"):
            Draws.from_archive({**header, "count": count}, arrays)


@pytest.mark.parametrize("number", [0, 3, -1])
def test_every_draw_of_a_file_must_be_a_model(
    made: Callable[..., Draws], number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    header, arrays = made().to_archive()
    spoilt = arrays["drawn_weights"][number].tobytes()

    def check(_: str, found: dict[str, np.ndarray]) -> None:
        if found["weights"].tobytes() == spoilt:
            raise FileFormatError("no model")

    monkeypatch.setattr(_draws, "check_arrays", check)
    with pytest.raises(FileFormatError, match="no model"):
        Draws.from_archive(header, arrays)


def segments(y: np.ndarray, noise: float = 0.0) -> _draws._Motions:
    """Return two segments of five rows, the first of small motions."""
    groups, nothing = np.repeat([0, 1], 5), SimpleNamespace()
    return _draws._Motions(nothing, nothing, y, groups, np.array([0.1, 1.0]), np.array([0, 2]), np.full(2, noise))  # pyright: ignore[reportArgumentType]


def test_a_band_is_as_wide_as_its_farthest_draws_and_each_output_of_a_row_is_in_it_or_not() -> None:
    rng = np.random.default_rng(0)
    Y = rng.normal(size=(4, 10, 2))
    low, high = segments(Y[0]).band(Y, np.zeros(2), 0.0)
    np.testing.assert_array_equal(low, Y.min(axis=0))
    np.testing.assert_array_equal(high, Y.max(axis=0))
    wider = segments(Y[0], noise=0.1).band(Y, np.zeros(2), 0.0)
    np.testing.assert_allclose(wider[1] - high, 1.96 * 0.1)
    np.testing.assert_allclose(low - wider[0], 1.96 * 0.1)
    # One output of one row of ten values beyond, above or below, or no number.
    for far in (high[7, 1] + 0.1, low[7, 1] - 0.1, np.nan):
        y = Y[0].copy()
        y[7, 1] = far
        found = segments(y)
        assert [row["covered"] for row in found.coverage(Y, np.zeros(2), 0.0)] == [1.0, 0.9]
        assert [row["class"] for row in found.coverage(Y, np.zeros(2), 0.0)] == ["small", "large"]
        assert not found.covers(Y, np.zeros(2), 0.0)
    assert segments(Y[0]).covers(Y, np.zeros(2), 0.0)
    # A share that is the level is enough: 19 of 20 values.
    many = rng.normal(size=(4, 40, 2))
    y, groups, nothing = many[0].copy(), np.repeat([0, 1], 20), SimpleNamespace()
    y[[3, 4, 23, 24], 0] = 99.0
    told = _draws._Motions(nothing, nothing, y, groups, np.ones(2), np.array([0, 2]), np.zeros(2))  # pyright: ignore[reportArgumentType]
    rows = told.coverage(many, np.zeros(2), 0.0)
    assert [row["covered"] for row in rows] == [_draws.LEVEL, _draws.LEVEL]
    assert told.covers(many, np.zeros(2), 0.0)


@pytest.mark.parametrize("lost", [np.nan, np.inf, -np.inf])
def test_a_draw_that_diverges_makes_its_segment_infinitely_bad_and_no_other(lost: float) -> None:
    rng = np.random.default_rng(0)
    y, Y = rng.normal(size=(10, 2)), rng.normal(size=(4, 10, 2))
    scores = segments(y).scores(Y)
    assert np.isfinite(scores).all()
    for draw in range(4):
        spoilt = Y.copy()
        spoilt[draw, 8, 1] = lost
        assert segments(y).scores(spoilt).tolist() == [scores[0], np.inf]
    # An error that grows in every draw never improves a score; small motions are judged by their own size.
    assert (segments(y).scores(Y + 9.0) > scores).all()
    off = np.broadcast_to(y + 0.1, Y.shape)
    assert segments(y).scores(off) == pytest.approx([1.0, 0.1])
    # One that rests counts as a twentieth of the largest motion, else its noise would decide.
    assert replace(segments(y), motion=np.array([0.0, 1.0])).scores(off) == pytest.approx([2.0, 0.1])


def test_what_a_recording_moves_is_the_largest_from_its_middle() -> None:
    y = np.array([[0.0, 5.0], [0.1, 5.0], [-0.4, 5.0], [0.0, 7.0], [np.nan, 5.0]])
    recording: Any = SimpleNamespace(outputs=y)
    assert _draws._motion(recording) == pytest.approx([0.4, 2.0])


def test_draws_come_from_grey_boxes_or_else_from_play_and_two_poles(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing: Any = SimpleNamespace()
    monkeypatch.setattr(_draws.OutputErrorDraws, "fit", lambda *_, **__: "oe")
    monkeypatch.setattr(_draws.GreyBoxDraws, "fit", lambda *_, body, **__: body)
    monkeypatch.setattr(_draws.PlayDraws, "fit", lambda *_, **__: "play")
    assert _draws._sources(nothing, lambda *_: None) == ["rigid", "all"]

    def refuse(*_: Any, **__: Any) -> Any:
        raise SettingsError("no winches")

    monkeypatch.setattr(_draws.GreyBoxDraws, "fit", refuse)
    assert _draws._sources(nothing, lambda *_: None) == ["oe"]

    def first_order(*_: Any, **__: Any) -> Any:
        raise DataError("one pole")

    monkeypatch.setattr(_draws.OutputErrorDraws, "fit", first_order)
    assert _draws._sources(nothing, lambda *_: None) == ["play"]


@pytest.mark.parametrize(("first", "power"), [(0, 0), (3, 3), (None, 24)])
def test_a_disturbance_is_raised_until_all_is_covered_and_at_most_tenfold(
    made: Callable[..., Draws], first: int | None, power: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[np.ndarray] = []
    whole = made()

    def covers(_: Any, __: Any, share: np.ndarray, ___: float) -> bool:
        asked.append(share)
        return first is not None and len(asked) > first

    monkeypatch.setattr(_draws._Motions, "covers", covers)
    found = made.__wrapped__()  # pyright: ignore[reportFunctionMemberAccess] - with this band
    np.testing.assert_allclose(found.share, 1.1**power * asked[0])
    # It tells itself what it then covers.
    assert [row["class"] for row in found.coverage] == [row["class"] for row in whole.coverage]


@pytest.mark.parametrize("worse_first", [False, True])
def test_draws_come_from_the_model_that_predicts_the_held_out_motions_better(
    recordings: list[Recording], worse_first: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    train = _draws._split(_draws.concatenate(recordings), 1.0)[0]
    # A pole three times slower than the neck's, and a chain of two instead of three.
    good, bad = (PlayDraws.fit(train, settings=each) for each in (QUICK, replace(QUICK, rate=2.0, order=2)))
    monkeypatch.setattr(_draws, "_sources", lambda *_: [bad, good] if worse_first else [good, bad])
    monkeypatch.setattr(_draws, "_FACTORS", (1.0, 2.0))
    monkeypatch.setattr(_draws, "_CALIBRATION_DRAWS", 10)
    found = make_draws(recordings, count=2)
    assert found.model.findings["rate"] == good.model.findings["rate"]
    # The numbers are those of this model too.
    assert {name: values.shape[1:] for name, values in found.arrays.items()} == {
        "weights": good.model.arrays["weights"].shape
    }


def test_a_noisier_sensor_is_no_larger_disturbance(made: Callable[..., Draws], recordings: list[Recording]) -> None:
    found, added = made(), np.array([0.004, 0.008])
    assert found.noise.shape == added.shape
    rng = np.random.default_rng(3)
    _, held, warm_ups = _draws._split(_draws.concatenate(recordings), 1.0)
    noisy = dict(
        zip(held.robot.outputs.names, (held.outputs + added * rng.normal(size=held.outputs.shape)).T, strict=True)
    )
    loud = replace(held, channels={**held.channels, **noisy})
    draws = [{name: values[k] for name, values in found.arrays.items()} for k in range(20)]
    before, after = (_draws._Motions.of(each, found.model, 1.0, warm_ups) for each in (held, loud))
    # 450 rows tell a deviation to 1 / sqrt(900) = 3 %, fourth differences to about three times that.
    np.testing.assert_allclose(after.noise, np.hypot(before.noise, added), rtol=0.15)
    Y = before.simulate(draws)
    share, louder = before.disturbance(Y, 50.0)[0], after.disturbance(Y, 50.0)[0]
    # Left over would be the noise, added to both in squares; what a wrong estimate of 15 % leaves is half of it.
    motion = np.abs(np.diff(held.outputs, axis=0)).mean(axis=0)
    assert (louder < share + 0.5 * added / motion).all()


@pytest.mark.slow
def test_draws_of_a_neck_are_grey_boxes_that_cover_a_new_recording() -> None:
    """Recordings of other signals of the same kind lie within the band, without its disturbance being raised."""
    neck = VirtualNeck(NeckParameters.paper())
    parts = [record(signal("eq22", duration=40.0), neck, seed=1), record(signal("aprbs", duration=40.0), neck, seed=2)]
    found = make_draws(parts, count=10)
    assert found.model.kind == "greybox"
    numbers = np.array([model.arrays["neck"] for model in found.for_certificate()])
    assert (numbers.std(axis=0) > 0.0).sum() >= 12  # all but those that have no meaning here or are held at a bound
    covered: dict[str, list[float]] = {}
    for seed in range(7, 13):  # one alone says little: single classes of these lie between 0.8 and 1
        new = record(signal("aprbs", duration=20.0, seed=seed), neck, seed=seed + 20)
        _, held, warm_ups = _draws._split(new, 1.0)
        motions = _draws._Motions.of(held, found.model, 1.0, warm_ups)
        Y = motions.simulate([{name: values[k] for name, values in found.arrays.items()} for k in range(20)])
        for row in motions.coverage(Y, found.share, found.keep):
            covered.setdefault(row["class"], []).append(row["covered"])
    assert len(covered) == 3
    for shares in covered.values():
        # A tenth less than the level: twenty draws have a narrower range than the forty of the calibration.
        assert np.mean(shares) >= found.level - 0.1


@pytest.mark.parametrize(
    ("second", "held", "rows"),
    [(1.0, 256, 100), (4.17, 256, 128), (6.0, 256, 150), (1.0, 100, 50), (1.0, 101, 100), (2.0, 199, 100)],
)
def test_one_short_run_of_a_slow_robot_has_two_segments_at_least(second: float, held: int, rows: int) -> None:
    """A tank of 208 s time constant at 4 s a sample: 256 rows held out, where a usual segment has 417."""
    motions = _draws._Motions.of(
        neck_recording(25 + held), Model(kind="rls", sample_time=0.02, arrays={}), second, [25]
    )
    found, counts = np.unique(motions.groups[motions.groups >= 0], return_counts=True)
    assert found.tolist() == [*range(-(-held // rows))]
    assert counts[0] == rows


def test_a_run_of_less_than_a_segment_is_to_be_longer() -> None:
    # The shortest segment has 2.5 time constants of 2.4 s: 300 rows of 20 ms.
    with pytest.raises(DataError, match="no two segments with outputs; record longer"):
        _draws._Motions.of(neck_recording(256), Model(kind="rls", sample_time=0.02, arrays={}), 12.0, [0])


# -- what is held out -------------------------------------------------------------------------------------------------


def held_out(lengths: list[int], y: np.ndarray) -> Recording:
    """Return runs that follow each other, with these outputs."""
    whole, starts = neck_recording(len(y)), np.cumsum([0, *lengths])
    whole = whole.with_channels(pitch=y[:, 0], roll=y[:, 1])
    return _draws.concatenate([whole.rows(a, b) for a, b in itertools.pairwise(starts)])


RLS = Model(kind="rls", sample_time=0.02, arrays={})


def test_segments_are_parts_of_a_run_by_the_largest_motion_of_an_output() -> None:
    """Waves of 50 rows in segments of two seconds; runs begin a segment of their own, behind the warm-up."""
    sizes = np.array([0.2, 0.2 * 0.59, 0.2 * 0.61, 0.2 * 0.24, 0.2 * 0.26])
    lengths, warm_ups = [250, 300], [50, 50]
    number = np.concatenate([np.full(50, -1), np.arange(200) // 100, np.full(50, -1), 2 + np.arange(250) // 100])
    wave = np.sin(2.0 * np.pi * np.arange(550) / 50.0)
    y = np.column_stack([0.01 * wave, sizes[number] * wave])
    y[130, 0] = np.nan  # a row that misses one output
    found = _draws._Motions.of(held_out(lengths, y), RLS, 1.0, warm_ups)
    expected = number.copy()
    expected[130] = -1
    np.testing.assert_array_equal(found.groups, expected)
    # Each segment has a whole wave at least, whose 50 rows miss its crest by half a row at most.
    np.testing.assert_allclose(found.motion, sizes, rtol=3e-3)
    assert found.classes.tolist() == [2, 1, 2, 0, 1]
    assert found.noise.shape == (2,)
    with pytest.raises(DataError, match="no two segments"):
        _draws._Motions.of(held_out([550], np.where(np.arange(550)[:, None] < 100, y, np.nan)), RLS, 1.0, [25])


@pytest.mark.parametrize(
    ("lengths", "second", "parts"),
    [([200], 1.0, None), ([400], 1.0, [(300, 100)]), ([180], 1.0, None),
     ([400, 100, 800], 1.0, [(300, 100), (600, 200)]),
     # 150 s of a neck's time are 7,500 rows; of a quicker robot fewer, though no fewer than eight warm-ups.
     ([8000], 1.0, [(5625, 1875)]), ([8000], 0.5, [(2812, 938)]), ([8000], 0.001, [(150, 50)])],
)  # fmt: skip
def test_the_last_quarter_of_each_run_is_held_out(lengths: list[int], second: float, parts: Any) -> None:
    recording = held_out(lengths, 0.01 * np.random.default_rng(0).standard_normal((sum(lengths), 2)))
    if parts is None and lengths != [200]:
        with pytest.raises(DataError, match="no run has 200 rows"):
            _draws._split(recording, second)
        return
    train, held, warm_ups = _draws._split(recording, second)
    each = list(zip(train.runs(), held.runs(), warm_ups, strict=True))
    assert [(len(a), len(b) - warm_up) for a, b, warm_up in each] == (parts or [(150, 50)])
    # 20 s of a neck's time are the warm-up where there are as many, and no fewer rows than a simulation takes to start.
    assert warm_ups == [min(len(a), max(round(1000 * second), 25)) for a, _, _ in each]
    np.testing.assert_array_equal(train.runs()[0].outputs, recording.runs()[0].outputs[: len(train.runs()[0])])
    last, rows = [run for run in recording.runs() if len(run) > 150][-1], len(train.runs()[-1]) - warm_ups[-1]
    np.testing.assert_array_equal(held.runs()[-1].outputs, last.outputs[rows : rows + len(held.runs()[-1])])


def test_what_is_left_over_is_of_the_nearest_draw_of_each_segment() -> None:
    rng = np.random.default_rng(1)
    Y = rng.normal(size=(3, 10, 2))
    y = np.concatenate([Y[2, :5], Y[0, 5:]])
    for draws in (Y, Y[::-1]):
        share, _ = segments(y).disturbance(draws, 50.0)
        np.testing.assert_array_equal(share, 0.0)
    # Each of three segments has its own, and rows of none have none.
    groups = np.array([-1, 0, 0, 0, 1, 1, 1, 2, 2, 2])
    each = np.concatenate([Y[2, :1] + 9.0, Y[2, 1:4], Y[0, 4:7], Y[1, 7:]])
    three = replace(segments(each), groups=groups, motion=np.ones(3), classes=np.zeros(3, dtype=int))
    np.testing.assert_array_equal(three.disturbance(Y, 50.0)[0], 0.0)
    # Draws that do not move leave a share that is a number.
    assert np.isfinite(segments(y).disturbance(np.zeros((2, 10, 2)), 50.0)[0]).all()
    # A nearer draw never leaves more, and one that diverged is near to nothing.
    far, lost = segments(y).disturbance(Y[:1], 50.0)[0], Y.copy()
    lost[2, 3, 1] = np.nan
    assert (far > 0.0).any()
    assert (segments(y).disturbance(lost, 50.0)[0] > 0.0).any()
    spoilt = Y.copy()
    spoilt[1] = np.nan
    np.testing.assert_array_equal(segments(y).disturbance(spoilt, 50.0)[0], 0.0)


@pytest.mark.parametrize(("keep", "share", "noise"), [(0.9, 0.2, 0.0), (0.5, 0.4, 0.0), (0.95, 0.3, 0.02)])
def test_share_and_colour_of_a_disturbance_are_found(keep: float, share: float, noise: float) -> None:
    """`d[k+1] = keep d[k] + share dy[k] n[k]` around a draw, in a sensor's noise that is known."""
    rng, rows = np.random.default_rng(2), 8000
    draw = np.cumsum(0.05 * rng.standard_normal((rows, 2)), axis=0)
    moves, d = np.diff(draw, axis=0, prepend=draw[:1]), np.zeros((rows, 2))
    for k in range(1, rows):
        d[k] = keep * d[k - 1] + share * moves[k] * rng.standard_normal(2)
    y = draw + d + noise * rng.standard_normal((rows, 2))
    groups, nothing = np.repeat([0, 1], rows // 2), SimpleNamespace()
    motions = _draws._Motions(nothing, nothing, y, groups, np.ones(2), np.array([1, 2]), np.full(2, noise))  # pyright: ignore[reportArgumentType]
    found, colour = motions.disturbance(np.array([draw, draw + 9.0]), 50.0)
    # 8,000 rows with a colour of 0.95 are some 200 that are independent: a deviation to 5 %.
    np.testing.assert_allclose(found, share, rtol=0.15)
    assert colour == pytest.approx(keep, abs=0.04)
    # A band of 1.96 deviations of it covers 95 % of normal values.
    rows_of = motions.coverage(np.array([draw]), found, colour)
    assert [row["covered"] for row in rows_of] == pytest.approx([0.95, 0.95], abs=0.02)
    assert [(row["class"], row["segments"]) for row in rows_of] == [("middle", 1), ("large", 1)]


def test_an_error_that_rests_where_nothing_moves_is_covered_by_a_small_share() -> None:
    """A staircase whose every step stops 2 % beside the draw's, with a glitch of one sample: not 240 % of each move."""
    rng, levels, each = np.random.default_rng(4), 80, 60
    held = np.repeat(rng.uniform(-1.0, 1.0, levels), each)
    draw = signal_of(held, 0.12)
    away = signal_of(np.repeat(0.02 * rng.standard_normal(levels), each), 0.12)
    away[each::each] += 0.05 * rng.choice([-1.0, 1.0], levels - 1)
    y = (draw + away + 0.002 * rng.standard_normal(held.size))[:, None]
    groups, nothing = np.repeat([0, 1], held.size // 2), SimpleNamespace()
    motions = _draws._Motions(nothing, nothing, y, groups, np.ones(2), np.array([1, 2]), np.array([0.002]))  # pyright: ignore[reportArgumentType]
    Y = draw[None, :, None]
    share, keep = motions.disturbance(Y, 50.0)
    # A step of 1 has some ten moves of 0.1: errors of 0.02 are sqrt(10) * 0.1 * share.
    assert share[0] < 0.3
    # An offset stays for a level of 60 samples at least: `keep` is no less than exp(-1/60).
    assert keep > 0.98
    # 0.95 are asked for, of offsets that are not normal: more than the share, far from the largest factor, 9.8.
    assert motions.covers(Y, 2.0 * share, keep)


def signal_of(inputs: np.ndarray, rate: float) -> np.ndarray:
    """Return `y[k+1] = y[k] + rate (u[k] - y[k])`."""
    return np.asarray(lfilter([0.0, rate], [1.0, rate - 1.0], inputs))


@pytest.mark.parametrize("left", ["constant", "alternating", "nothing"])
@pytest.mark.parametrize("noise", [0.0, 0.06, 99.0])
def test_a_disturbance_explains_what_is_left_less_noise_and_never_less_than_a_twentieth(
    left: str, noise: float
) -> None:
    draw = np.cumsum(np.ones((10, 2)), axis=0)
    e = {"constant": 0.1, "alternating": 0.1 * (-1.0) ** np.arange(10)[:, None], "nothing": 0.0}[left]
    share, keep = segments(draw + e, noise).disturbance(draw[None], 50.0)
    # It is forgotten within 0.01 to 10 s of a neck's time.
    assert math.exp(-1.0 / (0.01 * 50.0)) - 1e-12 <= keep <= math.exp(-1.0 / (10.0 * 50.0)) + 1e-12
    variance = _draws._filtered(np.diff(draw, axis=0, prepend=draw[:1]), keep).mean(axis=0)
    square = float(np.mean(np.square(e)))
    np.testing.assert_allclose(share**2 * variance, max(square - noise**2, 0.05 * square))


@pytest.mark.parametrize("step", [0.0, 1e-3, 0.01, 0.03])
def test_the_noise_of_a_rounding_sensor_is_no_less_than_its_steps_tell(step: float) -> None:
    """Rounding to steps `q` leaves an error of `q / sqrt(12)`, a uniform distribution's standard deviation."""
    recording, least = neck_recording(450), step / math.sqrt(12.0)
    y = recording.outputs
    rounded = step * np.round(y / step) if step else y
    found = np.array(sensor_noise(recording.with_channels(pitch=rounded[:, 0], roll=rounded[:, 1])))
    plain = np.array(sensor_noise(recording))
    # Two deviations of independent errors add in squares; the estimate of both is right to a factor of 1.5.
    assert (found >= 0.999 * least).all()
    assert (found <= 1.5 * np.hypot(plain, least)).all()


def test_draws_of_one_certificate_are_the_fewest_that_tell_95_percent_with_95_percent_confidence() -> None:
    """None of n draws fails with probability 0.95^n where 5 % of such plants do (Wilks 1941)."""
    assert 0.95**_draws.DRAWS <= 0.05 < 0.95 ** (_draws.DRAWS - 1)
    defaults = inspect.signature(make_draws).parameters
    assert defaults["count"].default == _draws.SEARCH_DRAWS == _draws.DRAWS
    assert defaults["seed"].default == 0  # as every other seed


@pytest.mark.parametrize(
    ("covered", "width", "words"),
    [([1.0, 0.95], [9.0, 0.25], ""), ([0.949, 1.0], [0.1, 0.1], "cover 94.9 % of small motions, not 95 %"),
     ([], [], "no held-out motion"),
     ([1.0, 0.9], [0.1, 0.1], "cover 90 % of large"), ([1.0, 1.0], [0.1, 0.26], "+-26 % of large motions")],
)  # fmt: skip
def test_draws_that_cover_too_little_or_differ_too_much_are_doubted(
    made: Callable[..., Draws], covered: list[float], width: list[float], words: str
) -> None:
    """Small motions may differ by a multiple: friction is there."""
    rows = [{"class": name, "motion": 1.0, "covered": own, "width": wide, "segments": 1}
            for name, own, wide in zip(("small", "large"), covered, width, strict=False)]  # fmt: skip
    found = replace(made(), coverage=rows)
    assert (words in found.doubt) if words else (found.doubt == "")
    assert any("record more" in line for line in found.summary(1.0, "rad")) == bool(words)


def test_the_variance_of_a_disturbance_follows_its_recursion() -> None:
    moves, keep = np.array([[1.0], [0.0], [2.0], [0.0]]), 0.5
    # v[k] = keep^2 v[k-1] + dy[k]^2
    np.testing.assert_allclose(_draws._filtered(moves, keep)[:, 0], [1.0, 0.25, 4.0625, 1.015625])


def test_coverage_tells_the_largest_motion_the_mean_width_and_the_number_of_segments() -> None:
    y = np.zeros((15, 1))
    Y = np.stack([y, y + np.repeat([0.2, 0.4, 1.0], 5)[:, None]])
    groups, nothing = np.repeat([0, 1, 2], 5), SimpleNamespace()
    motions = _draws._Motions(nothing, nothing, y, groups, np.array([0.3, 0.5, 1.0]), np.array([1, 1, 2]), np.zeros(1))  # pyright: ignore[reportArgumentType]
    small, large = motions.coverage(Y, np.zeros(1), 0.0)
    assert small == {"class": "middle", "motion": 0.5, "covered": 1.0, "width": pytest.approx(0.15), "segments": 2}
    assert (large["width"], large["segments"], large["motion"]) == (pytest.approx(0.5), 1, 1.0)
    # Steps of few levels rest in every segment of a class, whose width is no part of a motion.
    still = replace(motions, motion=np.array([0.0, 0.0, 1.0]))
    assert [row["class"] for row in still.coverage(Y, np.zeros(1), 0.0)] == ["large"]


@pytest.mark.parametrize(
    ("asked", "said"),
    [({"count": 1}, "count"), ({"count": 10_001}, "count"), ({"seed": -1}, "seed"), ({"seed": 2**31 - 1}, "seed")],
)
def test_numbers_of_draws_and_seeds_have_their_ends(
    asked: dict[str, int], said: str, recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SettingsError, match=said):
        make_draws(recordings, **asked)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(_draws, "_sources", lambda *_: (_ for _ in ()).throw(KeyError("fitted")))
    for count, seed in ((2, 0), (10_000, 2**31 - 2)):
        with pytest.raises(KeyError, match="fitted"):
            make_draws(recordings[0], count=count, seed=seed)


def test_a_search_sees_its_own_draws_and_no_more(made: Callable[..., Draws]) -> None:
    found = made()
    every = bits(found.for_search())
    assert len(every) == 59
    assert bits(found.for_search(3)) == every[:3]
    assert bits(found.for_search(99)) == every
    assert [len(found.for_certificate(k)) for k in (1, 5)] == [3, 3]
    for attempt in (0, 6):
        with pytest.raises(SettingsError):
            found.for_certificate(attempt)
    first, *rows = found.summary(1.0, "rad")
    assert first.startswith(f"draws: 3 of kind play for each of 5 certificates, seed 0; deviations of the fit times "
                            f"{found.factor:g}, and a disturbance of {100.0 * found.share.max():.2g} %")  # fmt: skip
    assert len(rows) == len(found.coverage)
    row = found.coverage[-1]
    assert f"{100.0 * row['width'] / row['motion']:.0f} % of the motion" in rows[-1]
    assert found.band_of({"width": 2e-5, "motion": 0.01}) == "0.2 %"


def test_the_making_of_draws_says_how_far_it_is_and_refuses_what_has_no_simulation(
    made: Callable[..., Draws], recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = PlayDraws.fit(_draws._split(_draws.concatenate(recordings), 1.0)[0], settings=QUICK)
    said: list[float] = []

    def sources(_: Any, progress: Any) -> list[Any]:
        for share in (0.0, 1.0):
            progress(share, "fit")
        return [source]

    monkeypatch.setattr(_draws, "_sources", sources)
    monkeypatch.setattr(_draws, "_FACTORS", (1.0, 2.0))
    monkeypatch.setattr(_draws, "_CALIBRATION_DRAWS", 4)
    make_draws(recordings, count=2, progress=lambda share, _: said.append(share))
    assert said == pytest.approx([0.0, 0.4, 0.4, 0.575, *(0.75 + 0.25 * np.arange(6) / 6)])
    monkeypatch.setattr(_draws._Motions, "simulate", lambda own, _: np.full((4, *own.outputs.shape), np.nan))
    with pytest.raises(DataError, match="no draw has a finite simulation"):
        make_draws(recordings, count=2)


@pytest.mark.parametrize(
    ("scores", "chosen", "factor"),
    [
        # By the mean over all segments, and of its factors the smallest that is no worse by more than its error.
        ([[0.1, 0.9], [0.1, 0.9], [0.4, 0.4], [0.4, 0.4]], 1, 1.0),
        ([[0.5, 0.5], [0.3, 0.3], [0.4, 0.4], [0.4, 0.4]], 0, 2.0),
        ([[0.5, 0.5], [0.5, 0.5], [0.3, 0.7], [0.49, 0.49]], 1, 1.0),
        ([[np.inf, 0.1], [0.6, 0.6], [np.inf, np.inf], [0.7, 0.7]], 0, 2.0),
    ],
)
def test_the_best_of_all_models_and_factors_is_the_one_of_the_least_mean_score(
    scores: list[list[float]], chosen: int, factor: float, recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    train, told = _draws._split(_draws.concatenate(recordings), 1.0)[0], iter(scores)
    most = replace(QUICK, ridge=RIDGE_WEIGHTS[-1])  # none is larger
    sources = [PlayDraws.fit(train, settings=each) for each in (most, replace(most, rate=5.0))]
    monkeypatch.setattr(_draws, "_sources", lambda *_: sources)
    monkeypatch.setattr(_draws, "_FACTORS", (1.0, 2.0))
    monkeypatch.setattr(_draws, "_CALIBRATION_DRAWS", 4)
    monkeypatch.setattr(_draws._Motions, "scores", lambda *_: np.array(next(told)))
    found = make_draws(recordings, count=2)
    assert (found.model, found.factor) == (sources[chosen].model, factor)


@pytest.mark.parametrize(
    ("scores", "ridge", "factor"),
    [
        ([[0.4, 0.4], [0.5, 0.5], [0.3, 0.6]], 1e-2, 1.0),
        ([[0.4, 0.4], [0.5, 0.5], [0.9, 0.9], [0.3, 0.6]], 1e-2, 2.0),
        ([[0.4, 0.4], [0.5, 0.5], [0.9, 0.9], [0.9, 0.9], [0.4, 0.4]], 1e-4, 1.0),
        ([[0.5, 0.5], [0.4, 0.4], [0.9, 0.9], [0.9, 0.9], [0.9, 0.9], [np.inf, 0.1]], 1e-6, 2.0),
    ],
)
def test_of_a_play_model_the_largest_ridge_that_is_no_worse_is_taken(
    scores: list[list[float]], ridge: float, factor: float, recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    train, told = _draws._split(_draws.concatenate(recordings), 1.0)[0], iter(scores)
    source = PlayDraws.fit(train, settings=replace(QUICK, ridge=1e-6))
    monkeypatch.setattr(_draws, "_sources", lambda *_: [source])
    monkeypatch.setattr(_draws, "_FACTORS", (1.0, 2.0))
    monkeypatch.setattr(_draws, "_CALIBRATION_DRAWS", 4)
    monkeypatch.setattr(_draws._Motions, "scores", lambda *_: np.array(next(told)))
    found = make_draws(recordings, count=2)
    assert (found.model.findings["ridge"], found.factor) == (ridge, factor)
    assert next(told, None) is None, "no draw is simulated twice"


def test_a_smoother_play_model_is_that_of_its_ridge(
    recordings: list[Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_play, "_VALVE_MISFIT", 0.0)  # each ridge would find other valves
    # Without logged motors a model is learned from the same rows as its draws.
    train = [
        replace(part, channels={n: v for n, v in part.channels.items() if "position" not in n}) for part in recordings
    ]
    source = PlayDraws.fit(_draws.concatenate(train), settings=replace(QUICK, ridge=1e-6))
    each_once = np.ones(int(source.groups.max()) + 1)
    for smoother, ridge in zip(source.smoother(), (1e-2, 1e-4, 1e-6), strict=True):
        model = PlayDraws.fit(_draws.concatenate(train), settings=replace(QUICK, ridge=ridge)).model
        # Sums of a thousand rows, taken in another order.
        np.testing.assert_allclose(smoother.model.arrays["weights"], model.arrays["weights"], rtol=1e-6, atol=1e-9)
        assert smoother.model.findings["ridge"] == smoother.weight == ridge
        np.testing.assert_allclose(
            smoother.arrays(each_once, 3.0)["weights"], smoother.model.arrays["weights"], rtol=1e-9
        )


def test_a_disturbance_goes_by_the_motion_of_the_middle_draw_and_the_first_certificate_is_the_default(
    made: Callable[..., Draws],
) -> None:
    middle = np.zeros((10, 2))
    middle[5:] = 1.0  # it moves once
    Y, share = np.stack([middle + 9.0 * np.arange(10)[:, None], middle, middle - 9.0]), np.array([0.2, 0.4])
    low, high = segments(middle).band(Y, share, 0.5)
    expected = np.where(np.arange(10)[:, None] < 5, 0.0, 1.96 * share * 0.5 ** (np.arange(10)[:, None] - 5.0))
    np.testing.assert_allclose(high - Y.max(axis=0), expected)
    np.testing.assert_allclose(Y.min(axis=0) - low, expected)
    assert bits(made().for_certificate()) == bits(made().for_certificate(1))


def test_draws_are_scored_with_the_disturbance_and_the_noise_that_loops_add() -> None:
    """Noise of the sensor alone widens no deviations: narrow draws and the noise are the sharpest that explain it."""
    rng = np.random.default_rng(7)
    groups, wave = np.repeat(np.arange(8), 250), np.sin(0.02 * np.arange(2000))[:, None]
    nothing: Any = SimpleNamespace()
    motions = _draws._Motions(
        nothing, nothing, wave + 0.1 * rng.standard_normal((2000, 1)), groups, np.ones(8), np.zeros(8, dtype=int),
        np.array([0.1]),
    )  # fmt: skip
    narrow, wide = (wave + size * rng.standard_normal((40, 1, 1)) for size in (0.001, 0.1))
    told = [motions.disturbed(Y, np.zeros(1), 0.5, np.random.default_rng(0)) for Y in (narrow, wide)]
    assert (motions.scores(told[0]) < motions.scores(told[1])).all()
    assert motions.scores(narrow).mean() > motions.scores(wide).mean()  # as it was without
    # Their variance is that of the band: of the moves that the draw has made so far, and of the noise.
    share, many = np.array([0.3]), np.repeat(wave[None, :200], 4000, axis=0)
    away = (motions.disturbed(many, share, 0.9, np.random.default_rng(1)) - many).var(axis=0)
    expected = share**2 * _draws._filtered(np.diff(wave[:200], axis=0, prepend=wave[:1]), 0.9) + 0.1**2
    # A variance of 4,000 numbers deviates by 2.2 %; the largest of 200 by four of its deviations at most.
    np.testing.assert_allclose(away, expected, rtol=0.09)
