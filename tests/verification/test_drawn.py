"""Certificates by loops over draws: one bad draw fails them, attempts are counted, and the linear test is shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from softneck.cli._verify import _attempt_of, _attempt_of_tune, _tried
from softneck.core import DataError, certificate_contents, write_certificate
from softneck.identification import Draws, Family
from softneck.identification.uncertainty import _draws
from softneck.loop import LoopResult
from softneck.robot import Robot
from softneck.verification import Requirement, _drawn, make_requirements, verify
from softneck.verification._drawn import (
    Drawn,
    _Margin,
    certified_content,
    draws_of,
    oscillating_share,
    run_drawn,
    run_steps_on_draws,
)
from softneck.verification._experiments import Experiment, LoopUnderTest, bisect, crossing_values, crossings
from softneck.verification._neck_loops import loops_under_test, make_simulation_model, rows_of

from .necks import COUNT, QUICK, TS, family, pi, small_draws

ASKED = {**QUICK, "sim": {**QUICK["sim"], "size_deg": 10.0}}


@pytest.fixture(scope="module")
def drawn() -> Draws:
    return small_draws()


def with_draws(draws: Draws, bad: int | None = None) -> Family:
    """The family with these draws; of the first certificate's the one of number `bad` has five times the gain."""
    if bad is not None:
        weights = draws.arrays["weights"].copy()
        weights[_draws.SEARCH_DRAWS + bad] *= 5.0
        draws = replace(draws, arrays={"weights": weights})
    return replace(family(spread=0.6), draws=draws)


@pytest.mark.parametrize(("share", "least"), [(0.95, 59), (0.99, 299)])
def test_as_many_draws_as_wilks_asks_for_are_needed(share: float, least: int) -> None:
    assert certified_content(least) >= share > certified_content(least - 1)
    # Each attempt has its part of the 5 %: the second says less than the first, by the same draws.
    assert certified_content(least, 2) < share


@pytest.mark.slow
def test_draws_decide_and_the_linear_test_is_shown_beside(drawn: Draws) -> None:
    found = verify(pi(), {"family": with_draws(drawn)}, make_requirements(ASKED))
    verdicts = {v.requirement.metric: v for v in found.verdicts}
    for name in ("axes.gain_margin", "axes.delay_margin_ms", "sim.overshoot_pct", "sim.load_rms_deg"):
        assert verdicts[name].worst["kind"] == "draw"
    assert verdicts["sim.load_rms_deg"].requirement.limit == verdicts["step.load_rms_deg"].requirement.limit
    beside = [v for v in found.verdicts if v.requirement.metric.startswith(("stability", "robust", "step", "mimo"))]
    for verdict in beside:  # a linear test that fails decides nothing
        assert verdict.value is not None
        assert verdict.holds is (True if verdict.requirement.holds(verdict.value) else None)
        assert ("the draws of the family decide" in verdict.note) is (verdict.holds is None)
    assert {verdict.holds for verdict in beside} == {True, None}
    [part] = found.evidence.drawn
    assert part.count == COUNT
    assert found.contents()["draws"][0]["content"] == certified_content(COUNT)
    # Stated requirements count, whatever decides.
    stated = {**ASKED, "require": {"axes.sensitivity": {"max": 1.01}}}
    assert [v.requirement.metric for v in verify(pi(), {"family": with_draws(drawn)}, stated).failed] == [
        "axes.sensitivity"
    ]


@pytest.mark.slow
def test_one_draw_that_fails_fails_the_certificate_and_another_attempt_has_others(drawn: Draws) -> None:
    plants = {"family": with_draws(drawn, bad=2)}
    found = verify(pi(), plants, make_requirements(ASKED))
    [part] = found.evidence.drawn
    assert part.failed == (2,)
    assert part.content == 0.0
    assert not found.holds
    assert f"1 of {COUNT} draws of family fail" in found.summary()
    again = verify(pi(), plants, make_requirements(ASKED), attempt=2)
    assert again.holds
    assert again.evidence.drawn[0].content == certified_content(COUNT, 2)


@pytest.mark.slow
def test_the_margin_of_equal_draws_is_that_by_the_scan_of_one(drawn: Draws) -> None:
    count = _draws.SEARCH_DRAWS + 2 * COUNT
    same = replace(drawn, arrays={"weights": np.repeat(drawn.arrays["weights"][:1], count, axis=0)})
    asked = make_requirements(ASKED)
    [part] = verify(pi(), {"family": with_draws(same)}, asked).evidence.drawn
    one = make_simulation_model(same.for_search(1)[0], "one", asked.robot)
    loops = loops_under_test(pi().block(), [one], asked, order="sequential", observer=None)
    scanned = crossing_values(crossings(loops))
    # Both bisect to half a percent, at their own steps and postures; a linear plant has one margin at all of them.
    for name in ("axes.gain_margin", "axes.delay_margin_ms"):
        assert part.values[name].min() == pytest.approx(scanned[name][0].min(), rel=0.03)


