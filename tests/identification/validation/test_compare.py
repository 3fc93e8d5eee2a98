"""`compare`: the same numbers as one validation each, in one table."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.identification import Model, Rules, compare, validate

from ...data import neck_recording

DATA = {"short": neck_recording(300, seed=21, noise=1e-3), "long": neck_recording(1300, seed=22, noise=1e-3)}


@pytest.mark.slow
def test_every_pair_is_as_validated_alone(models: dict[str, Model]) -> None:
    chosen = {name: models[name] for name in ("rls", "nn")}
    told: list[float] = []
    result = compare(chosen, DATA, progress=lambda done, _: told.append(done))
    pairs = [(m, d) for m in chosen for d in DATA]
    assert [(v.model, v.data) for v in result.validations] == pairs
    assert told == [0, 0.25, 0.5, 0.75]
    alone = [validate(chosen[m], DATA[d], names=(m, d)).as_dict() for m, d in pairs]
    # NaN is not equal to itself; there is none here.
    assert result.as_dict() == {"models": alone}


def test_the_frame_has_a_row_for_each_horizon_and_axis(models: dict[str, Model]) -> None:
    result = compare({"a": models["rls"], "b": models["nn"]}, DATA, rules=Rules(horizons=(1, "inf")))
    frame = result.frame()
    assert len(frame) == 2 * 2 * 2 * 2
    row = frame.set_index(["model", "data", "horizon", "axis"]).loc[("b", "long", "inf", "roll")]
    v = result.validations[3]
    assert row["fit"] == v.fits["inf"]["roll"]
    assert [row["low"], row["high"]] == v.intervals["inf"]["roll"]
    assert row["best_linear"] == v.best_linear["inf"]["roll"]
    assert np.isnan(row["persistence"])
    fits = frame.pivot_table(index="model", columns=["data", "horizon", "axis"], values="fit")
    assert fits.loc["a", ("short", "1", "pitch")] == result.validations[0].fits["1"]["pitch"]


def test_what_has_no_name_is_called_by_its_kind_and_number(models: dict[str, Model]) -> None:
    rls, nn = models["rls"], models["nn"]
    result = compare([rls, nn, rls], list(DATA.values()), rules=Rules(horizons=(1,)))
    assert [v.model for v in result.validations] == ["rls 1", "rls 1", "nn", "nn", "rls 2", "rls 2"]
    assert [v.data for v in result.validations[:2]] == ["data 1", "data 2"]


def test_nothing_to_compare_is_said(models: dict[str, Model]) -> None:
    with pytest.raises(SettingsError, match="at least one model and one recording"):
        compare([], DATA)
    with pytest.raises(SettingsError, match="`motors` must be one of simulated, measured"):
        Rules(motors="felt")
    with pytest.raises(DataError, match="a horizon is a number of samples from 1, or `inf`; got 0"):
        compare([models["rls"]], DATA, rules=Rules(horizons=(0,)))
