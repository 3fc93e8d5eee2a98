"""What the data support: margins over the weight of a tested family, its band, own plants, and the worst plant."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import control
import numpy as np
import pytest

from softneck.core import SettingsError
from softneck.design import PiSettings
from softneck.fmu import build_fmu
from softneck.identification import Family
from softneck.identification.linear._srivc_fit import Continuous
from softneck.identification.uncertainty._measured import AxisMeasured, band_borders, response_of
from softneck.loop import BlockPart
from softneck.plant import NeckParameters, VirtualNeck
from softneck.verification import Verification, make_requirements, verify
from softneck.verification._evidence import Values, worst_row
from softneck.verification._experiments import Crossing, Experiment, LoopUnderTest
from softneck.verification._linear import AxisMargins, LinearLaw, axis_margins, margins
from softneck.verification._metrics import Scale
from softneck.verification._neck_loops import (
    ALONE,
    SimulationModel,
    is_simulation_model,
    make_simulation_model,
    named_plants,
    step_time,
    unrecorded_conditions,
)
from softneck.verification._plants import all_plants, source_of_family
from softneck.verification._steps import Steps
from softneck.verification._structured import interconnection, structured_singular_value
from softneck.verification._verify import unsupported_reason

from ..data import ROOT
from .necks import PAPER, QUICK, TS, family, linear_neck, pi

MODEL = Continuous(a=np.array([PAPER[1]]), b=np.array([PAPER[0] * PAPER[1]]), delay=float(PAPER[2]))
LAW = LinearLaw.of(pi().ss())
QUIET = {**QUICK, "sim": {"necks": 0}}


def measured(*, weight: float = 0.3, low: float = 0.3, high: float = 25.0) -> AxisMeasured:
    w, borders = np.geomspace(low, high, 20), band_borders(low, high)
    return AxisMeasured(
        model=MODEL, held_out=np.zeros(3), points=np.zeros((0, 5)), frequency=w, weight=np.full(20, weight),
        borders=borders, needed=np.zeros((2, borders.size - 1)),
    )  # fmt: skip


def on_data(**values: float) -> Family:
    found = {"confidence": 0.95, "names": ["small.csv", "large.csv"], "sha256": ["a", "b"], "amplitude": [0.3, 2.5]}
    plain = family()
    both = {axis: measured(**values) for axis in ("pitch", "roll")}
    return replace(plain, measured=both, findings={**plain.findings, "tested": {**found, "why": []}})


def test_margins_of_a_disk_are_those_of_its_worst_points() -> None:
    """Closed forms against a thousand points of each disk."""
    item = axis_margins(measured(), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0)
    w = np.geomspace(0.3, 25.0, 400)
    L0 = -LAW.feedback(w)[:, 0, 0] * response_of(MODEL, w, TS)
    D = 0.3 * np.exp(1j * np.linspace(0.0, 2.0 * math.pi, 1000))[:, None]
    L = L0 * (1.0 + D)
    S = 1.0 / (1.0 + L)
    # Five times fewer frequencies and the half steps that the disks are widened by: up to half a percent.
    assert item.margins["sensitivity"] == pytest.approx(np.abs(S).max(), rel=0.01)
    assert item.margins["complementary"] == pytest.approx(np.abs(1.0 - S).max(), rel=0.01)
    assert item.margins["disk_margin"] == pytest.approx(2.0 / np.abs(2.0 * S - 1.0).max(), rel=0.01)
    assert item.mu == pytest.approx(0.3 * np.abs(L0 / (1.0 + L0)).max(), rel=0.01)
    # The delay and the gain that bring some point of some disk onto -1; both grids leave a percent.
    k = np.geomspace(1.0, 6.0, 2000)[:, None]
    onto = (np.abs(1.0 + k * L0) <= k * 0.3 * np.abs(L0)).any(axis=1)
    edge = 1.0 / (1.3 * abs(L0[-1]))
    assert item.margins["gain_margin"] == pytest.approx(min(float(k[int(np.argmax(onto)), 0]), edge), rel=0.01)
    late = np.linspace(0.0, 0.5, 4000)[:, None]
    onto = (np.abs(1.0 + L0 * np.exp(-1j * w * late)) <= 0.3 * np.abs(L0)).any(axis=1)
    assert item.margins["delay_margin_ms"] == pytest.approx(1e3 * float(late[int(np.argmax(onto)), 0]), rel=0.01)


def test_without_uncertainty_the_margins_are_those_of_the_plant() -> None:
    from softneck.verification._plants import nominal_plants, source_of_model

    plant = nominal_plants([source_of_model(linear_neck(), "m", {"gain": 0.0, "pole": 0.0, "delay": 0.0})])[0]
    exact = margins(plant, LAW)
    item = axis_margins(measured(weight=1e-9, high=100.0), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0)
    for name in ("sensitivity", "disk_margin", "gain_margin", "phase_margin_deg", "delay_margin_ms"):
        # 400 frequencies over two decades and a half: 1.5 % apart, at crossings half of that.
        assert item.margins[name] == pytest.approx(exact[f"pitch.{name}"][0], rel=0.02), name


def test_a_weight_that_may_hold_an_unstable_loop_leaves_no_margin() -> None:
    item = axis_margins(measured(weight=1.5, high=100.0), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0)
    assert item.mu >= 1.0
    assert item.margins["gain_margin"] == 1.0
    assert item.margins["sensitivity"] == math.inf


def test_a_gain_margin_ends_where_the_band_does() -> None:
    wide = axis_margins(measured(weight=0.01, high=100.0), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0)
    narrow = axis_margins(
        measured(weight=0.01, high=1.3 * wide.crossover), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0
    )
    # The loop falls about as 1/w at its crossover: 1.3 times the gain moves it to the band's end.
    assert narrow.margins["gain_margin"] == pytest.approx(1.3, rel=0.1)
    assert wide.margins["gain_margin"] > 2.0
    beyond = axis_margins(
        measured(weight=0.01, high=0.7 * wide.crossover), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0
    )
    assert beyond.margins == {}
    assert "not supported by the data: f excites pitch from 0.3 to" in beyond.why()
    assert "record `multisine --band" in beyond.why()


@pytest.fixture(scope="module")
def supported() -> Verification:
    return verify(pi(), {"f.npz": on_data(weight=0.15)}, make_requirements(QUIET))


@pytest.mark.slow
def test_the_certificate_says_where_it_is_valid(supported: Verification) -> None:
    said = supported.contents()
    assert said["band_rad_s"] == pytest.approx([0.3, 25.0])
    assert said["amplitude_rad"] == [0.3, 2.5]
    assert said["confidence_level"] == 0.95
    assert [row["name"] for row in said["recordings"]] == ["small.csv", "large.csv"]
    assert said["margins"]["simulated"] == {"gain_ratio": None, "delay_s": None}
    rows = {row["metric"]: row["value"] for row in said["requirements"]}
    assert said["margins"]["linear"]["gain_ratio"] == rows["axes.gain_margin"]
    assert 1e3 * said["margins"]["linear"]["delay_s"] == pytest.approx(rows["axes.delay_margin_ms"])


@pytest.mark.slow
def test_each_verdict_is_the_worst_of_all_plants(supported: Verification) -> None:
    """A mutant that judged the best one lived."""
    evidence = supported.evidence
    for verdict in supported.verdicts:
        if verdict.value is None:
            continue
        values = evidence.metrics[verdict.requirement.metric].values
        assert verdict.value == (values.min() if verdict.requirement.bound == "min" else values.max())
        assert verdict.holds is verdict.requirement.holds(verdict.value)
    part = evidence.linear[0]
    everywhere = margins(part.plants, part.law)
    for name, worst in (("sensitivity", max), ("disk_margin", min), ("gain_margin", min), ("delay_margin_ms", min)):
        alone = [everywhere[f"{axis}.{name}"] for axis in ("pitch", "roll")]
        data = [item.margins[name] for item in evidence.tested]
        values = evidence.metrics[f"axes.{name}"].values
        expected = worst([*np.concatenate(alone), *data])
        assert worst(values) == pytest.approx(expected, rel=1e-12), name
        assert values.size == 2 * len(part.plants) + len(data)


@pytest.mark.parametrize(("bound", "row"), [("min", 1), ("max", 2), ("below", 2)])
def test_the_worst_row_is_the_least_for_min_and_the_largest_for_others(bound: str, row: int) -> None:
    values = Values(np.array([2.0, 1.0, 3.0]), lambda k: {"name": str(k)})
    assert worst_row({"m": values}, "m", bound) == row
    assert worst_row({"m": Values(np.array([2.0, np.nan, 3.0]), values.describe)}, "m", bound) == 1


@pytest.mark.slow
def test_what_crosses_beyond_the_band_is_not_supported_and_not_held() -> None:
    found = verify(pi(), {"eq22.npz": on_data(high=2.0)}, make_requirements(QUIET))
    rows = {row["metric"]: row for row in found.contents()["requirements"]}
    for metric in ("axes.gain_margin", "axes.disk_margin", "robust.mu", "stability.radius"):
        assert rows[metric]["holds"] is False
        assert "not supported by the data" in rows[metric]["note"]
    assert rows["step.overshoot_pct"]["holds"] is True
    assert not found.holds


@pytest.mark.slow
def test_what_a_family_cannot_speak_of_is_not_supported_and_not_held() -> None:
    """Recordings at 1 kg that show nothing: every margin and every linear step was certified as if they were in it."""
    plain = on_data(weight=0.15)
    told = {**plain.findings["tested"], "unheard": {"pitch": ["1kg.csv"], "roll": []}}
    found = verify(pi(), {"f.npz": replace(plain, findings={"tested": told})}, make_requirements(QUIET))
    rows = {row["metric"]: row for row in found.contents()["requirements"]}
    for metric in ("axes.gain_margin", "robust.mu", "stability.radius", "step.overshoot_pct"):
        assert rows[metric]["holds"] is False
        assert "not supported by the data: pitch does not respond in 1kg.csv" in rows[metric]["note"]
    assert not found.holds


def held_at(common: float) -> Steps:
    return Steps(np.zeros(4), np.zeros((2, 3, 4)), np.full((2, 3, 4, 3), common), {}, {})


@pytest.mark.parametrize(
    ("payload", "at", "loop", "said"),
    [
        ([1.0], [0.0], 0.0, {}),
        ([0.0], [0.0], 0.0, {"sim": "recorded with 1 kg, and no simulation model covers that"}),
        ([1.0], [0.0], 2.0, {"sim": "at a co-contraction of 2 rad", "loop": "recorded at -0.5 to 0.5 rad"}),
        ([1.0], [2.0], 0.0, {"sim": "at a co-contraction of 0 rad"}),
        (None, [0.0], 2.0, {"loop": "holds its motors at a co-contraction of 2 rad, and with 1 kg"}),
    ],
    ids=["recorded", "other payload", "tauter than all recordings", "tauter plant", "takes any payload"],
)
def test_what_nobody_recorded_is_not_supported(
    payload: list[float] | None, at: list[float], loop: float, said: dict[str, str]
) -> None:
    """Steps with 1 kg were certified on a plant of 0 kg alone, and recordings of slack tendons for taut ones."""
    tested = {"f.npz": {"conditions": [{"payload_kg": [1.0, 1.0], "cocontraction": [-0.5, 0.5]}]}}
    known = {} if payload is None else {"payload_kg": payload, "cocontraction": at}
    part: Any = None
    plant = SimulationModel(
        name="p", make=part, quiet=part, payload="inputs" if payload is None else "", conditions=known
    )
    found = unrecorded_conditions(tested, [plant], held_at(loop))
    assert found.keys() == said.keys()
    for group, words in said.items():
        assert words in found[group]


@pytest.mark.slow
def test_of_what_was_not_recorded_no_requirement_holds(supported: Verification) -> None:
    evidence, why = supported.evidence, {"sim": "no such payload", "loop": "slack there"}
    for item in make_requirements(QUIET).bounds:
        group = "sim" if item.metric.startswith("sim.") else "loop"
        assert unsupported_reason(item, replace(evidence, foreign=False), why) == why[group], item.metric
        # A preset is nobody's recorded plant, and decides nothing.
        assert unsupported_reason(item, evidence, {"sim": why["sim"]}) == "", item.metric


@pytest.mark.slow
def test_margins_of_a_controller_without_linear_form_are_no_promise(supported: Verification) -> None:
    """Nothing of it is held against the weight over the recordings: models alone told four times the true margin."""
    evidence, why = replace(supported.evidence, tested=[]), {"margins": ALONE}
    told = {item.metric: unsupported_reason(item, evidence, why) for item in supported.requirements.bounds}
    assert {metric for metric, reason in told.items() if reason == ALONE} == {
        metric for metric in told if metric.endswith(("gain_margin", "delay_margin_ms"))
    }
    assert told["axes.gain_margin"] == ALONE
    assert told["step.overshoot_pct"] == ""


def test_margins_by_experiment_stand_beside_the_linear_ones_and_the_smaller_is_certified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told = [
        Crossing("own", "both", "gain_up", 0.02, (0.0, 0.0), 1.3, 0.0),
        Crossing("own", "pitch", "delay", 0.02, (0.0, 0.0), 0.9, 0.0),
    ]
    monkeypatch.setattr("softneck.verification._evidence.crossings", lambda loops, **_: told if loops else [])
    things: dict[str, Any] = {"m": linear_neck(), "own": NeckParameters.paper()}
    few = {"payloads_kg": [0.0], "orientations_deg": [0.0], "duration_s": 2.5}
    found = verify(pi(), things, make_requirements({**QUICK, "sim": few}))
    rows = {row["metric"]: row for row in found.contents()["requirements"]}
    assert (rows["axes.gain_margin"]["value"], rows["axes.gain_margin"]["holds"]) == (1.3, False)
    assert rows["axes.gain_margin"]["worst"]["kind"] == "experiment"
    # The delay of the experiment is longer than that of the model.
    assert rows["axes.delay_margin_ms"]["value"] < 900.0
    both = found.contents()["margins"]
    assert both["simulated"] == {"gain_ratio": 1.3, "delay_s": 0.9}
    assert both["linear"]["gain_ratio"] > 1.3
    # On the user's own plant neck.* decides, and one run is enough: one payload, one orientation.
    assert [run.name for run in found.evidence.necks] == ["own, 0 kg, 0 deg"]
    assert rows["sim.overshoot_pct"]["holds"] is not None


@pytest.mark.slow
def test_a_preset_is_a_foreign_plant_that_decides_only_where_it_is_asked() -> None:
    few = {**QUICK["sim"], "decides": False}
    asked = {"sim.overshoot_pct": {"max": 0.001}}
    found = verify(pi(), linear_neck(), make_requirements({**QUICK, "sim": few}))
    rows = {row["metric"]: row for row in found.contents()["requirements"]}
    assert (rows["sim.overshoot_pct"]["holds"], "shown only" in rows["sim.overshoot_pct"]["note"]) == (None, True)
    assert rows["sim.overshoot_pct"]["value"] is not None
    assert found.contents()["foreign_plants"] is True
    strict = verify(pi(), linear_neck(), make_requirements({**QUICK, "sim": few, "require": asked}))
    assert "sim.overshoot_pct" in [v.requirement.metric for v in strict.failed]


def test_what_steps_is_told_from_what_is_linear() -> None:
    assert is_simulation_model(NeckParameters.paper())
    assert not is_simulation_model(linear_neck())
    assert not is_simulation_model(family())
    with pytest.raises(SettingsError, match="c: needs the outputs pitch and roll"):
        make_simulation_model(pi().block(), "c")


def test_a_roll_off_that_the_user_states_is_judged_up_to_nyquist() -> None:
    """A controller whose gain rises above the band crosses there unless the plant falls steeply."""

    def judge(rolloff: float, law: LinearLaw = LAW) -> AxisMargins:
        narrow = measured(weight=0.01, high=20.0)
        return axis_margins(narrow, law, 0, source="f", name="pitch", extra=0, rolloff=rolloff)

    silent, falling = judge(-1.0), judge(20.0)
    # The law and the plant both fall above 20 rad/s: nothing is lost by asking.
    assert falling.margins == pytest.approx(dict(silent.margins))
    # A lead that begins above the band: silence does not see it, a plant as loud as at the band's end crosses.
    lead = control.sample_system(control.TransferFunction([1.0 / 25.0, 1.0], [1.0 / 750.0, 1.0]), TS, "tustin")
    one = control.ss([], [], [], [[1.0]], TS)
    form = control.append(one, one, control.ss(lead), control.ss(lead))
    rising = LinearLaw.of(_labelled(pi().ss() * form))
    assert math.isfinite(judge(-1.0, rising).crossover)
    assert math.isinf(judge(0.0, rising).crossover)
    assert "not supported by the data" in judge(0.0, rising).why()
    steep = judge(60.0, rising)
    assert math.isfinite(steep.crossover)
    # Just above the band nothing has fallen yet: the margins there are those of a loop of any phase.
    assert steep.margins["disk_margin"] <= judge(-1.0, rising).margins["disk_margin"]


def _labelled(system: Any) -> Any:
    names = [f"{axis}{end}" for end in ("_reference", "") for axis in ("pitch", "roll")]
    return control.ss(system, inputs=names, outputs=["theta_i", "phi_i"])


def test_a_step_waits_for_the_motors_that_pull_tendons_taut() -> None:
    taut = PiSettings(least_cocontraction=0.6).design(linear_neck())
    asked = make_requirements({})
    assert step_time(pi().block(), asked) == 0.5
    assert step_time(taut.block(), asked) == 3.0
    assert step_time(taut.block(), replace(asked, scale=Scale(time=10.0))) == 30.0


def test_a_tested_family_holds_no_plant_that_its_recordings_exclude_and_reaches_to_the_weight() -> None:
    """Corners put together what no recording has: a slow pole and a long dead time, of which designs were refused."""
    neck = source_of_family(on_data(weight=0.15, high=25.0), "f")
    wide = tuple(replace(box, low=0.5 * box.nominal, high=2.0 * box.nominal) for box in neck.axes)
    plants = all_plants([replace(neck, axes=wide)], 60, 0)
    w = np.geomspace(0.3, 25.0, 20)
    error = np.abs(plants.response(w) / response_of(MODEL, w, TS) - 1.0).max(axis=2)
    # Ten halvings: to a thousandth of the way, on which the error grows by less than three.
    assert error.max() <= 0.15 * (1.0 + 1e-9)
    assert error.max() == pytest.approx(0.15, rel=0.02)
    assert plants.names[-1] == "f: middle of its recordings"
    assert error[-1].max() < 1e-9
    # Without recordings the box is whole.
    bare = tuple(replace(box, measured=None) for box in wide)
    assert all_plants([replace(neck, axes=bare)], 60, 0).numbers[:, :, 0].max() == wide[0].high[0]


@pytest.mark.parametrize("weight", [0.1, 0.3])
def test_mu_over_the_weight_of_axes_apart_is_the_largest_of_each(weight: float) -> None:
    neck = replace(source_of_family(on_data(weight=weight), "f"), cross=np.zeros(2))
    found = structured_singular_value(neck, LAW, extra=0)
    alone = axis_margins(measured(weight=weight), LAW, 0, source="f", name="pitch", extra=0, rolloff=-1.0)
    # 90 frequencies in two decades: 5 % apart, and the peak is flat; the other grid adds half its step.
    assert found[0].mu == pytest.approx(alone.mu, rel=0.03)


def test_the_loop_of_mu_is_the_same_in_every_scale() -> None:
    """Of measured plants and of those of a box: what the gain is divided by, the controller's is multiplied by."""
    w = np.geomspace(0.5, 20.0, 30)
    sources = on_data(weight=0.2), family()
    for neck in (source_of_family(one, "f") for one in sources):
        # 50 rad in an SI unit of the outputs, such as metres; only rounding is left.
        (one, blocks), (other, same) = (interconnection(neck, LAW, w, (0, 1), 1, gain) for gain in (1.0, 50.0))
        assert blocks == same
        scaled = [kind for kind, _ in blocks]
        for k in np.flatnonzero(np.array(scaled) > 0):
            np.testing.assert_allclose(other[:, k, k], one[:, k, k], rtol=1e-9)
        np.testing.assert_allclose(np.linalg.det(other), np.linalg.det(one), rtol=1e-9)


