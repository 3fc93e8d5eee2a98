"""Plants, stability and margins of many loops at once equal what python-control says of each alone."""

from __future__ import annotations

import math
import re
from typing import Any

import control
import numpy as np
import pytest
from scipy.linalg import block_diag

from softneck.core import SettingsError
from softneck.design import FopiSettings, PiSettings, mu_upper
from softneck.design.robust._mu import two_scalars
from softneck.estimation import LinearNeck
from softneck.identification.models._linear_systems import remove_unreachable_states
from softneck.loop import BlockPart
from softneck.verification import linear_plant
from softneck.verification._linear import AxisMargins, LinearLaw, frequency_grid, inverse, margins, radii
from softneck.verification._plants import (
    AxisBox,
    Plants,
    PlantSource,
    all_plants,
    make_plants,
    nominal_plants,
    source_of_family,
    source_of_model,
)
from softneck.verification._structured import _axis_model, search, structured_singular_value

from .necks import PAPER, TS, controller_of, family, linear_neck, pi

SPREAD = {"gain": 0.2, "pole": 0.2, "delay": 0.02}
W = frequency_grid(TS)


def _disk(L: Any) -> float:
    """Return the balanced disk margin of an open loop, all channels at once: 1/mu(S - I/2) (Seiler et al. 2020)."""
    at = np.exp(1j * np.geomspace(0.02, math.pi / TS, 1500) * TS)
    response = np.moveaxis(np.asarray(L(at, squeeze=False)), -1, 0)
    S = np.linalg.inv(np.eye(L.noutputs) + response)
    return float(1.0 / mu_upper(S - 0.5 * np.eye(L.noutputs), [(1, 0)] * L.noutputs).max())


def _transfer(plants: Plants, row: int, axis: int) -> control.TransferFunction:
    below = np.append(plants.denominator[row, axis], np.zeros(plants.delay[row, axis]))
    return control.TransferFunction(plants.numerator[row, axis], below, TS)


def test_plants_of_a_family_are_sampled_as_the_family_samples_them() -> None:
    found = family()
    plants = all_plants([source_of_family(found, "f")], 1, 0)
    rows = [k for k, name in enumerate(plants.names) if "sample" in name]
    G = plants.take(rows).response(W)
    for i, axis in enumerate(("pitch", "roll")):
        expected = [np.asarray(item(np.exp(1j * W * TS))) for item in found.samples(axis)]
        # Rounding of coefficients only.
        np.testing.assert_allclose(G[:, i], expected, rtol=1e-9)


def test_the_nominal_plant_of_a_model_is_the_model() -> None:
    model = linear_neck()
    a, b = 0.9, 0.6
    second = control.TransferFunction([0.002, 0.001], np.concatenate([np.convolve([1, -a], [1, -b]), [0, 0, 0]]), TS)
    ringing = control.TransferFunction([0.002, 0.001], [1.0, -1.6, 0.73, 0.0, 0.0], TS)
    for tf in (model.pitch, second, ringing):
        neck = source_of_model(type(model)(pitch=tf, roll=tf), "m", SPREAD)
        G = nominal_plants([neck])[0].response(W)[0, 0]
        # 1e-6: of a ringing model the pole that does not show is at exp(-200).
        np.testing.assert_allclose(G, np.asarray(tf(np.exp(1j * W * TS))), rtol=1e-6)


@pytest.mark.parametrize("cross", [0.0, 0.3])
def test_radii_are_those_of_the_closed_loops_poles(cross: float) -> None:
    plants = all_plants([source_of_family(family(cross=cross, spread=0.5), "f")], 40, 1).later(2)
    controller = pi()
    found = radii(plants, LinearLaw.of(controller.ss()))
    K: Any = controller.ss()
    for row in range(0, len(plants), 7):
        first, second = (control.ss(_transfer(plants, row, i)) for i in (0, 1))
        mixed = np.array([[1.0, plants.cross[row, 0]], [plants.cross[row, 1], 1.0]])
        P: Any = control.append(first, second) * control.StateSpace([], [], [], mixed, TS)
        Ky: Any = control.StateSpace(K.A, K.B[:, 2:], K.C, K.D[:, 2:], TS)
        closed: Any = control.feedback(P, Ky, sign=1)
        # Poles at zero of multiplicity m are found to eps^(1/m) only; the largest ones are simple.
        assert found[row] == pytest.approx(np.abs(closed.poles()).max(), rel=1e-6)


