"""A model inside the file of what is made over it: a controller, an observer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ._model import Model


def nested(model: Model) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return what the header says of a model, and its arrays by the names that they have in such a file."""
    header = {
        "kind": model.kind, "sample_time": model.sample_time, "arrays": list(model.arrays),
        "settings": dict(model.settings), "findings": dict(model.findings), **model.robot.in_header(),
    }  # fmt: skip
    arrays = {f"model_{name}": array for name, array in model.arrays.items()}
    return header, {**arrays, "model_training_rows": model.training_rows}


def nested_model(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Model:
    """Return the model of which the file's header says `header`."""
    names = [*header["arrays"], "training_rows"]
    return Model.from_archive(dict(header), {name: arrays[f"model_{name}"] for name in names})