@pytest.mark.slow
def test_steps_larger_than_any_recorded_motion_are_refused(drawn: Draws) -> None:
    small = replace(drawn, conditions={**drawn.conditions, "motion": [0.08, 0.09]})
    found = verify(pi(), {"family": with_draws(small)}, make_requirements(ASKED))
    notes = {v.requirement.metric: v.note for v in found.failed}
    assert "steps of 10 deg, the recordings move 4.58 deg; record larger motions" in notes["sim.overshoot_pct"]


def test_some_draws_step_as_they_do_among_all_and_oscillate_beyond_their_margin(drawn: Draws) -> None:
    asked = make_requirements(ASKED)
    count = _draws.SEARCH_DRAWS + COUNT
    weights = np.repeat(drawn.arrays["weights"][:1], count, axis=0)
    weights[1] *= 2.0
    draws = replace(drawn, arrays={"weights": weights})
    where: Any = {"order": "sequential", "observer": None}
    some = run_steps_on_draws("f", draws, pi().block(), asked, numbers=(1, 0), **where)
    task = _drawn._task_of("f", draws, pi().block(), asked, "sequential", None, 0)
    for k, number in enumerate((1, 0)):
        alone = {name: max(value for value, _ in found) for name, found in _drawn._steps(task, number).items()}
        assert {name: values[k] for name, values in some.items()} == alone
    # A draw of twice the gain has half the margin.
    case = _drawn._margins(replace(task, limits={"axes.gain_margin": 1.5}, amplitudes=task.amplitudes[-1:]), 1)[0]
    experiment = replace(case.experiment, axes="both", what="gain_up")
    margin = bisect(experiment, 1.0, 8.0, case.floor)
    shares = [
        oscillating_share("f", draws, pi().block(), asked, numbers=(0, 1), gain=gain, **where)
        for gain in (0.9 * margin, 1.1 * margin)
    ]
    assert shares == [0.0, 0.5]


def test_attempts_over_a_family_are_counted_from_the_certificates_of_a_folder(tmp_path: Path) -> None:
    def attempt(controller: str, family: str, name: str) -> tuple[int, list[str]]:
        files = {"controller": (f"{name}.npz", controller), "plant 1": ("f.npz", family)}
        this, tried = _attempt_of(files), _tried(tmp_path, [family])
        earlier = tried[: tried.index(this)] if this in tried else tried
        kept = {"requirements": [], "attempts": {"plants": [family], "tried": [*earlier, this]}}
        path = tmp_path / f"{name}.certificate.json"
        write_certificate(path, certificate_contents("verify", holds=False, files=files, more=kept), force=True)
        return len(earlier) + 1, [*earlier, this]

    assert attempt("a" * 64, "f" * 64, "one")[0] == 1
    assert attempt("b" * 64, "f" * 64, "two")[0] == 2
    # The same controller again is the same attempt; another family begins anew.
    assert attempt("a" * 64, "f" * 64, "one")[0] == 1
    assert attempt("b" * 64, "e" * 64, "other")[0] == 1
    # A certificate that replaces the only file of an earlier attempt still tells of it.
    assert attempt("c" * 64, "f" * 64, "two")[0] == 3
    assert attempt("d" * 64, "f" * 64, "two")[0] == 4
    (tmp_path / "note.json").write_text("{}", encoding="utf-8")
    assert attempt("d" * 64, "f" * 64, "two")[0] == 4


def test_the_attempt_that_tune_certified_counts_for_its_controller(tmp_path: Path) -> None:
    said = {"requirements": [], "draws": [{"attempt": 1}, {"attempt": 3}]}
    files = {"controller": ("best.npz", "a" * 64)}
    write_certificate(
        tmp_path / "best.certificate.json", certificate_contents("verify", holds=True, files=files, more=said)
    )
    assert _attempt_of_tune(tmp_path / "best.npz") == 3
    assert _attempt_of_tune(tmp_path / "other.npz") == 1


# -- how draws are run and judged, without a loop ---------------------------------------------------------------------


def told_draws(**more: Any) -> Any:
    conditions = {"motion": [0.1, 0.4], "payload_kg": [0.0, 0.5], **more}
    return SimpleNamespace(seed=7, doubt="", model=SimpleNamespace(kind="play"), coverage=[1], level=0.9, keep=0.9,
                           conditions=conditions, share=np.array([0.01, 0.02]), noise=np.zeros(2))  # fmt: skip


