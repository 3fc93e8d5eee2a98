"""What the presets were calibrated to; the presets and the test signals are frozen by hashes."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from softneck.identification import Rls, nrmse_fit, validate
from softneck.identification.models._linear_systems import continuous_parameters
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal
from softneck.signals.importing._clocks import pitch_roll

OPEN_LOOP = Path(__file__).parents[3] / "shared" / "data" / "neck_openloop" / "spring_test_0gr.csv"
# Later work is scored on these: a change needs an issue of its own.
PRESETS = {
    "paper": "f2e40627eb0ccaf9",
    "lab": "a18d3c21ceea6ab4",
}
# What they answer, from before the link had a direction of its stiffness: what is off in them changes no bit.
ANSWERS = {
    "paper": "35e6f10cc94cbea9",
    "lab": "02f4693b9410c450",
}
SIGNALS = {
    "eq22": "9ca518a82ec22692",
    "steps": "79948d02f5797108",
    "sine": "75b103260f3ab3bb",
    "rotation": "9eeb1fe2c0edf204",
}


def preset_hash(name: str) -> str:
    neck = NeckParameters.preset(name)
    text = "\n".join(f"{key} = {getattr(neck, key):.12g}" for key in neck.names())
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def signal_hash(name: str) -> str:
    # To 1e-9 rad: sines of different libraries differ in the last bit.
    text = np.array2string(np.round(signal(name).set_points, 9) + 0.0, threshold=10**9, precision=9)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@pytest.mark.parametrize("name", PRESETS)
def test_the_presets_are_frozen(name: str) -> None:
    assert preset_hash(name) == PRESETS[name]


@pytest.mark.parametrize("name", ANSWERS)
def test_paper_and_lab_answer_as_they_always_did(name: str) -> None:
    block = VirtualNeck(NeckParameters.preset(name)).block(noise_seed=5)
    U = np.zeros((500, 8))
    U[:, :3], U[:, 3] = signal("eq22", duration=10.0).set_points, 0.3
    # A push, and a base that leans.
    U[200:250, 4], U[350:, 6] = 2.0, 0.1
    start = block.initial_state()
    Y = np.vstack([start.outputs, block.run(start, U)[1]])
    # To 1e-9, as the signals; on the machine where the hashes were made all bits were the same.
    text = np.array2string(np.round(Y, 9) + 0.0, threshold=10**9, precision=9)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == ANSWERS[name]


@pytest.mark.parametrize("name", SIGNALS)
def test_the_papers_signals_are_frozen(name: str) -> None:
    assert signal_hash(name) == SIGNALS[name]


@pytest.fixture(scope="module")
def experiment() -> Recording:
    return record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=0)


@pytest.mark.parametrize("delay", [None, 0.08], ids=["searched", "the paper's"])
def test_the_paper_preset_is_the_papers_neck_to_the_kits_own_identification(
    experiment: Recording, delay: float | None
) -> None:
    train, rest = experiment.split(0.7)
    assert rest is not None
    model = Rls(delay=delay).fit(train)
    # Eq. 31: gains within 10 %, poles within 20 %, as issue 3 asks.
    for axis, (gain, pole) in enumerate(((5.2, 5.3), (5.1, 4.9))):
        found = continuous_parameters(model.sample_time, model.arrays, axis)
        assert found is not None
        K, p, L = found
        assert np.degrees(K / p) == pytest.approx(gain, rel=0.1)
        assert p == pytest.approx(pole, rel=0.2)
        assert 0.06 - 1e-9 <= L <= 0.10 + 1e-9
    fits = validate(model, rest, horizons=("inf",)).fits["inf"]
    assert all(75.0 <= fit <= 88.0 for fit in fits.values() if fit is not None)
    assert None not in fits.values()


def test_the_paper_preset_moves_as_far_as_the_papers_neck(experiment: Recording) -> None:
    reach = np.degrees(np.abs(experiment.outputs).max(axis=0))
    # The paper says +-20 and [-20, 40] deg, which do not follow from its own equations: 20 to 40 here.
    assert ((reach > 20.0) & (reach < 40.0)).all()


@pytest.mark.skipif(not OPEN_LOOP.is_file(), reason="the lab's recordings are not in ../shared/data")
def test_the_lab_preset_follows_the_labs_recording_from_set_points_alone() -> None:
    table = np.genfromtxt(OPEN_LOOP, delimiter=",", names=True)
    measured = np.column_stack(
        pitch_roll(np.radians(table["inclination_sensor"]), np.radians(table["orientation_sensor"]))
    )
    U = np.zeros((table.size, 8))
    U[:, :3] = np.radians(np.column_stack([table[f"target_motor{j}"] for j in (1, 2, 3)]))
    block = VirtualNeck(NeckParameters.lab().without_noise()).block(sample_time=0.021)
    start = block.initial_state()
    Y = np.vstack([start.outputs, block.run(start, U[:-1])[1]])
    for axis in (0, 1):
        # Issue 3: over 85 % on both axes.
        assert nrmse_fit(measured[:, axis], Y[:, 2 + axis]) > 85.0


def closed_loop(payload: float) -> tuple[float, float]:
    """Overshoot [%] and 5 % settling time [s] of a 15 deg step under a PI loop like the lab's."""
    block = VirtualNeck(NeckParameters.lab().without_noise()).block()
    u, state, integral, track = np.zeros(8), block.initial_state(), 0.0, []
    u[3] = payload
    for k in range(500):
        goal = np.radians(15.0) if k >= 100 else 0.0
        error = goal - state.outputs[2]
        integral += 31.5 * 0.02 * error
        theta = 1.15 * error + integral
        u[:3] = theta * np.array([2.0, -1.0, -1.0]) / 3.0
        state, y = block.step(state, u)
        track.append(y[0] / np.radians(15.0))
    step = np.array(track[100:])
    outside = np.flatnonzero(np.abs(step - 1.0) > 0.05)
    return 100.0 * (step.max() - 1.0), 0.02 * (outside[-1] + 1)


def test_a_heavier_payload_overshoots_more_and_settles_later() -> None:
    overshoot, settling = np.array([closed_loop(payload) for payload in (0.0, 0.4, 0.7, 1.0)]).T
    assert (np.diff(overshoot) > 0.0).all(), overshoot
    assert settling[-1] > settling[0], settling
    # The lab's own loop: 7.7 % at 0 g to 21.4 % at 1 kg (control facts); a loop of ours is not that loop.
    assert overshoot[-1] - overshoot[0] > 5.0
