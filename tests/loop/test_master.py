"""Further parts, connections, algebraic loops, callbacks, pacing, and a state that resumes."""

from __future__ import annotations

import numpy as np
import pytest

from softneck.core import DataError, SettingsError
from softneck.loop import Loop, run_loop
from softneck.loop._run import LoopStep
from softneck.runtime import Port

from ..references import StepReference
from ._parts import FunctionPart, lag_plant, p_controller, ports

STEP = StepReference(pitch=0.2, roll=-0.1, at=0.1)


def halving_filter(name: str = "pitch_reference") -> FunctionPart:
    return FunctionPart("controller", ports(name), ports("half"), lambda _, u: [0.5 * float(u[0])])


def loop_with(**changes: object) -> Loop:
    fields: dict[str, object] = {
        "plant": lag_plant(), "controller": p_controller(), "reference": STEP, "duration": 1.0
    }  # fmt: skip
    return Loop(**{**fields, **changes})  # pyright: ignore[reportArgumentType]


def test_a_further_part_between_reference_and_controller_acts_in_the_same_sample() -> None:
    filtered = run_loop(
        loop_with(others={"filter": halving_filter()}, connections={"controller.pitch_reference": "filter.half"})
    )
    plain = run_loop(loop_with(reference=StepReference(pitch=0.1, roll=-0.1, at=0.1)))
    np.testing.assert_array_equal(filtered["pitch"], plain["pitch"])
    np.testing.assert_array_equal(filtered["half"], plain["pitch_reference"])


def test_the_order_of_the_names_does_not_matter() -> None:
    first, second = (
        halving_filter(),
        FunctionPart("controller", ports("half"), ports("quarter"), lambda _, u: [u[0] / 2]),
    )
    connections = {"controller.pitch_reference": "second.quarter"}
    runs = [
        run_loop(loop_with(others=others, connections=connections))
        for others in ({"first": first, "second": second}, {"second": second, "first": first})
    ]
    np.testing.assert_array_equal(runs[0]["pitch"], runs[1]["pitch"])
    assert runs[0]["quarter"][5] == 0.05


def test_a_reference_that_is_a_part_is_valid_one_sample_after_its_step() -> None:
    def advance(state: list[float], u: np.ndarray) -> list[float]:
        state.append(0.0)
        return list(STEP(len(state) * 0.02)[:2])

    part = FunctionPart("reference", (), ports("pitch_reference", "roll_reference"), advance)
    for order in ("sequential", "jacobi"):
        plain, parts = run_loop(loop_with(order=order)), run_loop(loop_with(order=order, reference=part))
        np.testing.assert_array_equal(parts["pitch"], plain["pitch"])
        np.testing.assert_array_equal(parts["pitch_reference"], plain["pitch_reference"])


def test_an_algebraic_loop_is_refused_by_name_and_runs_as_jacobi() -> None:
    a = FunctionPart("controller", ports("from_b"), ports("from_a"), lambda _, u: [0.5 * float(u[0])])
    b = FunctionPart("controller", ports("from_a"), ports("from_b"), lambda _, u: [float(u[0]) + 1.0])
    loop = loop_with(others={"a": a, "b": b})
    with pytest.raises(
        SettingsError, match=r"algebraic loop: (a -> b `from_a`, b -> a `from_b`|b -> a .*, a -> b .*)\. "
    ):
        run_loop(loop)
    result = run_loop(loop_with(others={"a": a, "b": b}, order="jacobi"))
    assert result["from_b"][:4].tolist() == [0.0, 1.0, 1.0, 1.5]


def test_two_parts_that_offer_the_same_output_are_two_writers() -> None:
    reader = FunctionPart("controller", ports("half"), ports("seen"), lambda _, u: [float(u[0])])
    others = {"one": halving_filter(), "two": halving_filter("roll_reference"), "reader": reader}
    with pytest.raises(SettingsError, match=r"input `half` of the reader has 2 writers: one, two; choose one in"):
        run_loop(loop_with(others=others))
    result = run_loop(loop_with(others=others, connections={"reader.half": "two.half"}))
    assert result["seen"][10] == -0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"connections": {"controller.speed": "plant.pitch"}}, "`controller.speed`: there is no such input; the contr"),
        (
            {"connections": {"controller.pitch": "plant.yaw"}},
            "`plant.yaw`: there is no such output; the plant has pitch",
        ),
        ({"connections": {"controller.pitch": "wheel.yaw"}}, "the parts are plant, controller"),
        ({"connections": {"pitch": "plant.yaw"}}, "written part.variable; got `pitch`"),
        (
            {"connections": {"controller.pitch": "plant.roll"}, "other_inputs": {"controller": {"pitch": 0.0}}},
            "input `pitch` of the controller has two writers: `plant.roll` and a constant",
        ),
        ({"other_inputs": {"controller": {"speed": 0.0}}}, "`speed` is not an input of the controller"),
        (
            {"others": {"filter": FunctionPart("controller", ports("fog"), (), lambda *_: [])}},
            "nothing feeds input `fog` of the",
        ),
        ({"others": {"plant": halving_filter()}}, "`plant` cannot be the name of a further part"),
    ],
)
def test_wrong_connections_are_one_clear_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        run_loop(loop_with(**changes))


def test_a_callback_sees_every_row_and_may_stop() -> None:
    seen: list[float] = []

    def watch(step: LoopStep) -> bool:
        seen.append(step["pitch"])
        with pytest.raises(DataError, match="no signal `yaw`; it has pitch"):
            step["yaw"]
        return step.time >= 0.3 - 1e-9

    result = run_loop(loop_with(), on_step=watch)
    assert result.time.size == 16
    np.testing.assert_array_equal(result["pitch"], seen)
    np.testing.assert_array_equal(result["pitch"], run_loop(loop_with())["pitch"][:16])


def test_pacing_waits_for_each_row(monkeypatch: pytest.MonkeyPatch) -> None:
    now, naps = [100.0], []

    def sleep(seconds: float) -> None:
        naps.append(seconds)
        now[0] += seconds

    monkeypatch.setattr("softneck.loop._run.clock.sleep", sleep)
    monkeypatch.setattr("softneck.loop._run.clock.perf_counter", lambda: now[0])
    run_loop(loop_with(), pace=2.0)
    # Half the simulated second, in rows of 10 ms.
    assert sum(naps) == pytest.approx(0.5, abs=1e-9)
    assert len(naps) == 50
    with pytest.raises(SettingsError, match="`pace` must be positive"):
        run_loop(loop_with(), pace=0.0)


def test_ports_with_units_of_the_same_kind_connect_and_others_do_not() -> None:
    speed = FunctionPart("controller", (Port(name="pitch_reference", unit="m"),), ports("half"), lambda *_: [0.0])
    with pytest.raises(SettingsError, match=r"is in \[rad\] but `pitch_reference` of the filter in \[m\]"):
        run_loop(loop_with(others={"filter": speed}))