def test_draws_say_how_many_hold_at_which_attempt() -> None:
    def drawn(failed: tuple[int, ...] = (), attempt: int = 1) -> Drawn:
        return Drawn("f", told_draws(), attempt, 59, {}, {}, failed)

    assert drawn().content == pytest.approx(0.05 ** (1 / 59), rel=1e-12)
    assert drawn(attempt=3).content == pytest.approx((0.05 / 3) ** (1 / 59), rel=1e-12)
    assert drawn().statement() == ("none of 59 draws of f fails: 95.0 % of such plants hold, with 95 % confidence")
    assert drawn(attempt=2).statement().endswith("(attempt 2, which is counted)")
    assert drawn((58,)).content == 0.0
    bad = drawn((1, 4))
    assert (bad.content, bad.statement()) == (0.0, "2 of 59 draws of f fail")
    doubted = replace(bad, draws=SimpleNamespace(doubt="they differ"))  # pyright: ignore[reportArgumentType]
    assert doubted.statement() == "2 of 59 draws of f fail; they differ, so they decide little"
    for item in (drawn(), bad):
        quiet = "; steps are judged without the sensor's noise, which would hide settling"
        assert replace(item, noisy=True).statement() == item.statement() + quiet
    assert bad.facts() == {
        "family": "f", "count": 59, "failed": [1, 4], "attempt": 1, "content": 0.0, "confidence": 0.95, "seed": 7,
        "kind": "play", "coverage": [1], "level": 0.9, "statement": "2 of 59 draws of f fail",
    }  # fmt: skip
    with_, without = SimpleNamespace(draws=5), SimpleNamespace(draws=None)
    assert draws_of({"a": without, "b": with_, "c": object()}) == {"b": 5}


def test_the_margin_of_a_draw_is_the_strictest_that_is_required() -> None:
    def required(**require: Any) -> dict[str, float]:
        free = {"axes.gain_margin": False, "axes.delay_margin_ms": False}
        return _drawn._required_margins(make_requirements({"require": free | require}))

    assert required() == {}
    assert required(**{"axes.gain_margin": {"min": 2.0, "max": 9.0}}) == {"axes.gain_margin": 2.0}
    assert required(**{"axes.gain_margin": {"max": 9.0}, "axes.delay_margin_ms": {"min": 40.0}}) == {
        "axes.delay_margin_ms": 40.0
    }
    asked = make_requirements({"require": {"axes.gain_margin": {"min": 2.0}}})
    for limits in ((3.0, 2.5), (2.5, 3.0)):
        more = tuple(Requirement("axes.gain_margin", "min", limit, True) for limit in limits)
        assert _drawn._required_margins(replace(asked, bounds=(*asked.bounds, *more)))["axes.gain_margin"] == 3.0


@pytest.mark.parametrize(
    ("motion", "steps"),
    [([0.1, 0.4], (0.02, math.sqrt(0.002), 0.1)), ([0.4, 0.1], (0.02, math.sqrt(0.002), 0.1)), ([0.01, 0.4], (0.01,)),
     ([1.0, 2.0], (0.02, math.sqrt(0.006), 0.3))],
)  # fmt: skip
def test_steps_of_margins_lie_within_the_recorded_motion(
    motion: list[float], steps: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_drawn, "_under_test", lambda *_: SimpleNamespace(kicks=(0.02, 0.3)))
    found = _drawn._amplitudes(told_draws(motion=motion), make_requirements({}))
    assert found == pytest.approx(steps, rel=1e-12)


def test_the_worst_draw_of_a_metric_is_that_of_its_attempt() -> None:
    draws = SimpleNamespace(for_certificate=lambda attempt: [f"attempt {attempt}, {k}" for k in range(3)])
    values = {"m": np.array([1.0, 3.0, 2.0, 3.0]), "n": np.array([1.0, math.nan, -math.inf, 0.0])}
    numbers = [{"draw": k} for k in (0, 2, 1, 0)]
    found = Drawn("f", draws, 4, 3, values, dict.fromkeys("mn", numbers), ())  # pyright: ignore[reportArgumentType]
    assert [found.worst("m", largest=True), found.worst("m", largest=False)] == [2, 0]
    assert found.model(2) == "attempt 4, 2"
    # A value that is no number is the worst of both.
    assert found.worst("n", largest=True) == found.worst("n", largest=False) == 2
    assert found.worst("k", largest=True) is None


@pytest.mark.parametrize(
    ("changes", "motion", "heavy", "told"),
    [
        ({"size_deg": 11.0}, 10.0, 0.5, ""), ({"size_deg": 11.01}, 10.0, 0.5, "steps of 11 deg, the recordings move"),
        ({"payloads_kg": [0.0, 0.5]}, 45.0, 0.5, ""), ({}, 45.0, 0.0, ""),
        ({"payloads_kg": [0.6, 0.0]}, 45.0, 0.5, "a payload of 0.6 kg, recorded up to 0.5 kg"),
        ({"size_deg": 11.01, "payloads_kg": [0.6]}, 10.0, 0.5, "--payload 0.6"),
    ],
)  # fmt: skip
def test_conditions_beyond_the_recordings_are_told(
    changes: dict[str, Any], motion: float, heavy: float, told: str
) -> None:
    draws = told_draws(motion=[math.radians(45.0), math.radians(motion)], payload_kg=[heavy, 0.0])
    found = _drawn._unreached(draws, make_requirements({"sim": changes}))
    assert set(found) == ({"sim"} if told else set())
    assert told in found.get("sim", "")
    # Of two conditions each is told.
    assert ("steps of 11 deg" in found.get("sim", "")) is (changes.get("size_deg") == 11.01)


