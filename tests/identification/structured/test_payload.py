"""The grey box of several payloads: what hangs on the platform changes two of its numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, SettingsError, load
from softneck.identification import GreyBox, Model
from softneck.identification.structured._loaded_greybox_runtime import effective_payload, loaded_neck
from softneck.identification.structured._parameters import PARAMETERS, payload_parameters
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, concatenate, signal

from ...foreign_necks.necks import ForeignNeck
from ...foreign_necks.necks import record as record_foreign

NAMES = [number.name for number in PARAMETERS]


def log(payload: float, rows: int = 1500, seed: int = 1) -> Recording:
    found = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=seed, payload=payload).rows(0, rows)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.fixture(scope="module")
def model() -> Model:
    """Two coarse steps of the search: enough for a law, not for a fit."""
    return GreyBox(evaluations=2, sensor_delay=2).fit([log(0.2), log(0.8)])


def at(model: Model, payload: float) -> Model:
    """The model of one payload whose numbers are those under `payload`."""
    arrays = {name: array for name, array in model.arrays.items() if name != "payload"}
    return replace(model, arrays={**arrays, "neck": loaded_neck(arrays["neck"], model.arrays["payload"], payload)})


def fit_percent(true: np.ndarray, said: np.ndarray) -> np.ndarray:
    return 100.0 * (1.0 - np.linalg.norm(true - said, axis=0) / np.linalg.norm(true - true.mean(axis=0), axis=0))


def free_run(model: Model, run: Recording, **parameters: float) -> np.ndarray:
    block = model.block()
    rows = np.full((len(run), len(block.inputs)), np.nan)
    rows[:, :3] = run.set_points
    return block.run(block.initial_state(use_measurement=0.0, **parameters), rows)[1]


@pytest.mark.parametrize("payload", [0.2, 0.5, 0.8])
def test_under_a_payload_it_is_the_model_of_that_payload(model: Model, payload: float) -> None:
    run = log(0.0, 300)
    ours, plain = free_run(model, run, payload=payload), free_run(at(model, payload), run)
    np.testing.assert_array_equal(ours, plain)
    assert not np.array_equal(ours[:, :2], free_run(model, run, payload=0.4)[:, :2])


def test_what_the_link_itself_pulls_does_not_go_with_the_payload(model: Model) -> None:
    """Its stiffness times its rest and its asymmetry: moments that a payload adds nothing to."""
    neck, stiffness = model.arrays["neck"], NAMES.index("stiffness")
    loaded = loaded_neck(neck, np.array([0.0, 1.0, -3.0, -0.2]), 0.7)
    assert loaded[stiffness] == neck[stiffness] - 3.0 * 0.7
    assert loaded[NAMES.index("pretension")] == neck[NAMES.index("pretension")] - 0.2 * 0.7
    for name in ("asymmetry", "rest_pitch", "rest_roll"):
        place = NAMES.index(name)
        # One product and one quotient apart.
        np.testing.assert_allclose(loaded[place] * loaded[stiffness], neck[place] * neck[stiffness], rtol=1e-13)


def test_the_law_meets_the_line_at_its_ends_and_saturates_between() -> None:
    line, curve = np.array([0.2, 1.2, -3.0, -0.2]), np.array([0.2, 1.2, -3.0, -0.2, 4.0])
    for payload in (0.2, 1.2):
        # One quotient apart.
        assert effective_payload(curve, payload) == pytest.approx(payload, rel=1e-14)
    assert effective_payload(line, 0.6) == 0.6
    # w of a third: (1 - exp(-4/3)) / (1 - exp(-4)), by its definition.
    assert effective_payload(curve, 0.2 + 1.0 / 3.0) == pytest.approx(0.2 + 0.736403 / 0.981684, abs=1e-6)
    nearly = effective_payload(np.array([0.2, 1.2, -3.0, -0.2, 1e-4]), 0.7)
    # A quarter of c s (1 - s): what second order leaves of the line.
    assert nearly == pytest.approx(0.7, abs=2e-5)


def test_two_payloads_give_a_line_and_three_a_curve() -> None:
    assert [len(payload_parameters(count)) for count in (1, 2, 3, 4)] == [0, 2, 3, 3]


def test_a_recording_tells_its_payload(model: Model) -> None:
    run = log(0.5, 300)
    np.testing.assert_array_equal(model.simulate(run), at(model, 0.5).simulate(run))
    bare = Recording(run.time, run.sample_time, {name: x for name, x in run.channels.items() if name != "payload"})
    np.testing.assert_array_equal(model.simulate(bare)[:, :2], at(model, 0.0).simulate(bare)[:, :2])


@pytest.mark.parametrize(("payload", "known"), [(0.1, False), (0.2, True), (0.8, True), (0.9, False)])
def test_beyond_the_payloads_of_its_recordings_it_does_not_know(model: Model, payload: float, known: bool) -> None:
    validity = free_run(model, log(0.0, 50), payload=payload)[:, -1]
    assert (validity > 0.0).all() if known else (validity == 0.0).all()


def test_one_payload_is_no_parameter() -> None:
    heavy = GreyBox(evaluations=1, sensor_delay=2).fit([log(0.5, 800), log(0.5, 800, 2)])
    assert "payload" not in heavy.arrays
    assert "payload" not in [port.name for port in heavy.block().parameters]


def test_a_recording_without_payload_beside_others_bore_none() -> None:
    bare, heavy = record(signal("steps"), VirtualNeck(NeckParameters.paper())), log(0.5, 300)
    joined = concatenate([bare, heavy]).channels["payload"]
    np.testing.assert_array_equal(joined, np.r_[np.zeros(len(bare)), np.full(300, 0.5)])
    assert "payload" not in concatenate([bare, bare]).channels


def test_a_payload_that_changes_within_a_run_is_refused() -> None:
    run = log(0.5, 800)
    put_on = run.with_channels(payload=np.where(np.arange(800) < 400, 0.0, 0.5))
    with pytest.raises(DataError, match=r"from 0 to 0\.5 kg; cut the recording there"):
        GreyBox().fit(put_on)


@pytest.mark.parametrize("payload", [-1.0, 500.0])
def test_a_payload_that_no_neck_bears_is_refused_before_the_search(payload: float) -> None:
    run = log(0.0, 800)
    with pytest.raises(DataError, match="must be 0 to 5; is its column in grams"):
        GreyBox().fit([run, run.with_channels(payload=np.full(800, payload))])


def test_its_file_keeps_it(model: Model, tmp_path: Path) -> None:
    model.save(tmp_path / "m.npz")
    again, run = load(tmp_path / "m.npz"), log(0.5, 200)
    np.testing.assert_array_equal(again.simulate(run), model.simulate(run))
    payload = next(port for port in again.block().parameters if port.name == "payload")
    assert (payload.unit, payload.start) == ("kg", 0.2)
    assert "0.2 to 0.8 kg" in payload.description


@pytest.mark.parametrize(
    "spoiled", [[0.8, 0.2, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0], [0.0, 1.0, 0.0, 99.0], [0.0, 1.0, 0.0, 0.0, -1.0]]
)
def test_a_file_with_senseless_payloads_is_refused(model: Model, tmp_path: Path, spoiled: list[float]) -> None:
    replace(model, arrays={**model.arrays, "payload": np.array(spoiled)}).save(tmp_path / "m.npz")
    with pytest.raises(FileFormatError):
        load(tmp_path / "m.npz")


def test_a_payload_is_none_of_the_starts_of_other_models(model: Model) -> None:
    with pytest.raises(SettingsError, match="payload"):
        at(model, 0.2).block().initial_state(payload=0.5)


@pytest.mark.slow
def test_between_its_payloads_it_is_as_good_as_a_model_of_that_payload() -> None:
    """Within 2 points of a model trained on the unseen payload, on a neck of other equations."""

    def foreign(payload: float, seed: int, rows: int) -> Recording:
        return record_foreign(signal("eq22"), ForeignNeck(name="spring", seed=1), seed=seed, payload=payload).rows(
            0, rows
        )

    several = GreyBox(sensor_delay=2).fit([foreign(payload, 1, 2000) for payload in (0.0, 0.5, 1.0)])
    own = GreyBox(sensor_delay=2).fit(foreign(0.75, 1, 2000))
    test = foreign(0.75, 9, 1500)
    scores = [fit_percent(test.outputs[50:], m.simulate(test)[50:, :2]) for m in (several, own, at(several, 0.0))]
    assert (scores[0] > scores[1] - 2.0).all()
    # Without the payload it is far off.
    assert (scores[2] < scores[0] - 4.0).all()
