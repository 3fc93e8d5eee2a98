"""Numbers from data are kept where they are better on rows held out, and what tells the sensor's delay is said."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.core import load
from softneck.estimation import KalmanObserver, KalmanSettings, _observer
from softneck.estimation._observer import (
    _estimate_lag,
    _unexplained_share,
    estimate_sensor_delay,
    fit_levels_and_delays,
    most_likely_extra_delay,
    with_extra_delay,
)

from .necks import IN_TIME, TS, neck, recording, smooth_motion

pytestmark = pytest.mark.usefixtures("plain_steps_of_blocks")


def observer_of(settings: KalmanSettings = IN_TIME, *, pitch_delay: int = 4, roll_delay: int = 2) -> KalmanObserver:
    return settings.design(neck(pitch_delay=pitch_delay, roll_delay=roll_delay))


@pytest.mark.slow
def test_a_dead_time_that_the_model_lacks_is_found_by_likelihood() -> None:
    record = recording(rows=800)
    assert most_likely_extra_delay(observer_of(), [record]) == 0
    assert most_likely_extra_delay(observer_of(pitch_delay=2, roll_delay=0), [record]) == 2


def test_what_was_fitted_is_kept_only_where_it_is_better() -> None:
    """A model that lacks two samples of dead time: noise alone mends little of it, the delay nearly all."""
    record = recording(rows=1200)
    wrong = observer_of(pitch_delay=2, roll_delay=0)
    found = fit_levels_and_delays(wrong, [record])
    assert found.checks[found.kept] == min(found.checks.values())
    assert found.kept == "noise and delay"
    assert isinstance(found.observer, KalmanObserver)
    assert found.observer.delays == (4, 2)
    # Nothing but the sensor's noise of 0.05 deg is left, of some 140 angles known to 6 %; by default a third more.
    assert found.checks["noise and delay"] == pytest.approx(math.radians(0.05), rel=0.2)
    assert found.checks["default"] > 1.2 * found.checks["noise and delay"]
    assert "sensor_delay" in found.not_identifiable


def test_levels_that_are_right_are_not_made_worse() -> None:
    true = (math.radians(0.05), math.radians(1e-3), math.radians(1e-3))
    right = observer_of().with_noise(true)
    found = fit_levels_and_delays(right, [recording(rows=700)])
    assert found.checks[found.kept] <= found.checks["default"]


def test_a_gyro_tells_how_late_the_angles_are() -> None:
    record = smooth_motion(noise_deg=0.02)
    late = {axis: np.interp(record.time - 0.035, record.time, record.channels[axis]) for axis in ("pitch", "roll")}
    record = record.with_channels(**{f"{axis}_measured": angle for axis, angle in late.items()})
    # A quarter of a sample is the grid; what the gyro itself is late comes on top.
    for gyro, sensor in ((0.0, 0.0), (0.0, 0.02), (0.05, 0.05)):
        settings = replace(IN_TIME, form="gyro", gyro_delay=gyro, sensor_delay=sensor)
        told, source = estimate_sensor_delay(settings.design(neck(sample_time=0.01)), [record])
        assert source == "gyro"
        assert told == pytest.approx(gyro + 0.035, abs=0.0026)
    assert estimate_sensor_delay(IN_TIME.design(neck(sample_time=0.01)), [record]) == (None, "")


def test_the_gyro_form_is_put_right_by_its_rates() -> None:
    record = smooth_motion(noise_deg=0.02)
    late = {axis: np.interp(record.time - 0.03, record.time, record.channels[axis]) for axis in ("pitch", "roll")}
    record = record.with_channels(**{f"{axis}_measured": angle for axis, angle in late.items()})
    observer = replace(IN_TIME, form="gyro").design(neck(sample_time=0.01))
    found = fit_levels_and_delays(observer, [record])
    assert (found.kept, found.observer.delay_source) == ("noise and delay", "gyro")
    errors = [np.abs(item.estimate(record).pitch - record.channels["pitch"])[500:].max() for item in
              (observer, found.observer)]  # fmt: skip
    # 0.9 rad/s for 0.03 s is 1.5 deg; a sample's rate is exact to half a sample of its change.
    assert errors[0] > math.radians(1.2)
    assert errors[1] < math.radians(0.2)


def test_rates_of_the_same_sensor_are_as_late_as_its_angles() -> None:
    """Between two measurements act the rates of the same time."""
    observer = KalmanSettings(form="gyro").design(neck())
    assert observer.lead == 0.0
    assert observer.constants[:2] == pytest.approx([0.5, 0.5])
    apart = KalmanSettings(form="gyro", sensor_delay=0.05).design(neck())
    assert apart.constants[:2] == pytest.approx([3.0, 3.0])


def test_motor_positions_tell_the_most_that_it_can_be() -> None:
    record, observer = recording(rows=800), observer_of(replace(IN_TIME, sensor_delay=0.1))
    angles = record.set_points @ observer.directions.T
    moved = {f"motor_position_{j + 1}": record.set_points[:, j] for j in range(3)}
    for i, axis in enumerate(("pitch", "roll")):
        # An angle that stands in proportion to the motors, 3 samples ago.
        moved[f"{axis}_measured"] = 0.08 * np.concatenate([np.full(3, angles[0, i]), angles[:-3, i]])
    told, source = estimate_sensor_delay(observer, [record.with_channels(**moved)])
    assert (told, source) == (pytest.approx(3 * TS), "motor positions")
    # The link lags as well: where the filter thinks of less, they tell nothing.
    assert estimate_sensor_delay(observer_of(), [record.with_channels(**moved)]) == (None, "")
    assert estimate_sensor_delay(observer, [record]) == (None, "")


def test_the_summary_says_where_the_delay_comes_from() -> None:
    assert "late by" not in observer_of(KalmanSettings()).summary()
    assert "late by 30 ms (as given)" in observer_of(KalmanSettings(sensor_delay=0.03)).summary()


def test_only_dead_time_is_later() -> None:
    later = with_extra_delay(observer_of(), 2)
    assert isinstance(later, KalmanObserver)
    assert later.delays == (6, 4)
    assert later.lead == observer_of().lead


def test_the_file_keeps_where_the_delay_comes_from(tmp_path: Path) -> None:
    observer = replace(observer_of(KalmanSettings(sensor_delay=0.03)), delay_source="gyro")
    observer.save(tmp_path / "o.npz")
    again = load(tmp_path / "o.npz", role="observer")
    assert (again.delay_source, again.summary()) == ("gyro", observer.summary())


def test_a_lag_is_that_of_all_outputs_and_none_at_the_end_of_the_search() -> None:
    rng = np.random.default_rng(0)
    way = np.cumsum(rng.standard_normal((500, 2)), axis=0)

    def late(samples: int) -> np.ndarray:
        return np.vstack([np.repeat(way[:1], samples, axis=0), way])[: len(way)]

    assert _estimate_lag([(late(3), way)], TS) == pytest.approx(3 * TS)
    # The longest of the search, 0.2 s, may be longer still.
    assert _estimate_lag([(late(9), way)], TS) == pytest.approx(9 * TS)
    assert _estimate_lag([(late(10), way)], TS) is None
    for axis in (0, 1):
        z = late(3)
        z[:, axis] = np.cumsum(rng.standard_normal(500))
        assert _unexplained_share([(z, way)], 3.0) > 0.2
        assert _estimate_lag([(z, way)], TS) is None


@pytest.mark.parametrize("named", [[], ["sensor"], ["sensor_delay"], ["sensor", "sensor_delay"]])
@pytest.mark.parametrize("data", [None, "one", ["one", "two"], ("one", "two")])
def test_an_observer_is_fitted_only_to_data_and_never_in_what_is_named(
    data: Any, named: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = SimpleNamespace(noise_names=("measurement", "model", "bias"))
    asked: list[Any] = []
    monkeypatch.setattr(_observer, "make_settings", lambda _, settings: settings)
    monkeypatch.setattr(_observer, "design_observer", lambda *_: made)
    monkeypatch.setattr(_observer, "open_recording", lambda part, robot: (part, robot))
    monkeypatch.setattr(
        _observer,
        "fit_levels_and_delays",
        lambda *given, **how: asked.append((given, how)) or SimpleNamespace(observer=1),
    )
    found = _observer.observer("model", data=data, robot="robot", **dict.fromkeys(named, 0))  # pyright: ignore[reportArgumentType]
    if data is None:
        assert found is made
        assert asked == []
        return
    assert found == 1
    rows = [(part, "robot") for part in ([data] if isinstance(data, str) else data)]
    fixed = ("measurement",) if "sensor" in named else ()
    assert asked == [((made, rows), {"fixed": fixed, "delay": "sensor_delay" not in named})]


@pytest.mark.parametrize("given", [None, 0.0, 0.06])
@pytest.mark.parametrize("form", ["model", "gyro"])
@pytest.mark.parametrize("bends", [True, False])
@pytest.mark.parametrize("sensor", [None, 0.0, 0.04])
def test_a_linear_filter_predicts_over_the_delay_of_the_sensor_else_of_the_robot_and_says_whose_it_is(
    given: float | None, form: str, bends: bool, sensor: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    @dataclass(frozen=True)
    class Made:
        delay: float | None
        delay_source: str = ""

    @dataclass(frozen=True)
    class Settings:
        sensor_delay: float | None
        form: str
        sensor: str = "usual"

        def design(self, known: Any) -> Made:
            assert known == "known"
            return Made(self.sensor_delay)

    monkeypatch.setattr(_observer, "load_for_robot", lambda *_: "known")
    monkeypatch.setattr(_observer, "is_nonlinear", lambda _: bends)
    monkeypatch.setattr(_observer, "find_sensor", lambda _: SimpleNamespace(delay=sensor))
    monkeypatch.setattr(_observer, "robot_of", lambda _: SimpleNamespace(delay_s=0.1))
    settings: Any = Settings(given, form)
    found = _observer.design_observer(settings, "model", None)
    if given is not None or form == "gyro" or bends:
        assert found == Made(given)
    elif sensor is None:
        assert found == Made(0.1, "robot")
    else:
        assert found == Made(sensor, "sensor" if sensor else "")