@pytest.mark.slow
def test_margins_are_those_of_python_control() -> None:
    pytest.importorskip("slycot")
    plants = all_plants([source_of_model(linear_neck(), "m", SPREAD)], 30, 0)
    law = LinearLaw.of(pi().ss())
    found = margins(plants, law)
    z = np.exp(1j * W * TS)
    Ky: Any = control.minreal(
        control.StateSpace(law.A, law.By[:, [0]], -law.C[[0]], -law.Dy[[0]][:, [0]], TS), verbose=False
    )
    for row in range(0, len(plants), 5):
        L: Any = control.ss(_transfer(plants, row, 0)) * Ky
        gain, phase, _, _, crossover, _ = (float(item) for item in control.stability_margins(L))
        # Straight lines on a grid 0.6 % wide.
        assert found["pitch.gain_margin"][row] == pytest.approx(gain, rel=2e-3)
        assert found["pitch.phase_margin_deg"][row] == pytest.approx(phase, rel=2e-3)
        assert found["pitch.delay_margin_ms"][row] == pytest.approx(1e3 * math.radians(phase) / crossover, rel=2e-3)
        S: Any = control.feedback(1, L)
        infinity: Any = "inf"
        norm = float(control.system_norm(S, p=infinity, print_warning=False))
        assert found["pitch.sensitivity"][row] == pytest.approx(norm, rel=2e-3)
        assert found["pitch.disk_margin"][row] == pytest.approx(_disk(L), rel=2e-3)
    assert np.isfinite(np.asarray(Ky(z))).all()


@pytest.mark.parametrize("kind", [PiSettings, FopiSettings], ids=["pi", "fopi"])
def test_python_control_says_the_same_margins(kind: Any) -> None:
    plants = nominal_plants([source_of_model(linear_neck(), "m", SPREAD)])[0]
    law = LinearLaw.of(kind().design(linear_neck()).ss())
    own = margins(plants, law)
    A, B, C = remove_unreachable_states(law.A, law.By[:, [0]], law.C[[0]])
    K = control.StateSpace(A, B, -C, -law.Dy[[0]][:, [0]], TS)
    # Of the state-space form's response: polynomials of this order are inaccurate.
    response = control.frequency_response(control.ss(_transfer(plants, 0, 0)) * K, frequency_grid(TS, 1500)[:-1])
    gains, phases = (np.asarray(item) for item in control.stability_margins(response, returnall=True)[:2])
    gain = np.exp(np.abs(np.log(gains[gains > 0.0])).min())
    phase = np.abs((phases + 180.0) % 360.0 - 180.0).min()
    # The grid of `W` is 3 % wide; straight lines on it.
    assert gain == pytest.approx(own["pitch.gain_margin"][0], rel=5e-3)
    assert phase == pytest.approx(own["pitch.phase_margin_deg"][0], rel=5e-3)


@pytest.mark.parametrize("count", [3, 500], ids=["solved at each frequency", "by back substitution"])
def test_the_response_of_a_law_is_that_of_its_parts(count: int) -> None:
    # An integrator twice, a delay of three samples and a pair of poles: no basis of eigenvectors.
    line, pair = np.eye(3, k=-1), 0.95 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    A: Any = block_diag([[1.0, TS], [0.0, 1.0]], line, pair)
    B = np.array([[0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]]).T
    C = np.array([[1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0]])
    D = np.array([[0.5, 0.0], [0.25, -1.0]])
    w = np.geomspace(0.1, math.pi / TS, count)
    z = np.exp(1j * TS * w)
    angle = 0.95 * np.sin(0.3) / ((z - 0.95 * np.cos(0.3)) ** 2 + (0.95 * np.sin(0.3)) ** 2)
    one = np.stack([TS / (z - 1.0) ** 2 + 2.0 * z**-3.0 + 0.5, z**-2.0 + 0.25], axis=-1)
    two = np.stack([0.0 * z, angle - 1.0], axis=-1)
    law = LinearLaw(A, B, B, C, D, D, TS)
    # Rounding, beside two poles at the same place.
    np.testing.assert_allclose(law.feedback(w), np.stack([one, two], axis=-1), rtol=1e-9, atol=1e-12)


