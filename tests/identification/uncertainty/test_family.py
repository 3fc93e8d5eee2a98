"""The family: local models of a known neck, a box and a weight that cover them, one file that a design reads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softneck.core import DataError, FileFormatError, SettingsError, load
from softneck.design import PiSettings
from softneck.estimation import KalmanSettings
from softneck.identification import Family, FamilySettings
from softneck.identification.uncertainty import _family_fit
from softneck.identification.uncertainty._family import one_pole, relative_errors
from softneck.identification.uncertainty._family_fit import envelope_weight
from softneck.identification.uncertainty._local_models import Local, Window
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

from ...data import TRUTH, TS, Truth, neck_recording, recording_from
from ...oracles.bake_off import exact
from ...verification.necks import PAPER
from ...verification.necks import family as small_family

# Gains of three payloads on one pole and dead time each.
PAYLOADS = [Truth(gain=(0.011 * k, 0.008 * k)) for k in (0.8, 1.0, 1.25)]


def payload(truth: Truth, seed: int) -> Recording:
    P = signal("aprbs", duration=32.0, seed=seed).set_points.copy()
    P[:15] = 0.0
    return recording_from(P, truth=truth, noise=5e-4, seed=seed)


@pytest.fixture(scope="module")
def recordings() -> list[Recording]:
    return [payload(truth, seed) for seed, truth in enumerate(PAYLOADS)]


@pytest.fixture(scope="module")
def family(recordings: list[Recording]) -> Family:
    return FamilySettings(directions=1).fit(recordings)


@pytest.mark.slow
@given(
    gains=st.tuples(st.floats(0.3, 0.95), st.floats(1.05, 3.0)),
    poles=st.tuples(st.floats(0.3, 0.95), st.floats(1.05, 3.0)),
    late=st.floats(0.0, 0.04),
    order=st.sampled_from([1, 2, 3]),
)
def test_a_weight_covers_its_envelope_and_is_stable_and_of_minimum_phase(
    gains: tuple[float, float], poles: tuple[float, float], late: float, order: int
) -> None:
    w = np.geomspace(0.05, 150.0, 100)
    G0 = 0.483 / (1j * w + 5.293)
    error = [
        np.abs(0.483 * k * np.exp(-1j * w * L) / (1j * w + 5.293 * p) / G0 - 1.0)
        for k in gains for p in poles for L in (0.0, late)
    ]  # fmt: skip
    envelope = np.max(error, axis=0)
    above, below = envelope_weight(w, envelope, order)
    W = np.abs(np.polyval(above, 1j * w) / np.polyval(below, 1j * w))
    assert (envelope * (1 - 1e-6) <= W).all()  # the linear program's own tolerance
    assert np.roots(below).real.max(initial=-1.0) < 0
    assert np.roots(above).real.max(initial=-1.0) < 0
    assert max(above.size, below.size) <= order + 1


@pytest.mark.slow
def test_order_two_is_close_to_an_envelope_of_the_facts() -> None:
    """Facts: +-40 % gain and pole, +-20 ms: order 2 within 4 %."""
    w = np.geomspace(0.05, 150.0, 100)
    G0 = 0.483 / (1j * w + 5.293)
    members = [
        0.483 * k * np.exp(-1j * w * L) / (1j * w + 5.293 * p)
        for k in (0.6, 1, 1.4) for p in (0.6, 1, 1.4) for L in (-0.02, 0, 0.02)
    ]  # fmt: skip
    envelope = np.max([np.abs(G / G0 - 1.0) for G in members], axis=0)
    closeness = []
    for order in (1, 2, 3):
        above, below = envelope_weight(w, envelope, order)
        closeness.append(np.max(np.abs(np.polyval(above, 1j * w) / np.polyval(below, 1j * w)) / envelope))
    assert closeness[1] < 1.04
    assert closeness[0] > closeness[1] > closeness[2]


@pytest.mark.slow
@pytest.mark.parametrize("axis", [0, 1])
def test_local_models_find_gain_pole_and_delay_of_every_payload(family: Family, axis: int) -> None:
    name = ("pitch", "roll")[axis]
    found = family.axes[name]
    for number, truth in enumerate(PAYLOADS):
        row = (found.where[:, 0] == 2) & (found.where[:, 1] == number)
        assert row.sum() == 1
        gain, pole, delay = found.samples[row][0]
        wanted = (truth.gain[axis] / (1 - truth.pole[axis]), -np.log(truth.pole[axis]) / TS, truth.delay[axis] * TS)
        # 5e-4 rad of noise on motions of 0.1 rad over 1,600 rows: parts of a percent, 0.2 ms.
        assert (gain, pole) == (pytest.approx(wanted[0], rel=0.01), pytest.approx(wanted[1], rel=0.02))
        assert delay == pytest.approx(wanted[2], abs=1e-3)
    single = found.where[:, 0] == 0
    assert single.sum() >= 15
    spread = np.abs(found.samples[single, 0] / np.median(found.samples[single, 0]) - 1.0)
    assert np.quantile(spread, 0.9) < 0.4  # the payloads themselves span -20 to +25 %


@pytest.mark.slow
def test_every_sample_is_in_the_box_and_under_the_weight(family: Family) -> None:
    for name, axis in family.axes.items():
        used = axis.samples[axis.used > 0.5]
        assert (used >= axis.box[0]).all()
        assert (used <= axis.box[1]).all()
        np.testing.assert_allclose(axis.nominal[:2], axis.box.mean(axis=0)[:2])
        assert 0.5 < family.covered(name) <= 1.0 + 1e-9  # rounding
        # The same by python-control: relative errors of the transfer functions that a design gets.
        z, W = np.exp(1j * family.frequency * TS), np.abs(cast(Any, family.weight(name))(1j * family.frequency))
        G0 = cast(Any, family.tf(name))(z)
        for G in family.samples(name):
            assert (np.abs(cast(Any, G)(z) / G0 - 1.0) <= W * (1 + 1e-9)).all()


@pytest.mark.slow
def test_a_file_keeps_every_bit_and_says_what_it_is(family: Family, tmp_path: Path) -> None:
    family.save(tmp_path / "f.npz")
    again = load(tmp_path / "f.npz", role="family")
    assert again.summary() == family.summary()
    for name, axis in family.axes.items():
        for key in ("samples", "std", "where", "used", "nominal", "box", "weight", "envelope"):
            assert getattr(again.axes[name], key).tobytes() == getattr(axis, key).tobytes()
    with pytest.raises(FileFormatError, match=r"is a family \(family\), not a model"):
        load(tmp_path / "f.npz", role="model")
    broken = replace(family.axes["pitch"], box=family.axes["pitch"].box[:1])
    replace(family, axes={**family.axes, "pitch": broken}).save(tmp_path / "b.npz")
    with pytest.raises(FileFormatError, match="`pitch_box` has shape"):
        load(tmp_path / "b.npz")


@pytest.mark.slow
def test_a_design_reads_it(family: Family) -> None:
    controller = PiSettings().design(exact(family))
    assert controller.design["pitch"]["dead_time_s"] == pytest.approx(0.06)
    observer = KalmanSettings().design(family)
    assert observer.delays == (3, 4)
    G: Any = family.tf("pitch", continuous=True, pade=4)
    gain, pole, delay = family.axes["pitch"].nominal
    w = np.array([0.5, 4.0])
    np.testing.assert_allclose(
        G(1j * w), gain * pole / (1j * w + pole) * np.exp(-1j * w * delay), rtol=1e-5
    )  # Pade of order 4


@pytest.mark.nightly
@pytest.mark.slow
def test_gains_across_the_axes_are_told() -> None:
    P = signal("mixed", duration=60.0, seed=3).set_points.copy()
    P[:15] = 0.0
    clean = recording_from(P)
    U = P @ np.array([[1, -0.5, -0.5], [0, np.sqrt(0.75), -np.sqrt(0.75)], [1 / 3] * 3]).T
    pole, gain = TRUTH.pole[0], 0.02 * (1 - TRUTH.pole[0])
    extra = np.zeros(len(P))
    for k in range(len(P) - 1):  # delta_i acts on pitch by 0.02 rad/rad, as late and as slow as theta_i
        extra[k + 1] = pole * extra[k] + gain * U[max(k - TRUTH.delay[0], 0), 2]
    r = clean.with_channels(
        pitch=clean.channels["pitch"] + extra, compression=0.001 * np.asarray(_lag(U[:, 2], 0.9, 2))
    )
    family = FamilySettings(directions=1).fit(r)
    assert family.cross[0, 2] == pytest.approx(0.02, abs=1e-3)  # the nominal is the middle of a box, not the truth
    assert abs(family.cross[1, 0]) < 1e-3
    K, p, L = family.compression
    assert (K, p, L) == (
        pytest.approx(1e-3, rel=1e-3), pytest.approx(-np.log(0.9) / TS, rel=1e-3), pytest.approx(0.04, abs=1e-4),
    )  # fmt: skip
    assert "G_delta" in family.summary()


def _lag(u: np.ndarray, pole: float, delay: int) -> np.ndarray:
    y = np.zeros(u.size)
    for k in range(u.size - 1):
        y[k + 1] = pole * y[k] + (1 - pole) * u[max(k - delay, 0)]
    return y


@pytest.mark.nightly
@pytest.mark.slow
def test_the_virtual_neck_and_the_real_one(shared_data: Path) -> None:
    from softneck.signals import import_log, read_layout

    from ...data import LAYOUTS

    neck = VirtualNeck(NeckParameters.paper())
    virtual = FamilySettings(directions=1).fit([record(signal("aprbs", duration=40.0, seed=1), neck, seed=0)])
    layout = read_layout(LAYOUTS / "neck_closedloop.toml")
    real = [
        import_log(shared_data / "neck_closedloop" / f"frontier_test_{m}gr.csv", layout).recording
        for m in ("000", "400", "1000")
    ]
    family = FamilySettings(source="positions", window=5.0).fit(real)
    for each in (virtual, family):
        for name in ("pitch", "roll"):
            assert each.covered(name) <= 1.0 + 1e-9
    # The paper's neck has 5.2 deg/rad; the payload drags the gain up by half (its moment tilts the neck further).
    assert np.degrees(virtual.axes["pitch"].nominal[0]) == pytest.approx(5.2, rel=0.15)
    pitch = family.axes["pitch"]
    gains = [np.degrees(pitch.samples[(pitch.where[:, 0] == 2) & (pitch.where[:, 1] == m), 0][0]) for m in range(3)]
    assert gains[0] < gains[1] < gains[2]


@pytest.mark.slow
def test_what_cannot_be_made_a_family_is_named(recordings: list[Recording]) -> None:
    still = neck_recording(400)
    P = still.set_points
    P[:, 1] = P[:, 2] = 0.0
    with pytest.raises(DataError, match=r"roll: only 0 local models say enough \(\d+ windows do not\)"):
        FamilySettings().fit(recording_from(P, noise=1e-3))
    other = Recording(still.time * 1.05, 0.021, still.channels)
    with pytest.raises(DataError, match=r"different sample times cannot be used together: 0\.02 s and 0\.021 s"):
        FamilySettings().fit([recordings[0], other])
    with pytest.raises(SettingsError, match=r"`window` must be between 1 and 1000 \[s\]"):
        FamilySettings(window=0.1).fit(recordings)
    for key, value in (("window", -1.0), ("directions", 0)):
        with pytest.raises(SettingsError, match=f"`{key}` must be"):
            FamilySettings(**cast(Any, {key: value}))


# -- what is covered, without a fit -----------------------------------------------------------------------------------

FREQUENCY = np.geomspace(0.05, np.pi / TS, 15)


def local(scope: str = "point", gain: float = 1.0, pole: float = 1.0, late: float = 1.0) -> Local:
    return Local(scope=scope, recording=0, time=1.0, inclination=0.1, direction=0.0, std=np.full(4, 0.01), fit=90.0,
                 model=one_pole(PAPER * [gain, pole, late]))  # fmt: skip


def axis_of(*found: Local) -> Any:
    return FamilySettings()._axis("pitch", list(found), FREQUENCY, TS, 3)


def test_a_plant_more_never_makes_a_family_smaller_and_a_window_changes_nothing() -> None:
    """Box, envelope and weight are the worst of operating points and recordings, in whatever order they stand."""
    middle, far, within = local(), local(gain=1.3, pole=0.8), local("recording", gain=1.1, pole=0.95)
    base = axis_of(middle, far)
    for more in ((within, far, middle), (far, local("window", gain=9.0), middle, within)):
        found = axis_of(*more)
        used = found.samples[found.used > 0.5]
        np.testing.assert_array_equal(found.box, [used.min(axis=0), used.max(axis=0)])
        np.testing.assert_allclose(found.box, base.box)
        np.testing.assert_allclose(found.envelope, base.envelope, rtol=1e-9)
        assert len(used) == 3
    wider = axis_of(middle, far, local(gain=0.5))
    assert (wider.box[0] <= base.box[0] + 1e-12).all()
    assert (wider.box[1] >= base.box[1] - 1e-12).all()
    assert wider.envelope.max() > base.envelope.max()
    for item in (base, wider):
        fine = np.geomspace(FREQUENCY[0], FREQUENCY[-1], 5 * FREQUENCY.size)
        W = np.abs(np.polyval(item.weight[0], 1j * fine) / np.polyval(item.weight[1], 1j * fine))
        errors = relative_errors(item.samples[item.used > 0.5], item.nominal, fine, TS)
        assert (errors <= W * (1.0 + 1e-9)).all()  # on a grid finer than the fit's
        np.testing.assert_allclose(item.envelope, relative_errors(
            item.samples[item.used > 0.5], item.nominal, FREQUENCY, TS).max(axis=0))  # fmt: skip
    family = replace(small_family(), axes={"pitch": base, "roll": base}, frequency=FREQUENCY)
    assert 0.5 < family.covered("pitch") <= 1.0 + 1e-9
    # The farthest decides, not the mean; a sample that is not used does not.
    poor = replace(base, samples=np.vstack([base.samples, base.samples[0] * [3.0, 1.0, 1.0]]), used=np.ones(3))
    farthest = replace(poor, samples=poor.samples[-1:], used=np.ones(1))
    alone, among = (replace(family, axes={"pitch": one, "roll": base}).covered("pitch") for one in (farthest, poor))
    assert among == alone > 2.0
    unused = replace(poor, used=np.array([1.0, 1.0, 0.0]))
    assert replace(family, axes={"pitch": unused, "roll": base}).covered("pitch") == family.covered("pitch")
    for few in ([middle], [middle, local("window"), local("window")]):
        with pytest.raises(DataError, match=r"only 1 local models say enough \(3 windows do not\)"):
            axis_of(*few)


def test_a_weight_covers_the_samples_between_the_lines_of_a_coarse_grid_too() -> None:
    coarse = np.geomspace(0.05, np.pi / TS, 5)
    found = FamilySettings()._axis("pitch", [local(), local(late=2.0)], coarse, TS, 0)
    fine = np.geomspace(coarse[0], coarse[-1], 5 * coarse.size)
    W = np.abs(np.polyval(found.weight[0], 1j * fine) / np.polyval(found.weight[1], 1j * fine))
    assert (relative_errors(found.samples, found.nominal, fine, TS) <= W * (1.0 + 1e-9)).all()


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_weight_covers_an_envelope_with_a_peak_between_its_lines(order: int) -> None:
    w = np.geomspace(0.05, 150.0, 25)
    envelope = 0.2 + 1.5 * np.exp(-((np.log(w / 6.0) / 0.3) ** 2))
    above, below = envelope_weight(w, envelope, order)
    fine = np.geomspace(w[0], w[-1], 400)
    wanted = np.exp(np.interp(np.log(fine), np.log(w), np.log(envelope)))
    # The lines between the envelope's points, to the spacing of its own finer grid.
    assert (np.abs(np.polyval(above, 1j * fine) / np.polyval(below, 1j * fine)) >= 0.995 * wanted).all()
    for bad in (np.nan, np.inf):
        with pytest.raises(SettingsError, match="must be finite"):
            envelope_weight(w, np.where(np.arange(25) == 7, bad, envelope), order)


def test_points_and_recordings_are_of_the_windows_that_say_something(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that stood still adds nothing to its point and none to its recording, and is counted."""

    def window(recording: int, inclination: float, direction: float, says: bool = True) -> Window:
        return Window(recording=recording, time=float(says), inputs=np.zeros((2, 2)), outputs=np.zeros((2, 2)),
                      inclination=inclination, direction=direction)  # fmt: skip

    asked: list[tuple[str, list[int]]] = []

    def fit(_: Any, group: Any, axis: int, *, scope: str, near: Any = None) -> Local | None:
        if scope != "window":
            asked.append((scope, [cut.index(item) for item in group]))
            assert near is not None
        return local(scope) if group and all(item.time for item in group) else None

    monkeypatch.setattr(_family_fit, "fit_local", fit)
    cut = [window(0, 0.1, 0.0), window(0, 0.1, 0.1, says=False), window(0, 0.12, 0.1), window(1, 0.1, 0.0),
           window(0, 0.1, np.pi)]  # fmt: skip
    found, lost = FamilySettings()._local_models(cast(Any, None), cut, 0, 3)
    assert sorted(asked) == [("point", [0, 2]), ("point", [3]), ("point", [4]), ("recording", []),
                             ("recording", [0, 2, 4]), ("recording", [3])]  # fmt: skip
    assert ([item.scope for item in found], lost) == (["window"] * 4 + ["point"] * 3 + ["recording"] * 2, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", ["samples", "used", "nominal", "box", "weight", "envelope"])
def test_a_family_file_with_one_number_that_is_none_is_refused(key: str, bad: float, tmp_path: Path) -> None:
    """A sample whose `used` is no number would leave the uncertain plant without a word."""
    family = small_family()
    axis = family.axes["roll"]
    values = getattr(axis, key).copy()
    values.flat[-1] = bad
    broken = replace(family, axes={**family.axes, "roll": replace(axis, **{key: values})})
    broken.save(tmp_path / "f.npz")
    with pytest.raises(FileFormatError, match=f"`roll_{key}` is not finite"):
        load(tmp_path / "f.npz", role="family")
    family.save(tmp_path / "g.npz")
    assert load(tmp_path / "g.npz", role="family").axes["roll"].used.tolist() == axis.used.tolist()


@pytest.mark.parametrize("key", ["samples", "nominal", "box"])
@pytest.mark.parametrize(("column", "bad"), [(1, 0.0), (1, -1.0), (2, -0.01)])
def test_a_family_file_with_one_pole_or_dead_time_that_cannot_be_is_refused(
    key: str, column: int, bad: float, tmp_path: Path
) -> None:
    family = small_family()
    axis = family.axes["roll"]
    values = getattr(axis, key).copy()
    values[..., column].flat[-1] = bad
    replace(family, axes={**family.axes, "roll": replace(axis, **{key: values})}).save(tmp_path / "f.npz")
    with pytest.raises(FileFormatError, match=f"`roll_{key}` is not of poles above and dead times from zero"):
        load(tmp_path / "f.npz", role="family")
    # One that was not tested against data has no weight that a recording could exceed.
    with pytest.raises(DataError, match="was not tested against data"):
        family.invalidated_by([], [])