def test_a_command_for_a_recording_is_told_of_robots_with_tendons_alone() -> None:
    """`softneck record` has a neck and its like; a valve in kPa it does not move."""
    valve = Robot.from_dict({
        "name": "valve", "motors": {"names": ["valve"], "unit": "kPa", "setpoint_min": 0.0, "setpoint_max": 100.0},
        "outputs": {"names": ["tip"], "unit": "mm", "min": [-10.0], "max": [10.0]},
        "directions": {"kind": "identified"},
    })  # fmt: skip
    for robot, known in ((Robot.preset(), True), (valve, False)):
        draws = told_draws(motion=[1e-6], payload_kg=[0.0])
        said = _drawn._unreached(draws, make_requirements({"sim": {"payloads_kg": [0.6]}}, robot=robot))["sim"]
        assert "record larger motions" in said
        assert "a payload of 0.6 kg" in said
        assert ("softneck record" in said) is known


def test_a_draw_carries_the_lightest_and_the_heaviest_payload() -> None:
    def payloads(*known: float) -> tuple[float, ...]:
        plant: Any = SimpleNamespace(payloads=lambda _: list(known))
        return _drawn._payloads(plant, make_requirements({}))

    assert payloads(0.3, 0.0, 1.0) == (0.0, 1.0)
    assert payloads(0.5) == (0.5,)


def result_of(**signals: Any) -> LoopResult:
    columns = {name: np.array(values, float) for name, values in signals.items()}
    return LoopResult(np.arange(len(next(iter(columns.values())))) * TS, columns, {}, TS)


def test_the_error_under_the_load_is_the_worse_output_s_from_the_load_on() -> None:
    asked = make_requirements({})
    for pitch, roll in (([9.0, 9.0, 0.1, 0.3], [9.0, 9.0, 0.5, 0.7]), ([0.0, 9.0, 0.5, 0.7], [0.0, 0.0, 0.1, 0.3])):
        result = result_of(pitch=pitch, roll=roll, pitch_reference=[0.0] * 4, roll_reference=[0.0] * 4)
        # rms of 0.5 and 0.7; sums are rounded.
        assert _drawn._load_rms(result, 2, asked) == pytest.approx(math.degrees(math.sqrt(0.37)), rel=1e-12)
    for names in (("pitch", "roll"), ("roll", "pitch")):
        one, other = names
        references = dict.fromkeys(("pitch_reference", "roll_reference"), [0.0] * 2)
        lost = result_of(**{one: [0.0, math.nan], other: [0.0, 0.0], **references})
        assert _drawn._load_rms(lost, 1, asked) == math.inf


def test_outputs_of_a_draw_are_those_that_its_sensor_tells() -> None:
    told = result_of(pitch=[0.0, 1.0, 2.0], roll=[0.0, 0.0, 0.0], pitch_measured_seen=[5.0, 6.0, 7.0],
                     roll_measured_seen=[1.0, 2.0, 3.0], pitch_measured_without_noise=[4.0, 4.0, 4.0],
                     roll_measured_without_noise=[3.0, 3.0, 3.0])  # fmt: skip
    found = _drawn._with_disturbance(told, "seen")
    assert (found["pitch"].tolist(), found["roll"].tolist()) == ([5.0, 6.0, 7.0], [1.0, 2.0, 3.0])
    quiet = _drawn._with_disturbance(told, "without_noise")
    assert (quiet["pitch"].tolist(), quiet["roll"].tolist()) == ([4.0] * 3, [3.0] * 3)
    rows = rows_of(found, 1, 3)
    assert (rows.time.tolist(), rows["roll"].tolist()) == ([TS, 2 * TS], [2.0, 3.0])