def test_two_complex_scalars_have_a_closed_form() -> None:
    M = np.random.default_rng(0).standard_normal((50, 2, 2, 2)) @ [1.0, 1.0j]
    # The descent ends at log(2)/3000 of the bound.
    np.testing.assert_allclose(two_scalars(M), mu_upper(M, [(1, 0), (1, 0)]), rtol=1e-3)


@pytest.mark.slow
def test_the_margin_of_both_channels_is_that_of_the_system_of_two() -> None:
    plants = nominal_plants([source_of_family(family(cross=0.3), "f")])[0]
    controller: Any = pi().ss()
    law = LinearLaw.of(controller)
    mixed = np.array([[1.0, plants.cross[0, 0]], [plants.cross[0, 1], 1.0]])
    P: Any = control.append(*(control.ss(_transfer(plants, 0, i)) for i in (0, 1)))
    P = P * control.StateSpace([], [], [], mixed, TS)
    K = control.StateSpace(law.A, law.By, -law.C, -law.Dy, TS)
    least = min(_disk(P * K), _disk(K * P))
    # A grid of 2.5 % on a flat peak.
    assert margins(plants, law)["mimo.disk_margin"][0] == pytest.approx(least, rel=5e-3)


def _hidden() -> tuple[PlantSource, LinearLaw]:
    """A resonance of gain 2 and a dead time that turns it once around: unstable only in the middle.

    At both ends of the box the resonance is in phase with -180 deg + 180 deg; half a period later it is at -180.
    """
    frequency, damping = 2.0 * math.pi / 0.08, 0.995
    pole = damping * np.exp(1j * frequency * TS)
    below = np.real(np.poly([pole, np.conj(pole)]))
    shape = control.TransferFunction([1.0, -1.0], below, TS)
    z = np.exp(1j * frequency * TS)
    a = math.exp(-PAPER[1] * TS)
    G = PAPER[0] * (1.0 - a) / (z - a)
    at: complex = complex(np.asarray(shape(z))) * G
    # Such a sign and dead time that the resonance is harmless at the ends.
    sign = 1.5 / abs(at)
    turned = -np.angle(at) % (2.0 * math.pi)
    start = (2.0 * math.pi - turned) / frequency
    low = np.array([PAPER[0], PAPER[1], start])
    box = AxisBox(
        nominal=low, low=low, high=low + np.array([0.0, 0.0, 0.08]), samples=np.zeros((0, 3)),
    )  # fmt: skip
    neck = PlantSource(name="hidden", sample_time=TS, axes=(box, box), cross=np.zeros(2), kind="model",
                        weights=np.eye(2))  # fmt: skip
    law = LinearLaw.of(controller_of(sign * np.array([1.0, -1.0]), below))
    return neck, law


@pytest.mark.slow
def test_a_loop_that_is_stable_at_all_corners_but_not_inside_is_caught_by_the_search() -> None:
    neck, law = _hidden()
    corners = all_plants([neck], 1, 0)
    assert radii(corners, law).max() < 1.0
    found = search([neck], law, extra=0, generations=15, seed=0)
    assert found.radius > 1.0
    assert radii(found.plants, law).max() > 1.0


def test_where_the_search_finds_an_unstable_plant_the_bound_proves_nothing() -> None:
    neck, law = _hidden()
    for row in structured_singular_value(neck, law, extra=0):
        assert row.mu > 1.0


@pytest.mark.slow
def test_bounds_enclose_what_was_sampled() -> None:
    """The box of a neck with a PI: no drawn plant of a box that is grown by less than 1/mu is unstable."""
    neck = source_of_model(linear_neck(), "m", {"gain": 0.4, "pole": 0.4, "delay": 0.02})
    law = LinearLaw.of(pi().ss())
    drawn = np.random.default_rng(0).uniform(-1.0, 1.0, (100, 2, 3))
    drawn[:50] = np.sign(drawn[:50])
    row = structured_singular_value(neck, law, extra=0)[0]
    middle, widths = (np.stack([getattr(box, name) for box in neck.axes]) for name in ("middle", "widths"))

    def unstable(scale: float) -> bool:
        numbers = middle + scale * drawn * widths
        numbers[..., 2] = np.maximum(numbers[..., 2], 0.0)
        return bool((radii(make_plants(neck, numbers, [""] * len(numbers)), law) >= 1.0).any())

    assert row.mu < 1.0
    assert not unstable(1.0 / row.mu)
    assert unstable(2.4)  # the bound is not that of a loop that nothing unsettles


