"""A model of any robot is read back from its file as it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import softneck
from softneck.core import silent

from .worlds import PLANTS, world


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("kind", ["rls", "oe", "nlsm", "play"])
def test_a_model_is_read_back_as_it_was(name: str, kind: str, tmp_path: Path) -> None:
    seen = world(name)
    model = softneck.identify(kind, seen.recording, train=1.0, progress=silent)
    model.save(tmp_path / "m.npz")
    again = softneck.load(tmp_path / "m.npz")
    np.testing.assert_array_equal(again.simulate(seen.recording), model.simulate(seen.recording))
