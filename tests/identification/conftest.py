"""The paper's experiment, which several kinds of model are judged on."""

from __future__ import annotations

import pytest

from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal


@pytest.fixture(scope="session")
def recordings() -> dict[str, Recording]:
    """The paper's experiment on preset `paper`, seeds as in the demo."""
    neck = VirtualNeck(NeckParameters.paper())
    made = {n: record(signal(n), neck, seed=s) for s, n in enumerate(("eq22", "steps", "sine", "rotation"), start=1)}
    made["train"], made["validation"] = made.pop("eq22").split(0.7)
    return made