def one_pole(gain: float, pole: float, late: int) -> LinearNeck:
    """Both axes `gain (1 - pole) / (z - pole)` of the paper's gain, `late` samples late; a pole below 0 alternates."""
    axis = control.TransferFunction([gain * (1.0 - pole) * PAPER[0]], [1.0, -pole, *([0.0] * late)], TS)
    return LinearNeck(pitch=axis, roll=axis)


@pytest.mark.parametrize(
    "model", [linear_neck(), *(one_pole(*x) for x in ((0.5, -0.1, 1), (0.3, -0.43, 3), (0.5, -0.43, 3)))]
)
def test_mu_of_gain_alone_is_that_of_the_gain_margin(model: LinearNeck) -> None:
    """With gain +-r alone the loop is unstable from 1 + k r = gain margin on: mu = r/(margin - 1)."""
    r = 0.3
    neck = source_of_model(model, "m", {"gain": r, "pole": 0.0, "delay": 0.0})
    law = LinearLaw.of(pi().ss())
    margin = float(margins(nominal_plants([neck])[0], law)["pitch.gain_margin"][0])
    row = structured_singular_value(neck, law, extra=0)[0]
    # The 1 % of complex dead time that is always there widens the peak, and costs as much here.
    assert r / (margin - 1.0) <= row.mu <= 1.2 * r / (margin - 1.0)


@pytest.mark.parametrize("late", [0, 3, 6])
def test_a_gain_margin_is_where_poles_leave_the_circle(late: int) -> None:
    """Also where they leave it at -1, the Nyquist frequency, as those of a plant that alternates do."""
    law, box = LinearLaw.of(pi().ss()), {"gain": 0.3, "pole": 0.0, "delay": 0.0}

    def plant(k: float) -> Plants:
        return nominal_plants([source_of_model(one_pole(0.3 * k, -0.43, late), "m", box)])[0]

    margin = float(margins(plant(1.0), law)["pitch.gain_margin"][0])
    # 0.1 %: straight lines between frequencies.
    assert radii(plant(0.999 * margin), law)[0] < 1.0 < radii(plant(1.001 * margin), law)[0]


@pytest.mark.parametrize("poles", [[1.0, -0.9], [1.0, 0.43], [1.0, -1.6, 0.73]], ids=["lag", "alternating", "ringing"])
def test_the_middle_of_a_model_s_box_is_the_model(poles: list[float]) -> None:
    """Also where no pole is a lag's, as of a log in which motor positions are the input."""
    tf = control.TransferFunction([0.01], [*poles, 0.0, 0.0, 0.0], TS)
    neck = source_of_model(LinearNeck(pitch=tf, roll=tf), "m", {"gain": 0.2, "pole": 0.0, "delay": 0.0})
    # 1e-6: as of the nominal plant.
    np.testing.assert_allclose(_axis_model(neck.axes[0], W, TS, 0)[0], np.asarray(tf(np.exp(1j * W * TS))), rtol=1e-6)


def test_wrong_delay_is_seen() -> None:
    """Designed without dead time, judged on the paper's 80 ms: not stable."""
    neck = source_of_model(linear_neck(), "m", SPREAD)
    assert radii(nominal_plants([neck])[0], LinearLaw.of(pi(delay=0).ss())).max() > 1.0


def test_more_delay_by_the_order_is_more_delay_of_the_plant() -> None:
    neck = source_of_model(linear_neck(delay=4), "m", SPREAD)
    other = source_of_model(linear_neck(delay=6), "m", SPREAD)
    law = LinearLaw.of(pi().ss())
    one, two = margins(nominal_plants([neck])[0].later(2), law), margins(nominal_plants([other])[0], law)
    for name in one:
        np.testing.assert_allclose(one[name], two[name], rtol=1e-9)  # rounding