@pytest.mark.slow
def test_an_fmu_stands_as_much_as_the_plant_that_it_is_made_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = VirtualNeck(NeckParameters.paper().without_noise()).block()
    build_fmu(block, tmp_path / "neck.fmu")
    monkeypatch.chdir(tmp_path)
    own = make_simulation_model(named_plants("neck.fmu")["neck.fmu"], "neck.fmu")
    # Loading an FMU changes the folder for a moment: another thread's relative path was "no such file".
    monkeypatch.chdir(Path("/"))
    swings = [
        Experiment(
            LoopUnderTest(
                name="p", plant=part, controller=pi().block(), compiled=False,
                constants={"plant_inputs": {"payload": 0.0}},
            ),
            "both", "gain_up", math.radians(1.0), (0.0, 0.0),
        )._windows(1.5, 0.0)
        for part in (lambda: own.quiet(TS), lambda: BlockPart(block))
    ]  # fmt: skip
    assert own.payload
    # The same runtime inside, to the last bits of outputs that pass as text nowhere.
    assert swings[0] == pytest.approx(swings[1], rel=1e-9)
    assert swings[1][1] > 0.0


def test_plants_are_presets_neck_files_or_what_was_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file in the folder that is called like a preset is the file."""
    monkeypatch.chdir(tmp_path)
    Path("my.toml").write_text('preset = "lab"\nbending_stiffness = 0.8\n', encoding="utf-8")
    saved = ROOT / "tests" / "golden" / "rls.npz"
    found = named_plants(["my.toml", str(saved), "paper"])
    assert list(found) == ["my.toml", "rls.npz", "paper"]
    assert found["my.toml"] == replace(NeckParameters.preset("lab"), bending_stiffness=0.8)
    assert found["paper"] == NeckParameters.paper()
    assert found["rls.npz"].kind == "rls"
    Path("paper").write_bytes(saved.read_bytes())
    assert named_plants(["paper"])["paper"].kind == "rls"
