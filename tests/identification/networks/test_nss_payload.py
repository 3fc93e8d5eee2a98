"""The neural state space of several payloads: the payload is an input of its map, alone and times each other input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softneck.core import DataError, FileFormatError, load
from softneck.identification import Model, NeuralStateSpace
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

from ...foreign_necks.necks import ForeignNeck
from ...foreign_necks.necks import record as record_foreign

SMALL = NeuralStateSpace(neurons=3, starts=1, iterations=3)


def log(payload: float, rows: int = 1500, seed: int = 1) -> Recording:
    found = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=seed, payload=payload).rows(0, rows)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.fixture(scope="module")
def model() -> Model:
    """Coarse steps: enough for a law, not for a fit."""
    return SMALL.fit([log(0.2), log(0.8)])


def at(model: Model, payload: float) -> Model:
    """The model of one payload: more inputs folded into weights, and what the payload alone pulls into where x is."""
    a = {name: array for name, array in model.arrays.items() if name != "payload"}
    p = (a["B"].shape[1] - 1) // 2
    x = np.linalg.solve(np.eye(len(a["A"])) - a["A"], payload * a["B"][:, -1])
    own = {
        "B": a["B"][:, :p] + payload * a["B"][:, p : 2 * p],
        "G": a["G"][:, :p] + payload * a["G"][:, p : 2 * p],
        "h": a["h"] + payload * a["G"][:, -1] + a["F"] @ x,
        "c": a["c"] + a["C"] @ x,
    }
    return replace(model, arrays=a | own)


def free_run(model: Model, run: Recording, **parameters: float) -> np.ndarray:
    block = model.block()
    rows = np.full((len(run), len(block.inputs)), np.nan)
    rows[:, :3] = run.set_points
    return block.run(block.initial_state(use_measurement=0.0, **parameters), rows)[1]


@pytest.mark.parametrize("payload", [0.2, 0.5, 0.8])
def test_under_a_payload_it_is_the_model_of_that_payload(model: Model, payload: float) -> None:
    run = log(0.0, 300)
    ours, plain = free_run(model, run, payload=payload), free_run(at(model, payload), run)
    # Sums in another order, through a map that contracts: rounding, of angles below 1 rad. The states of both begin
    # elsewhere and have settled for `memory`, 15 s of a slowest time constant of 5 s: e^-3 of rounding-free distance
    # is left of what the shifted state began with, which the neck's own poles, ten times faster, do not show.
    np.testing.assert_allclose(ours[:, :2], plain[:, :2], atol=1e-6)
    assert np.abs(ours[:, :2] - free_run(model, run, payload=0.4)[:, :2]).max() > 1e-4


def test_a_recording_tells_its_payload(model: Model) -> None:
    run = log(0.5, 300)
    np.testing.assert_allclose(model.simulate(run)[:, :2], at(model, 0.5).simulate(run)[:, :2], atol=1e-6)


@pytest.mark.parametrize(("payload", "known"), [(0.1, False), (0.2, True), (0.8, True), (0.9, False)])
def test_beyond_the_payloads_of_its_recordings_it_does_not_know(model: Model, payload: float, known: bool) -> None:
    validity = free_run(model, log(0.0, 50), payload=payload)[:, -1]
    assert (validity > 0.0).all() if known else (validity == 0.0).all()


def test_one_payload_is_no_parameter() -> None:
    heavy = SMALL.fit([log(0.5, 800), log(0.5, 800, 2)])
    assert "payload" not in heavy.arrays
    assert "payload" not in [port.name for port in heavy.block().parameters]


def test_its_file_keeps_it(model: Model, tmp_path: Path) -> None:
    model.save(tmp_path / "m.npz")
    again, run = load(tmp_path / "m.npz"), log(0.5, 200)
    np.testing.assert_array_equal(again.simulate(run), model.simulate(run))
    assert "0.2 to 0.8 kg" in next(port for port in again.block().parameters if port.name == "payload").description


def test_a_file_with_senseless_payloads_is_refused(model: Model, tmp_path: Path) -> None:
    replace(model, arrays={**model.arrays, "payload": np.array([0.8, 0.2])}).save(tmp_path / "m.npz")
    with pytest.raises(FileFormatError, match="its payloads from"):
        load(tmp_path / "m.npz")


def test_a_payload_that_changes_within_a_run_is_refused() -> None:
    run = log(0.5, 800)
    with pytest.raises(DataError, match="cut the recording there"):
        SMALL.fit(run.with_channels(payload=np.where(np.arange(800) < 400, 0.0, 0.5)))


@pytest.mark.slow
def test_between_its_payloads_it_is_as_good_as_a_model_of_that_payload() -> None:
    """Within 2 points of a model trained on the unseen payload, on a neck of other equations."""

    def foreign(payload: float) -> Recording:
        run = record_foreign(signal("eq22"), ForeignNeck(name="column", seed=1), seed=1, payload=payload)
        return run.with_channels(payload=np.full(len(run), payload))

    fit = NeuralStateSpace(starts=2).fit
    several = fit([foreign(payload).rows(0, 5000) for payload in (0.0, 0.5, 1.0)])
    own, test = fit(foreign(0.25).rows(0, 5000)), foreign(0.25).rows(5000, 7000)

    def fits(model: Model) -> np.ndarray:
        y = test.outputs[50:]
        missed = np.linalg.norm(y - model.simulate(test)[50:, :2], axis=0)
        return 100.0 * (1.0 - missed / np.linalg.norm(y - y.mean(axis=0), axis=0))

    assert (fits(several) > fits(own) - 2.0).all()
