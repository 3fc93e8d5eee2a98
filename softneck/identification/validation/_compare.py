"""Several models on several data sets, as MATLAB's `compare`: one table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from softneck.core import DataError, Progress, SettingsError, silent
from softneck.core._shown import Shown
from softneck.signals import Recording

from ..models._model import Model
from ._baselines import Baselines
from ._validation import Rules, Validation, judge, judged_parts

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison(Shown):
    """The scores of every model on every recording.

    Attributes:
        validations: model by model, each on all recordings.
    """

    validations: tuple[Validation, ...]

    def frame(self) -> pd.DataFrame:
        """Return one row for each model, data set, horizon and axis, ready to pivot.

        Columns: model, data, horizon, axis, fit, low, high (95 % interval), persistence, best_linear [%],
        rmse_deg, worst_deg, worst_time_s, r2, rows_scored, diverged_s; NaN where there is none.
        """
        import pandas as pd

        rows = [row for v in self.validations for row in _rows(v)]
        return pd.DataFrame(rows).astype(dict.fromkeys(_NUMBERS, float))

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON of the public face."""
        return {"models": [validation.as_dict() for validation in self.validations]}


_NUMBERS = (
    "fit", "low", "high", "persistence", "best_linear", "rmse_deg", "worst_deg", "worst_time_s", "r2",
    "diverged_s",
)  # fmt: skip


def compare(
    models: Mapping[str, Model] | Sequence[Model],
    recordings: Mapping[str, Recording] | Sequence[Recording],
    *,
    rules: Rules | None = None,
    progress: Progress = silent,
) -> Comparison:
    """Judge every model on every recording, each on the rows it was not trained on.

    Args:
        models: by name; without names they are called by their kind.
        recordings: by name; without names "data 1", "data 2", ...
        rules: horizons, motors, include_training, tolerance (see `validate`).
        progress: called with the part done and a word on it.

    Raises:
        SettingsError: no model or no recording.
        DataError: as `validate`.
    """
    rules = Rules() if rules is None else rules
    named_models = _named(models, [m.kind for m in models] if not isinstance(models, Mapping) else [])
    named_data = _named(recordings, [f"data {i + 1}" for i in range(len(recordings))])
    if not named_models or not named_data:
        raise SettingsError("`compare` needs at least one model and one recording.")
    known: dict[str, dict[bytes, Baselines]] = {name: {} for name, _ in named_data}
    results: list[Validation] = []
    for model_name, model in named_models:
        for data_name, recording in named_data:
            progress(len(results) / (len(named_models) * len(named_data)), f"{model_name} on {data_name}")
            try:
                parts = judged_parts(model, recording, rules, known[data_name])
                results.append(judge(model, parts, rules, names=(model_name, data_name)))
            except DataError as error:
                raise DataError(f"{model_name} on {data_name}: {error}") from error
    return Comparison(tuple(results))


def _named(things: Mapping[str, Any] | Sequence[Any], names: list[str]) -> list[tuple[str, Any]]:
    if isinstance(things, Mapping):
        return list(things.items())
    # Two of a kind are told apart by their number.
    return [
        (name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}", thing)
        for i, (name, thing) in enumerate(zip(names, things, strict=True))
    ]


def _rows(v: Validation) -> list[dict[str, Any]]:
    rows = []
    for horizon, fits in v.fits.items():
        for axis, fit in fits.items():
            low, high = v.intervals[horizon][axis] or (None, None)
            rows.append(
                {
                    "model": v.model,
                    "data": v.data,
                    "horizon": horizon,
                    "axis": axis,
                    "fit": fit,
                    "low": low,
                    "high": high,
                    "persistence": v.persistence.get(horizon, {}).get(axis),
                    "best_linear": v.best_linear[horizon][axis],
                    "rmse_deg": v.rmse_deg[horizon][axis],
                    "worst_deg": v.worst_deg[horizon][axis],
                    "worst_time_s": v.worst_time[horizon][axis],
                    "r2": v.r2[horizon][axis],
                    "rows_scored": v.rows_scored,
                    "diverged_s": v.diverged if horizon == "inf" else None,
                }
            )
    return rows