def test_numbers_make_plants_between_samples() -> None:
    """A dead time of 3.5 samples lies between those of 3 and 4 in phase."""
    neck = source_of_model(linear_neck(), "m", SPREAD)
    numbers = np.tile(PAPER, (3, 2, 1))
    numbers[:, :, 2] = np.array([0.06, 0.07, 0.08])[:, None]
    G = make_plants(neck, numbers, [""] * 3).response(np.array([1.0]))[:, 0, 0]
    # Between samples the held input makes 3 % of difference; over the whole sample none.
    np.testing.assert_allclose(np.diff(np.angle(G)), -0.01, rtol=0.03)
    assert np.angle(G[2] / G[0]) == pytest.approx(-0.02, rel=1e-9)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_inverse_of_small_matrices_is_theirs(size: int) -> None:
    rng = np.random.default_rng(size)
    M = rng.standard_normal((50, size, size)) + 1j * rng.standard_normal((50, size, size))
    unit = np.broadcast_to(np.eye(size), M.shape)
    # Rounding, times a condition number of less than 1e3.
    np.testing.assert_allclose(inverse(M) @ M, unit, rtol=0, atol=1e-12)


def test_measured_outputs_have_noise_of_the_stated_size_and_none_at_zero() -> None:
    """Whatever the seed, 0 among them; the true outputs have none."""
    values = {
        "numerator": [[0.0, 0.1], [0.0, 0.2]],
        "denominator": [[1.0, -0.9], [1.0, -0.8]],
        "delay": [0, 0],
        "cross": [0.0, 0.0],
    }
    part = BlockPart(linear_plant(**values, sample_time=TS))
    for std in (0.0, 0.01):
        for seed in (0.0, 5.0):
            first = part.start(0.0, {"noise_std": std, "noise_seed": seed})
            assert (first[:4] != 0.0).tolist() == [False, False, std > 0.0, std > 0.0]
            rows = np.array([part.step(k * TS, np.zeros(5)).copy() for k in range(2000)])
            assert not rows[:, :2].any()
            for axis in (2, 3):
                # The deviation of 2,000 draws is known to 1.6 %; three of that.
                assert np.std(rows[:, axis]) == pytest.approx(std, rel=0.05, abs=0.0)


@pytest.mark.parametrize("dt", [0, None, True])
def test_a_linear_form_says_how_often_it_runs(dt: Any) -> None:
    names: dict[str, Any] = {
        "inputs": ["pitch_reference", "roll_reference", "pitch", "roll"],
        "outputs": ["theta_i", "phi_i"],
    }
    rng = np.random.default_rng(0)
    numbers = 0.3 * np.eye(2), rng.normal(size=(2, 4)), rng.normal(size=(2, 2)), rng.normal(size=(2, 4))
    law = LinearLaw.of(control.StateSpace(*numbers, TS, **names))
    assert law.sample_time == TS
    for part, expected in zip((law.A, law.Br, law.By, law.C, law.Dr, law.Dy),
                              (numbers[0], numbers[1][:, :2], numbers[1][:, 2:], numbers[2], numbers[3][:, :2],
                               numbers[3][:, 2:]), strict=True):  # fmt: skip
        np.testing.assert_array_equal(part, expected)
    with pytest.raises(SettingsError, match="must be discrete, with its sample time as dt"):
        LinearLaw.of(control.StateSpace(*numbers, dt, **names))
    with pytest.raises(SettingsError, match="is a ndarray, not a python-control system"):
        LinearLaw.of(numbers[0])
    for what, swapped in (("inputs", [1, 0, 2, 3]), ("inputs", [0, 1, 3, 2]), ("outputs", [1, 0])):
        other = names | {what: [names[what][k] for k in swapped]}
        with pytest.raises(SettingsError, match=r"the controller goes from .* softneck verifies one from pitch_ref"):
            LinearLaw.of(control.StateSpace(*numbers, TS, **other))


@pytest.mark.parametrize(
    ("crossover", "unheard", "band", "told"),
    [
        (5.0, (), (1.0, 20.0), ""), (math.inf, (), (1.0, 20.0), r"from 1 to 20 rad/s, and .* `multisine --band 6,60`"),
        (math.inf, (), (8.0, 20.0), "--band 8,60"),
        (5.0, ("a.csv", "b.csv"), (1.0, 20.0), r"does not respond in a\.csv of f"),
        (math.inf, ("a.csv",), (1.0, 20.0), r"does not respond in a\.csv"),
    ],
)  # fmt: skip
def test_an_axis_says_what_its_data_do_not_support(
    crossover: float, unheard: tuple[str, ...], band: tuple[float, float], told: str
) -> None:
    found = AxisMargins(source="f", axis="pitch", band=band, crossover=crossover, margins={}, mu=0.5, at={},
                        unheard=unheard)  # fmt: skip
    assert re.search(told, found.why()) if told else found.why() == ""
