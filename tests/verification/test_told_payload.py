"""Controllers that switch by the payload that they are told: in loops, in their replay, and in a verification."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from softneck.core import SettingsError, Vector
from softneck.cosim import load_loop, simulate
from softneck.design import MpcSettings, VaryingController
from softneck.design.varying._switched import SwitchedSettings
from softneck.estimation import KalmanSettings
from softneck.estimation.changes._change import ChangeDetector
from softneck.estimation.changes._settings import ChangeSettings
from softneck.identification import GreyBox
from softneck.loop import BlockPart, Loop, LoopResult, NeckFault, RotationReference, StepReference, run_loop
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.runtime import Port
from softneck.signals import Recording, signal
from softneck.verification import make_requirements, verify

from ..design.test_scheduled import neck

PAPER = VirtualNeck(NeckParameters.paper())
ASKED = {
    "sampling": {"plants": 20, "search_generations": 0},
    "neck": {"necks": 1, "payloads_kg": [0.0, 1.0], "orientations_deg": [45.0], "duration_s": 2.5},
}


def log(motion: str, payload: float, rows: int = 800, seed: int = 1) -> Recording:
    found = record(signal(motion), PAPER, seed=seed, payload=payload).rows(0, rows)
    return found.with_channels(payload=np.full(rows, payload))


@pytest.fixture(scope="module")
def watch() -> ChangeDetector:
    """Two coarse steps of the search: enough for a law, not for a fit."""
    model = GreyBox(evaluations=2, sensor_delay=2).fit([log("eq22", 0.0), log("eq22", 1.0)])
    return ChangeSettings().design(
        model, [log(name, kg, 1300, 2) for name in ("rotation", "sine") for kg in (0.0, 1.0)]
    )


@pytest.fixture(scope="module")
def controller() -> VaryingController:
    models = [neck(5.5), neck(4.5, 4.8)]
    return SwitchedSettings(payloads=(0.0, 1.0), least_cocontraction=0.6, observer=False).design(models)


class Told:
    """A further part that says any payload, and now and then that none explains the neck."""

    inputs = ()
    outputs = (Port(name="payload", unit="kg"), Port(name="changed", boolean=True))
    sample_time, role = 0.02, "observer"

    def start(self, time: float, parameters: Mapping[str, float]) -> Vector:
        return self.advance(time + 0.0 * len(parameters), np.zeros(0))

    def advance(self, time: float, inputs: Vector) -> Vector:
        return np.array([0.5 + 0.7 * math.sin(time), float(time % 5.0 > 4.0)]) + inputs.sum()

    def close(self) -> None:
        """Hold nothing."""


def looped(controller: VaryingController, teller: Any) -> LoopResult:
    fault = NeckFault(start=8.0, duration=8.0, values={"payload": 1.0})
    return run_loop(Loop(
        plant=BlockPart(PAPER.block()), controller=BlockPart(controller.block()), duration=20.0, faults=(fault,),
        reference=RotationReference(inclination=0.2, frequency=0.2, at=0.5), others={"watch": teller},
    ))  # fmt: skip


def column(result: LoopResult, *names: str) -> np.ndarray:
    """Return signals (time, names); what nobody wrote is true."""
    rows = len(result["pitch"])
    return np.column_stack([result[name] if name in result.signals else np.ones(rows) for name in names])


def test_the_controller_replays_from_the_log_to_the_bit(controller: VaryingController) -> None:
    result = looped(controller, Told())
    motors = [f"motor_position_{j}" for j in (1, 2, 3)]
    U = column(
        result, "pitch_reference", "roll_reference", "cocontraction_reference", "pitch_measured", "roll_measured",
        *motors, "measurement_valid", "enabled", "payload", "changed",
    )  # fmt: skip
    block = controller.block()
    again = block.run(block.initial_state(), U)[1]
    told = column(result, "motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3")
    np.testing.assert_array_equal(again, told)
    # What was told matters: with another payload the set-points are others.
    U[:, 10] = 0.0
    assert not np.array_equal(block.run(block.initial_state(), U)[1], told)


def test_the_detector_replays_from_the_log_to_the_bit(controller: VaryingController, watch: ChangeDetector) -> None:
    result = looped(controller, BlockPart(watch.block()))
    asked = column(result, "motor_setpoint_1", "motor_setpoint_2", "motor_setpoint_3")
    # It steps before the controller: it reads the set-points of the sample before.
    before = np.vstack([np.zeros(3), asked[:-1]])
    U = np.column_stack([before, column(result, "pitch_measured", "roll_measured", "measurement_valid")])
    told = watch.block().run(watch.initial_state(), U)[1]
    np.testing.assert_array_equal(told[:, [0, 3]], column(result, "changed", "payload"))


def test_while_the_neck_stands_no_payload_is_told(watch: ChangeDetector) -> None:
    run = log("rotation", 0.0, 600, 4)
    still = {f"motor_setpoint_{j}": np.full(600, value) for j, value in ((1, 1.2), (2, -0.6), (3, -0.6))}
    rng = np.random.default_rng(1)
    held = run.with_channels(**still, pitch=0.2 + 0.05 * rng.standard_normal(600), roll=np.full(600, -0.3))
    np.testing.assert_array_equal(watch.watch(held, payload_start=0.37)[:, 3], 0.37)


@pytest.mark.slow
def test_verify_has_the_estimate_in_its_loops(
    watch: ChangeDetector, controller: VaryingController, tmp_path: Path
) -> None:
    found = verify(controller, {"line": neck(5.5)}, make_requirements(ASKED), observer=watch)
    runs: list[Any] = found.evidence.necks
    assert [run.payload for run in runs] == [0.0, 1.0]
    size = math.radians(float(found.requirements.neck["size_deg"]))
    for run in runs:
        # By hand, to the bit: the detector beside the loop, the controller on the measured angles.
        assert run.result is not None
        block = PAPER.block(noise_seed=run.seed)
        ends = size * math.cos(run.orientation), size * math.sin(run.orientation)
        by_hand = run_loop(Loop(
            plant=BlockPart(block), controller=BlockPart(controller.block()), duration=5.5,
            reference=StepReference(pitch=ends[0], roll=ends[1], at=3.0), plant_inputs={"payload": run.payload},
            others={"any": BlockPart(watch.block())},
        ))  # fmt: skip
        np.testing.assert_array_equal(by_hand["pitch"], run.result["pitch"])
        np.testing.assert_array_equal(by_hand["payload"], run.result["payload"])
    assert "payload at its start value" in found.evidence.not_computed["steps of other payloads"]
    # The worst loops are files that do the same.
    controller.save(tmp_path / "c.npz")
    watch.save(tmp_path / "watch.npz")
    files = found.write_worst(tmp_path / "worst", controller=tmp_path / "c.npz", observer=tmp_path / "watch.npz")
    path = next(path for path in files.values() if path.name.startswith("neck_overshoot"))
    assert '[[part]]\nname = "detector"' in path.read_text(encoding="utf-8")
    value = next(v.value for v in found.verdicts if v.requirement.metric == "neck.overshoot_pct")
    metrics = simulate(load_loop(path)).metrics
    reached = [float(metrics[axis]["overshoot_pct"] or 0.0) for axis in ("pitch", "roll")]
    # The table of a loop file states angles in degrees: rounding.
    assert max(reached) == pytest.approx(value, rel=1e-6)


def test_without_an_estimate_it_is_refused_in_one_line(controller: VaryingController) -> None:
    with pytest.raises(SettingsError, match=r"switched acts by the payload that it is told; give --observer"):
        verify(controller, {"line": neck(5.5)}, make_requirements(ASKED))


@pytest.mark.slow
def test_verify_has_the_estimate_of_an_observer_in_the_loops_of_an_mpc() -> None:
    """By hand, to the bit: the observer over a model of several payloads tells the controller what it thinks."""
    model = GreyBox(evaluations=2, sensor_delay=2).fit([log("eq22", 0.0), log("eq22", 1.0)])
    observer = KalmanSettings().design(model)
    settings = MpcSettings(bandwidth=6.0, minimum_tautness=0.5, payload_tautness=2.0)
    controller, deaf = settings.design(neck(5.5)), replace(settings, payload_tautness=0.0).design(neck(5.5))
    found = verify(controller, {"line": neck(5.5)}, make_requirements(ASKED), observer=observer)
    runs: list[Any] = found.evidence.necks
    assert [run.payload for run in runs] == [0.0, 1.0]
    size = math.radians(float(found.requirements.neck["size_deg"]))
    for run in runs:
        assert run.result is not None
        ends = size * math.cos(run.orientation), size * math.sin(run.orientation)
        at = float(np.flatnonzero(run.result["pitch_reference"])[0]) * 0.02
        by_hand, not_told = (run_loop(Loop(
            plant=BlockPart(PAPER.block(noise_seed=run.seed)), controller=BlockPart(one.block()),
            observer=BlockPart(observer.block()), plant_inputs={"payload": run.payload},
            reference=StepReference(pitch=ends[0], roll=ends[1], at=at), duration=at + 2.5,
        )) for one in (controller, deaf))  # fmt: skip
        np.testing.assert_array_equal(by_hand["pitch"], run.result["pitch"])
        # An estimate by which the controller acts: that of the light neck is another than that of the heavy one.
        np.testing.assert_array_equal(by_hand["payload_estimate"], run.result["payload_estimate"])
        # What it is told matters: one that does not listen moves the motors otherwise.
        assert not np.array_equal(not_told["motor_setpoint_1"], run.result["motor_setpoint_1"])
    light, heavy = (run.result["payload_estimate"] for run in runs)
    assert not np.array_equal(light, heavy)