@pytest.mark.parametrize("angle", [0.0, 90.0])
@pytest.mark.parametrize("load", [0.0, -0.05])
@pytest.mark.parametrize(
    ("diverges", "sensed", "noise", "told", "other"),
    [
        (False, 0.1, 0.12, "seen", "without_noise"),
        (True, 0.1, 0.12, "seen", "without_noise"),
        # Four deviations are more than 5 % of the step.
        (False, 0.13, 0.13, "without_noise", "seen"),
    ],
)
def test_a_step_of_a_draw_has_its_disturbance_and_then_its_load(
    angle: float, load: float, diverges: bool, sensed: float, noise: float, told: str, other: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    asked = make_requirements(
        {"step": {"load_rad": load, "noise_deg": 0.12}, "sim": {"size_deg": 10.0, "duration_s": 2.5}}
    )
    loops = []

    def run(loop: Any, *, compiled: bool) -> LoopResult:
        loops.append(loop)
        if diverges:
            raise DataError("overflow")
        rows = round(loop.duration / TS)
        signals = {f"motor_setpoint_{j}": np.zeros(rows) for j in (1, 2, 3)}
        for name, size in zip(("pitch", "roll"), loop.reference.values, strict=True):
            signals[f"{name}_reference"] = np.where(np.arange(rows) * TS >= loop.reference.at, size, 0.0)
            signals[name] = np.full(rows, 9.0)
            signals[f"louder.{name}_measured_{told}"] = signals[f"{name}_reference"] + 0.01 * (np.arange(rows) >= 150)
            signals[f"louder.{name}_measured_{other}"] = np.full(rows, 8.0)
        return LoopResult(np.arange(rows) * TS, signals, {}, TS)

    monkeypatch.setattr(_drawn, "run_loop", run)
    monkeypatch.setattr(_drawn, "Loop", lambda **settings: SimpleNamespace(**settings))
    motors = np.array([[1.0, 0.0], [0.5, -1.0], [0.0, 2.0]])
    # The worse sensor's noise, if more than the 0.12 deg asked.
    draws = told_draws()
    draws.noise = np.radians([0.01, sensed])
    task: Any = SimpleNamespace(
        asked=asked, draws=draws, controller=pi().block(), observer=None, order="parallel", motors=motors
    )
    plant: Any = SimpleNamespace(quiet=lambda ts: ("quiet", ts), carrying=lambda kg: {"plant_inputs": {"payload": kg}})
    found = _drawn._step(task, plant, 4, 0.3, math.radians(angle))
    [loop] = loops
    assert loop.plant == ("quiet", TS)
    assert (loop.plant_inputs, loop.order) == ({"payload": 0.3}, "parallel")
    size = math.radians(10.0)
    assert loop.reference.values == pytest.approx((size, 0.0) if angle == 0.0 else (0.0, size), abs=1e-12)
    assert (loop.reference.at, loop.duration) == (0.5, 0.5 + 2.5 * (2 if load else 1))
    louder = loop.other_parameters["louder"]
    assert {key: louder[key] for key in ("share_pitch", "share_roll", "keep", "noise_seed")} == {
        "share_pitch": 0.01, "share_roll": 0.02, "keep": 0.9, "noise_seed": 4.0,
    }  # fmt: skip
    assert louder["noise"] == pytest.approx(math.radians(noise), rel=1e-12)
    # A load on the stepped axis, spread over the motors that move it, when the step has had its time.
    column = motors[:, 0 if angle == 0.0 else 1]
    expected = [(j + 1, load * share, 3.0) for j, share in enumerate(column) if share and load]
    assert [(fault.motor, fault.size, fault.start) for fault in loop.faults] == expected
    assert ("sim.load_rms_deg" in found) is bool(load)
    if diverges:
        assert all(value == math.inf for value in found.values())
        return
    # The error of 0.01 rad begins with the load, after row 150: the step alone has none.
    assert (found["sim.rise_s"], found["sim.steady_rms_deg"]) == (0.0, pytest.approx(0.0, abs=1e-12))
    if load:
        assert found["sim.load_rms_deg"] == pytest.approx(math.degrees(0.01), rel=1e-9)
    # The plant tells no tensions, so nothing is said of slack; no other metric vanishes where it is no number.
    names = ("overshoot_pct", "rise_s", "settling_s", "steady_rms_deg", "rms_error_deg", "max_rad", "slack_s")
    assert set(found) - {"sim.load_rms_deg"} == {f"sim.{name}" for name in names[:-1]}
    monkeypatch.setattr(_drawn, "step_metrics", lambda _: dict.fromkeys(names, math.nan))
    lost = _drawn._step(task, plant, 4, 0.3, math.radians(angle))
    assert lost.keys() == found.keys()
    assert math.isnan(lost["sim.rise_s"])


@pytest.mark.parametrize(
    ("payload", "outputs", "names"),
    [("inputs", 2, [", 0 kg, 0 deg", ", 0 kg, 45 deg", ", 0.5 kg, 0 deg", ", 0.5 kg, 45 deg"]),
     ("", 2, [", 0 deg", ", 45 deg"]), ("inputs", 1, [", 0 kg", ", 0.5 kg"]), ("", 1, [""])],
)  # fmt: skip
def test_every_payload_and_direction_of_a_draw_is_run_and_named(
    payload: str, outputs: int, names: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_drawn, "_step", lambda *args: {"m": args[3] + math.degrees(args[4])})
    robot = SimpleNamespace(outputs=SimpleNamespace(names=("pitch", "roll")[:outputs]))
    asked = SimpleNamespace(robot=robot, sim={"payloads_kg": [0.0, 0.5], "orientations_deg": [0.0, 45.0]})
    plant = SimpleNamespace(name="draw 2", payload=payload, payloads=lambda asked: asked if payload else [0.0])
    task: Any = SimpleNamespace(asked=asked, plants=[None, plant])
    found = _drawn._steps(task, 1)["m"]
    assert [name for _, name in found] == [f"draw 2{name}" for name in names]
    angles = [0.0, 45.0] if outputs > 1 else [0.0]
    expected = [kg + angle for kg in ([0.0, 0.5] if payload else [0.0]) for angle in angles]
    assert [value for value, _ in found] == pytest.approx(expected)


@dataclass(frozen=True)
class Case:
    """An experiment that oscillates from `ends` on, by twice what is raised; `rests`: whether it is calm at gain 1."""

    what: str
    ends: float = math.inf
    rests: bool = True
    amplitude: float = 0.5
    sample_time: float = TS
    axes: str = "pitch"
    posture: tuple[float, ...] = (0.1, 0.0)
    loop: Any = field(default_factory=lambda: SimpleNamespace(samples=2))
    tried: list[tuple[float, float]] = field(default_factory=list)

    def comes_to_rest(self, floor: float) -> bool:
        return self.rests and floor == 0.25

    def try_at(self, value: float, floor: float) -> tuple[bool, float]:
        self.tried.append((value, floor))
        return value >= self.ends, 2.0 * value

    def oscillates(self, value: float, floor: float) -> bool:
        return self.try_at(value, floor)[0]


def margin(case: Case, limit: float, oscillates: bool = False, **more: Any) -> _Margin:
    return _Margin(0, "m", case, 0.25, limit, 0.0, oscillates, **more)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("kind", ["gain_up", "delay"])
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("ranks", [True, False])
def test_a_draw_is_tried_at_its_required_margin_and_ranked_beyond(kind: str, whole: bool, ranks: bool) -> None:
    delay = kind == "delay"
    metric, limit, value = ("axes.delay_margin_ms", 40.0, 0.04) if delay else ("axes.gain_margin", 2.0, 2.0)

    def at_limit(case: Case) -> list[_Margin]:
        return _drawn._at_limit(case, 0.25, metric, limit, 3, whole=whole, ranks=ranks)  # pyright: ignore[reportArgumentType]

    found = at_limit(Case("", ends=value))
    assert [item.experiment.what for item in found] == (
        ["delay"] if delay else ["gain_up", "gain_down"] if whole else ["gain_up"]
    )
    for item in found:
        assert (item.number, item.metric, item.floor, item.limit, item.oscillates) == (3, metric, 0.25, limit, True)
        # Over the step of 0.5: twice what is raised, at the margin, and at twice the margin.
        assert item.swing == pytest.approx(4.0 * value)
        assert item.beyond == pytest.approx(8.0 * value if ranks else 0.0)
    assert not any(item.oscillates for item in at_limit(Case("", ends=1.001 * value)))
    for item in at_limit(Case("", rests=False)):
        assert (item.oscillates, item.swing) == (True, math.inf)


@pytest.mark.parametrize(
    ("kind", "limit", "ends", "least", "value"),
    [
        # Gains are scanned by quarters of an octave, delays in samples of the neck's; both beyond the limit alone.
        ("gain_up", 2.0, 3.0, math.inf, 3.0), ("gain_up", 2.0, 99.0, math.inf, math.inf),
        ("gain_up", 2.0, 3.0, 3.5, 3.0), ("gain_up", 2.0, 3.6, 3.5, math.inf),
        ("delay", 40.0, 0.2, math.inf, 0.2), ("delay", 40.0, 0.2, 0.15, math.inf), ("delay", 40.0, 0.2, 0.3, 0.2),
    ],
)  # fmt: skip
def test_a_margin_beyond_the_required_one_is_scanned_and_bisected(
    kind: str, limit: float, ends: float, least: float, value: float
) -> None:
    case = Case(kind, ends=ends)
    # Bisected to half a percent.
    assert _drawn._margin(margin(case, limit), least) == pytest.approx(value, rel=0.006)
    floor = limit / 1e3 if kind == "delay" else limit
    assert all(floor < tried and at == 0.25 for tried, at in case.tried)
    if math.isinf(least) and math.isinf(value):
        assert max(tried for tried, _ in case.tried) == 16.0


def test_a_margin_below_the_required_one_is_bisected_from_none() -> None:
    # To half a percent, or a fiftieth of a sample.
    for kind, limit, ends, none in (
        ("gain_up", 2.0, 1.5, 1.0),
        ("gain_down", 2.0, 1.5, 1.0),
        ("delay", 40.0, 0.03, 0.0),
    ):
        found = _drawn._margin(margin(Case(kind, ends=ends), limit, True), math.inf)
        assert found == pytest.approx(ends, rel=0.006, abs=0.02 * TS)
        assert _drawn._margin(margin(Case(kind, ends=ends, rests=False), limit, True), math.inf) == none


def test_the_least_margin_of_a_draw_is_that_of_its_worst_experiment_in_its_unit() -> None:
    for order in (1, -1):
        far, near = margin(Case("gain_up", ends=5.0), 2.0, beyond=3.0), margin(Case("gain_up", ends=3.0), 2.0)
        value, item = _drawn._least_margin([far, near][::order])
        assert (value, item) == (pytest.approx(3.0, rel=0.006), near)
    value, _ = _drawn._least_margin([margin(Case("delay", ends=0.2), 40.0)])
    assert value == pytest.approx(200.0, rel=0.006)
    value, item = _drawn._least_margin([far, margin(Case("gain_up"), 2.0)])
    assert (value, item) == (pytest.approx(5.0, rel=0.006), far)
    assert _drawn._least_margin([margin(Case("gain_up"), 2.0)])[0] == math.inf
    # Where one never comes to rest the margin is none, and no other experiment is tried with a delay of zero.
    for what, none in (("gain_up", 1.0), ("delay", 0.0)):
        restless, calm = margin(Case(what, rests=False), 2.0, oscillates=True), Case(what)
        assert _drawn._least_margin([margin(calm, 2.0), restless])[0] == none
        assert not calm.tried
    facts = _drawn._margin_facts(far, "draw 1", make_requirements({}))
    assert facts["kick_deg"] == pytest.approx(math.degrees(0.5))
    assert facts["posture_deg"] == pytest.approx([math.degrees(0.1), 0.0])
    assert (facts["name"], facts["axis"], facts["raised"], facts["worst_of"]) == ("draw 1", "pitch", "gain_up", 3)


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("number", [0, 1, 2, 5])
def test_each_axis_is_tried_with_the_lightest_payload_and_all_at_once_with_both(
    outputs: int, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At every amplitude; what ranks the draws are all axes at once beyond the smallest; postures take turns."""
    names = ("pitch", "roll")[:outputs]
    under = LoopUnderTest(name="", plant=lambda: None, controller=pi().block(), size=2.0)  # pyright: ignore[reportArgumentType]
    monkeypatch.setattr(_drawn, "_under_test", lambda *_: under)
    monkeypatch.setattr(Experiment, "floor", lambda case: case.amplitude)
    tried: list[Any] = []
    monkeypatch.setattr(_drawn, "_at_limit", lambda *args, **more: tried.append((args, more)) or [args[0]])
    plant: Any = SimpleNamespace(name="draw 3", payload="inputs", payloads=lambda _: [0.5, 0.0, 0.2],
                                 carrying=lambda kg: {"plant_inputs": kg}, quiet=lambda ts: ("quiet", ts))  # fmt: skip
    asked: Any = SimpleNamespace(robot=SimpleNamespace(outputs=SimpleNamespace(names=names)), sim={"payloads_kg": []})
    task: Any = SimpleNamespace(plants=[plant] * 9, asked=asked, draws=None, controller=pi().block(), observer=None,
                                order="parallel", amplitudes=(0.1, 0.2), limits={"g": 2.0, "d": 40.0})  # fmt: skip
    found = _drawn._margins(task, number)
    last = "both" if outputs == 2 else "pitch"
    light = [*names, last] if outputs == 2 else [last]
    expected = [
        (kg, amplitude, axes, limit)
        for kg, every in ((0.0, light), (0.5, [last])) for amplitude in (0.1, 0.2) for axes in every for limit in "gd"
    ]  # fmt: skip
    told = [(case.loop.constants["plant_inputs"], case.amplitude, case.axes, metric)
            for (case, _, metric, _, _), _ in tried]  # fmt: skip
    assert told == expected
    assert len(found) == len(expected)
    for (case, floor, metric, limit, at), more in tried:
        assert (floor, limit, at) == (case.amplitude, task.limits[metric], number)
        assert more == {"whole": case.axes == last, "ranks": case.axes == last and case.amplitude == 0.2}
        assert case.posture == tuple(2.0 * angle for angle in under.postures()[number % 3])
        assert (case.loop.order, case.loop.plant()) == ("parallel", ("quiet", TS))
        assert case.loop.name == f"draw 3, {case.loop.constants['plant_inputs']:g} kg"


def test_draws_that_fail_are_bisected_first_and_then_those_that_swing_most() -> None:
    bad, loud, calm = margin(Case(""), 2.0, True), margin(Case(""), 2.0, beyond=4.0), margin(Case(""), 2.0, beyond=1.0)
    ranked = sorted([[calm], [calm, loud], [calm, bad], [calm, calm]], key=_drawn._severity)
    assert ranked[:2] == [[calm, bad], [calm, loud]]


def run_with(
    monkeypatch: pytest.MonkeyPatch, steps: list[dict[str, float]], margins: list[list[_Margin]], **more: Any
) -> tuple[Drawn, list[float]]:
    """Run draws that have these values and margins, the more oscillating margins the less of it."""
    monkeypatch.setattr(_drawn, "make_simulation_model", lambda _, name, __: SimpleNamespace(name=name))
    monkeypatch.setattr(_drawn, "_steps", lambda _, k: {key: [(v, f"draw {k + 1}")] for key, v in steps[k].items()})
    monkeypatch.setattr(_drawn, "_margins", lambda _, k: margins[k])
    monkeypatch.setattr(_drawn, "_least_margin", lambda items: (items[0].limit, items[0]))
    monkeypatch.setattr(_drawn, "_amplitudes", lambda *_: (0.1,))
    monkeypatch.setattr(_drawn, "directions_of", lambda _: None)
    draws, told = told_draws(), list[float]()
    draws.for_certificate = lambda attempt: [attempt] * len(steps)
    draws.for_search = lambda: [0] * len(steps)
    require = {"sim.overshoot_pct": {"max": 10.0}, "sim.rise_s": {"min": 0.1, "max": 0.4}, "sim.settling_s": False}
    asked = make_requirements({"sim": {"decides": True}, "require": require})
    found = run_drawn("f", draws, pi().block(), asked, order="sequential", observer=None,
                      **{"attempt": 2, **more}, progress=lambda share, _: told.append(share))  # fmt: skip
    return found, told


@pytest.mark.parametrize("bad", [None, 0, 1, 2])
@pytest.mark.parametrize("lost", [10.001, math.nan, math.inf])
def test_a_draw_fails_by_its_steps_and_by_its_margins(
    bad: int | None, lost: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = [{"sim.overshoot_pct": 10.0 - k} for k in range(3)]
    if bad is not None:
        steps[bad]["sim.overshoot_pct"] = lost
    found, told = run_with(monkeypatch, steps, [[], [], []])
    assert found.failed == (() if bad is None else (bad,))
    assert (found.count, found.attempt) == (3, 2)
    np.testing.assert_array_equal(found.values["sim.overshoot_pct"], [s["sim.overshoot_pct"] for s in steps])
    names = [item["name"] for item in found.conditions["sim.overshoot_pct"]]
    assert names == [f"draw {k + 1}" for k in range(3)]
    assert told == sorted(told)
    # Of two bounds each must hold; what nobody bounds fails nothing.
    for rise in (0.05, 0.5, math.nan):
        two = [{"sim.rise_s": rise if k == bad else 0.4, "sim.settling_s": math.inf} for k in range(3)]
        assert run_with(monkeypatch, two, [[], [], []])[0].failed == found.failed
    margins = [[replace(margin(Case("gain_up"), 2.0, k == bad), number=k)] for k in range(3)]
    assert run_with(monkeypatch, [{}] * 3, margins)[0].failed == (() if bad is None else (bad,))


@dataclass(frozen=True)
class ToldDraws:
    conditions: dict[str, list[float]]
    seed: int = 7

    @property
    def noise(self) -> np.ndarray:
        return np.zeros(1)

    def for_certificate(self, attempt: int) -> list[int]:
        return [attempt] * 3


def test_equal_loops_run_once_and_every_other_attempt_limit_or_draw_runs_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs: list[int] = []

    def steps(_: Any, number: int) -> dict[str, list[tuple[float, str]]]:
        runs.append(number)
        return {"sim.overshoot_pct": [(3.0, "0 deg")]}

    monkeypatch.setattr(_drawn, "make_simulation_model", lambda _, name, __: SimpleNamespace(name=name))
    monkeypatch.setattr(_drawn, "_steps", steps)
    margins: list[int] = []
    monkeypatch.setattr(_drawn, "_margins", lambda _, number: margins.append(number) or [])
    monkeypatch.setattr(_drawn, "_amplitudes", lambda *_: (0.1,))
    monkeypatch.setattr(_drawn, "directions_of", lambda _: None)
    monkeypatch.setattr(ToldDraws, "model", None, raising=False)

    def run(limit: float = 10.0, attempt: int = 1, seed: int = 7, bound: str = "max", **more: Any) -> Drawn:
        step = more.pop("step", {})
        asked = make_requirements(
            {"sim": {"decides": True, **more}, "step": step, "require": {"sim.overshoot_pct": {bound: limit}}}
        )
        draws: Any = ToldDraws({"motion": [0.4], "payload_kg": [0.0]}, seed)
        return run_drawn(
            "once", draws, pi().block(), asked, order="sequential", observer=None, attempt=attempt,
            progress=lambda *_: None,
        )  # fmt: skip

    first = run()
    assert (len(runs), first.failed) == (3, ())
    again = run()
    assert (len(runs), again.statement(), again.conditions) == (3, first.statement(), first.conditions)
    assert run(limit=2.0).failed == (0, 1, 2)
    assert run(limit=2.0, bound="min").failed == ()
    assert (run(attempt=2).attempt, run(seed=8).draws.seed) == (2, 8)
    # Steps have no limit to depend on.
    assert (len(margins), len(runs)) == (15, 9)
    # What the user stated changes what is told of equal loops.
    payloads = make_requirements({}).sim["payloads_kg"]
    assert "sim" in run(payloads_kg=payloads).unreached
    assert not again.unreached
    # Four deviations of 0.19 deg are more than 5 % of 15 deg.
    assert [run(step={"noise_deg": noise}).noisy for noise in (0.18, 0.19)] == [False, True]
    assert (len(margins), len(runs)) == (21, 15)


def test_each_kind_of_margin_is_bisected_on_the_draws_that_swing_most(monkeypatch: pytest.MonkeyPatch) -> None:
    def of(k: int, kind: str) -> _Margin:
        return replace(margin(Case(kind), 10.0 * k, beyond=float(k)), number=k, metric="axes.gain_margin")

    margins = [[of(k, "gain_up"), of(4 - k, "gain_down")] for k in range(5)]
    margins = [[replace(item, number=k) for item in row] for k, row in enumerate(margins)]
    found, _ = run_with(monkeypatch, [{}] * 5, margins)
    assert found.values["axes.gain_margin"].tolist() == [40.0, 30.0, 20.0, 40.0, 30.0, 20.0]
    facts = found.conditions["axes.gain_margin"]
    assert [item["name"] for item in facts] == [f"draw {k} of f" for k in (5, 4, 3, 1, 2, 3)]
    assert [item["raised"] for item in facts] == ["gain_up"] * 3 + ["gain_down"] * 3
    # A search sees draws of its own, which no certificate has.
    assert run_with(monkeypatch, [{}] * 4, [[]] * 5, attempt=0)[0].count == 4
