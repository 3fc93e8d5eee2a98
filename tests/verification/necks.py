"""The paper's neck as a model, a family around it, and controllers on it."""

from __future__ import annotations

import math

import control
import numpy as np

from softneck.core import Vector
from softneck.design import LinearController, PiSettings
from softneck.estimation import LinearNeck
from softneck.identification import Draws, Family
from softneck.identification.structured._play import Play
from softneck.identification.structured._play_draws import PlayDraws
from softneck.identification.uncertainty._draws import SEARCH_DRAWS
from softneck.identification.uncertainty._family import AxisFamily

from ..data import neck_recording
from ..oracles.bake_off import exact

TS = 0.02
PAPER = np.array([math.radians(27.69) / 5.293, 5.293, 0.08])  # Eq. 31
QUICK = {
    "sampling": {"plants": 40, "search_generations": 3},
    "sim": {"necks": 1, "payloads_kg": [0.0], "orientations_deg": [0.0], "duration_s": 2.5, "decides": True},
}


def linear_neck(*, delay: int = 4, gain: float = 1.0) -> LinearNeck:
    """The paper's pitch for both axes."""
    a = math.exp(-PAPER[1] * TS)
    axis = control.TransferFunction([gain * PAPER[0] * (1.0 - a)], [1.0, -a, *([0.0] * delay)], TS)
    return LinearNeck(pitch=axis, roll=axis)


def family(*, spread: float = 0.15, cross: float = 0.0, std: float = 0.02, count: int = 6, seed: int = 0) -> Family:
    """Samples around the paper's neck, with their uncertainty."""
    rng = np.random.default_rng(seed)

    def axis() -> AxisFamily:
        samples = PAPER * (1.0 + spread * rng.uniform(-1.0, 1.0, (count, 3)))
        box = np.array([samples.min(axis=0), samples.max(axis=0)])
        return AxisFamily(
            samples=samples, std=np.tile([*(std * PAPER), std], (count, 1)), where=np.zeros((count, 5)),
            used=np.ones(count), nominal=PAPER.copy(), box=box, weight=np.array([[1.0], [1.0]]), envelope=np.ones(5),
        )  # fmt: skip

    K = PAPER[0]
    gains = np.array([[K, cross * K, 0.0], [-cross * K, K, 0.0]])
    return Family(
        sample_time=TS, axes={"pitch": axis(), "roll": axis()}, frequency=np.geomspace(0.1, 150.0, 5), cross=gains,
        cross_std=np.zeros((2, 3)), compression=np.full(3, np.nan),
    )  # fmt: skip


def pi(*, order: str = "sequential", delay: int = 4) -> LinearController:
    """A PI on the paper's neck."""
    return PiSettings(order=order).design(exact(linear_neck(delay=delay)))


def controller_of(numerator: Vector, denominator: Vector) -> control.StateSpace:
    """`u = -C(z) y` on both axes, references into nothing, with the names that a linear form has."""
    own = control.ss(control.TransferFunction(-np.asarray(numerator), np.asarray(denominator), TS))
    both = control.append(own, own)
    n = both.A.shape[0]
    return control.StateSpace(
        both.A, np.hstack([np.zeros((n, 2)), both.B]), both.C, np.hstack([np.zeros((2, 2)), both.D]), TS,
        inputs=["pitch_reference", "roll_reference", "pitch", "roll"], outputs=["theta_i", "phi_i"],
    )  # fmt: skip


# Draws of one certificate, where 59 would take a minute.
COUNT = 4


def small_draws() -> Draws:
    """Draws of a linear neck: what they are drawn from is tested elsewhere."""
    source = PlayDraws.fit(neck_recording(2000, seed=3), settings=Play(rate=6.0, order=5, widths=(), degree=1))
    rng = np.random.default_rng(0)
    rows = [source.arrays(source.draw(rng), 1.0) for _ in range(SEARCH_DRAWS + 4 * COUNT)]
    return Draws(
        model=source.model, arrays={"weights": np.array([row["weights"] for row in rows])}, count=COUNT, seed=0,
        factor=1.0, share=np.full(2, 0.01), keep=0.9, noise=np.zeros(2), level=0.95, coverage=[],
        conditions={"payload_kg": [0.0, 0.0], "cocontraction": [0.0, 0.0], "motion": [0.3, 0.3]},
    )  # fmt: skip
