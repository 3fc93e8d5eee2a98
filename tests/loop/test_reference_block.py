"""A reference as a block gives what the function gives, at every sample."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.loop import RecordingReference, Reference, ReferenceBlock
from softneck.runtime import load_runtime

from ..references import RampReference, RotationReference, SineReference, StepReference

EVERY: dict[str, Reference] = {
    "step": StepReference(pitch=0.2, roll=-0.1, cocontraction=0.4, at=0.3),
    "ramp": RampReference(pitch=0.3, roll=0.1, cocontraction=-0.5, at=0.2, rise=0.7),
    "sine": SineReference(pitch=0.3, roll=-0.2, cocontraction=0.3, frequency=0.7, at=0.1),
    "rotation": RotationReference(inclination=0.25, cocontraction=0.2, frequency=0.6, at=0.1, rise=0.5),
    "recording": RecordingReference(np.array([[0.0, 0.1, 0.0, 0.0], [0.05, 0.2, -0.1, 0.0], [0.3, 0.3, -0.2, 0.0]])),
}


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("kind", list(EVERY))
def test_the_block_is_the_function(kind: str, compiled: bool) -> None:
    reference, block = EVERY[kind], ReferenceBlock(EVERY[kind]).block()
    state = block.initial_state()
    Y = np.zeros((100, 4))
    runtime = load_runtime(block.runtime, compiled=compiled)
    runtime.run_steps(block.arrays, state.parameters, state.values.copy(), np.zeros((100, 0)), Y)
    expected = [[*reference(k * 0.02), 1.0] for k in range(101)]
    # The same formulas; a compiled sine may differ in its last digit.
    np.testing.assert_allclose(np.vstack([state.outputs, Y]), expected, rtol=1e-14, atol=1e-16)


def test_a_function_of_ones_own_is_written_down_sample_by_sample() -> None:
    def own(time: float, /) -> tuple[float, float, float]:
        return 0.1 * time, -0.1 * time, 0.0

    block = ReferenceBlock(own, duration=1.0).block()
    _, Y = block.run(block.initial_state(), np.zeros((49, 0)))
    np.testing.assert_array_equal(Y[:, 0], [0.1 * (k * 0.02) for k in range(1, 50)])
    with pytest.raises(SettingsError, match="needs `duration`"):
        ReferenceBlock(own).block()


def test_the_summary_states_its_values() -> None:
    assert "pitch = 0.2" in ReferenceBlock(EVERY["step"]).summary()
