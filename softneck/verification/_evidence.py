"""Compute all metrics of a verification, with the plant of every value."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from softneck.core import Progress, ReprMixin, Vector, compute_once
from softneck.loop import error_unit
from softneck.runtime import Block

from ._drawn import Drawn, draws_of, run_drawn
from ._experiments import Crossing, crossing_facts, crossing_values, crossings
from ._linear import AxisMargins, ControllerUnderTest, LinearLaw, data_margins, frequency_grid, margins
from ._neck_loops import (
    LoopRun,
    SimulationModel,
    direction,
    judged_elsewhere,
    loops_under_test,
    neck_changes,
    preset_of,
    run_loops,
    start_of,
    step_time,
    why_no_virtual_plant,
)
from ._plants import Plants, PlantSource, all_plants, join
from ._requirements import Requirements
from ._steps import NO_PAYLOAD_IN_STEPS, Steps, run_steps
from ._structured import SearchResult, StructuredResult, search, structured_singular_value

Describe = Callable[[int], dict[str, Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Values:
    """Values of one metric over all plants.

    `values`: (n,). `describe`: row -> facts on that plant for the certificate.
    """

    values: Vector
    describe: Describe


@dataclass(frozen=True, slots=True, eq=False)
class LinearEvidence:
    """Results of the linear methods for one linear form.

    `law`: the form. `plants`: with the delay that the order adds: those of the boxes, then the worst of the search.
    `margins`: name -> (n,). `found`: result of the search; None if switched off. `structured`: bounds of each source.
    """

    law: LinearLaw
    plants: Plants
    margins: dict[str, Vector]
    found: SearchResult | None
    structured: list[list[StructuredResult]]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Evidence(ReprMixin):
    """All results of a verification.

    Attributes:
        plants: of the boxes, with the delay that the order adds.
        frequency: (m,) [rad/s].
        linear: of the controller's linear form; none without one.
        steps: of `stepped`: all plants and the worst of the searches.
        necks: simulated loops.
        metrics: name -> values.
        not_computed: metric or check -> why.
        foreign: whether `necks` use a built-in plant.
        tested: margins that the data support, of each axis of each tested family.
        crossings: margins by experiment on the user's simulation models.
        drawn: loops over the draws of each family that has them, which then decide.
    """

    plants: Plants
    frequency: Vector
    linear: list[LinearEvidence]
    steps: Steps
    stepped: Plants
    necks: list[LoopRun]
    metrics: dict[str, Values] = field(default_factory=dict)
    not_computed: dict[str, str] = field(default_factory=dict)
    foreign: bool = True
    tested: list[AxisMargins] = field(default_factory=list)
    crossings: list[Crossing] = field(default_factory=list)
    drawn: list[Drawn] = field(default_factory=list)


def gather(
    controller: ControllerUnderTest, necks: Sequence[PlantSource], asked: Requirements, *, observer: Block | None,
    progress: Progress, families: Mapping[str, Any], own: Sequence[SimulationModel], attempt: int = 1,
) -> Evidence:  # fmt: skip
    """Compute all evidence, including cheap metrics without a requirement; `own` are the user's simulation models.

    `attempt`: whose draws are taken of families that have them.
    """
    drawn = draws_of(families)

    # Margins of single axes are only computed if required.
    alone = {f"{axis}.{name}" for axis in controller.robot.outputs.names for name in ("gain_margin", "delay_margin_ms")}
    overall = all(item.metric not in alone for item in asked.bounds)
    plants = [(plant.name, plant.thing) for plant in own]

    def linear() -> Evidence:
        return _linear_evidence(controller, necks, asked, progress, families)

    def simulated() -> tuple[list[LoopRun], list[Crossing]]:
        loops = lambda done, text: progress(0.5 + (0.1 if drawn else 0.5) * done, text)  # noqa: E731
        return _simulated(controller, asked, observer=observer, progress=loops, own=own, overall=overall)

    found = compute_once(linear, controller, necks, asked.tables, families)
    if own:
        runs, crossed = compute_once(simulated, controller, asked.tables, observer, plants, overall)
    elif drawn or why_no_virtual_plant(controller.robot, asked):
        runs, crossed = [], []
    else:  # the built-in plant may be a file, which may have changed
        runs, crossed = simulated()
    # A built-in plant does not count unless the user gives its file.
    foreign = not (own or drawn or asked.sim["decides"] or preset_of(asked).endswith(".toml"))
    found = replace(found, necks=runs, crossings=crossed, foreign=foreign)
    evidence = replace(found, metrics={}, not_computed={}, drawn=[])
    why = why_no_virtual_plant(controller.robot, asked)
    evidence.not_computed.update({"sim": why} if why and not own else judged_elsewhere(own, asked))
    _fill_metrics(evidence, controller, asked, observer is not None)
    late = lambda done, text: progress(0.6 + 0.4 * done, text)  # noqa: E731
    for name, draws in drawn.items():
        evidence.drawn.append(run_drawn(
            name, draws, controller.block, asked, order=controller.order, observer=observer, attempt=attempt,
            progress=late,
        ))  # fmt: skip
        if _asks_slack(asked) and "sim.slack_s" not in evidence.metrics:
            evidence.not_computed["sim.slack_s"] = (
                "draws have no tension outputs; verify over FAMILY and a NECK (`softneck.calibrate` in Python makes it)"
            )
    _add_drawn(evidence, {name for item in evidence.drawn for name in item.values})
    progress(1.0, "done")
    return evidence


def _linear_evidence(
    controller: ControllerUnderTest, necks: Sequence[PlantSource], asked: Requirements, progress: Progress,
    families: Mapping[str, Any],
) -> Evidence:  # fmt: skip
    """Compute what no loop over a simulation model changes, and no observer in it."""
    sources, seed = list(necks), int(asked.sampling["seed"])
    base = all_plants(sources, int(asked.sampling["plants"]), seed)
    plants = base.later(controller.extra)
    w = frequency_grid(base.sample_time, asked.scale.time)
    progress(0.0, "margins")
    linear = [_linear(law, plants, sources, controller.extra, asked) for law in controller.laws.values()]
    progress(0.4, "steps against every plant")
    stepped = join([plants, *(part.plants.take(np.arange(len(plants), len(part.plants))) for part in linear)])
    weights = [source.weights for source in sources]
    steps = run_steps(stepped, controller.block, asked.step_test(seed), robot=controller.robot, weights=weights)
    steep = float(asked.uncertainty["rolloff_db_per_decade"])
    laws = controller.laws.values()
    tested = [item for law in laws for item in data_margins(families, law, plants.axes, controller.extra, steep)]
    return Evidence(plants, w, linear, steps, stepped, [], tested=tested)


def _simulated(
    controller: ControllerUnderTest, asked: Requirements, *, observer: Block | None, progress: Progress,
    own: Sequence[SimulationModel], overall: bool,
) -> tuple[list[LoopRun], list[Crossing]]:  # fmt: skip
    """Run the loops over simulation models, and their margins; `overall`: none of a single axis is required."""
    seed = int(asked.sampling["seed"])
    runs = run_loops(
        controller.block, asked, order=controller.order, observer=observer, seed=seed,
        progress=lambda done, text: progress(0.5 * done, text), own=own,
    )  # fmt: skip
    loops = loops_under_test(controller.block, own, asked, order=controller.order, observer=observer)
    late = lambda done, text: progress(0.5 + 0.5 * done, text)  # noqa: E731
    return runs, crossings(loops, overall=overall, progress=late) if loops else []


def _linear(
    law: LinearLaw, plants: Plants, necks: list[PlantSource], extra: int, asked: Requirements
) -> LinearEvidence:
    seed, generations = int(asked.sampling["seed"]), int(asked.sampling["search_generations"])
    found = search(necks, law, extra=extra, generations=generations, seed=seed) if generations else None
    tried = plants if found is None else join([plants, found.plants.later(extra)])
    table = margins(tried, law)
    parts = [structured_singular_value(neck, law, extra=extra, scale=asked.scale) for neck in necks]
    return LinearEvidence(law, tried, table, found, parts)


def _add_data_margins(evidence: Evidence) -> None:
    """Add the margins that the data support, and those by experiment."""
    for item in evidence.tested:
        for name, value in item.margins.items():
            about = _tested_describer(item, name)  # the joint margin is at most that of one channel
            for group in (item.axis, "axes", *(("mimo",) if name == "disk_margin" else ())):
                _add(evidence, f"{group}.{name}", Values(np.array([value]), about))
        _add(evidence, "robust.mu", Values(np.array([item.mu]), _tested_describer(item, "mu")))
    if not evidence.tested:
        evidence.not_computed["the band of the data"] = (
            "no FAMILY was given that is tested against data; all linear checks are about models alone"
        )
    for name, (values, behind) in crossing_values(evidence.crossings).items():
        _add(evidence, name, Values(values, lambda row, behind=behind: crossing_facts(behind[row])))
    if not evidence.crossings:
        why = "no simulation model was given (a nonlinear MODEL, an FMU or a NECK)"
        evidence.not_computed["margins by experiment"] = why


def _add_drawn(evidence: Evidence, names: set[str]) -> None:
    """Let the draws decide: margins are theirs and those by experiment on the user's models, not the linear ones."""
    simulated = crossing_values(evidence.crossings)
    for name in names:
        if not name.startswith("sim."):
            evidence.metrics.pop(name, None)
        if name in simulated:
            values, behind = simulated[name]
            _add(evidence, name, Values(values, lambda row, behind=behind: crossing_facts(behind[row])))
    for item in evidence.drawn:
        for name, values in item.values.items():
            about = lambda row, rows=item.conditions[name]: {"kind": "draw", **rows[row]}  # noqa: E731
            _add(evidence, name, Values(values, about))


def _tested_describer(item: AxisMargins, name: str) -> Describe:
    facts = {
        "kind": "data", "name": f"{item.source}: the weight over its recordings", "axis": item.axis,
        "frequency_rad_s": item.at[name], "band_rad_s": list(item.band),
    }  # fmt: skip
    return lambda _: dict(facts)


def _fill_metrics(evidence: Evidence, controller: ControllerUnderTest, asked: Requirements, observer: bool) -> None:
    """Fill `metrics` and `not_computed`."""
    metrics, absent = evidence.metrics, evidence.not_computed
    for part in evidence.linear:
        _add_linear_margins(evidence, part)
    if not evidence.linear:
        for name in ("stability", "axes", "mimo", "robust"):
            absent[name] = controller.why
    elif observer:
        why = "margins are of controller and plant alone; the observer is in the simulated loops"
        absent["observer in the linear checks"] = why
    if any(port.name == "payload" for port in controller.block.inputs):
        absent["steps of other payloads"] = NO_PAYLOAD_IN_STEPS
    if not asked.sampling["search_generations"]:
        absent["stability.searched_radius"] = "the search is switched off (search_generations = 0)"
    _add_data_margins(evidence)
    for name, values in evidence.steps.metrics.items():
        metrics[f"step.{asked.scale.name_of(name)}"] = Values(values, _step_describer(evidence, name))
    if not evidence.necks:
        return
    describe = _neck_describer(evidence, controller, asked)
    for name in evidence.necks[0].metrics:
        values = np.array([run.metrics[name] for run in evidence.necks])
        metrics[f"sim.{asked.scale.name_of(name)}"] = Values(values, describe)
    slack = metrics.pop("sim.slack_s").values
    if asked.robot.tendon_angles is None and not _asks_slack(asked):
        return
    known = np.isfinite(slack) | [run.result is None for run in evidence.necks]
    # A heavier payload takes the pretension, whatever the controller does.
    light = [k for k, run in enumerate(evidence.necks) if known[k] and run.payload <= asked.sim["taut_up_to_kg"]]
    # A plant without tension outputs hides no slack tendon of another.
    if not known.all() and not slack[light].any():
        absent["sim.slack_s"] = "a plant has no tension outputs; give a NECK, a file or a preset by its name"
    elif light:
        metrics["sim.slack_s"] = Values(slack[light], lambda row: describe(light[row]))
    else:
        absent["sim.slack_s"] = "all of `payloads_kg` are above `taut_up_to_kg`"


def _asks_slack(asked: Requirements) -> bool:
    return any(bound.metric == "sim.slack_s" for bound in asked.bounds)


def _add_linear_margins(evidence: Evidence, part: LinearEvidence) -> None:
    count = len(evidence.plants)
    describe: Describe = lambda row: {**plant_facts(part.plants, row), "axis": "both"}  # noqa: E731
    table = dict(part.margins)
    radius = table.pop("stability.radius")
    _add(evidence, "stability.radius", Values(radius[:count], describe))
    if part.found is not None:
        _add(evidence, "stability.searched_radius", Values(radius[count:], lambda row: describe(count + row)))
        # The largest radius of the whole search counts, although the named plant is the final worst one.
        met = np.array([part.found.radius])
        worst = count + int(np.argmax(radius[count:]))
        _add(evidence, "stability.searched_radius", Values(met, lambda _: describe(worst)))
    for name, values in table.items():
        _add(evidence, name, Values(values, _with_axis(describe, name, part.plants.axes)))
    axes = part.plants.axes
    for name in {name.partition(".")[2] for name in table if name.startswith(f"{axes[0]}.")}:
        for found in (f"{axis}.{name}" for axis in axes):
            _add(evidence, f"axes.{name}", Values(part.margins[found], _with_axis(describe, found, axes)))
    for row in (row for rows in part.structured for row in rows):
        _add(evidence, "robust.mu", Values(np.array([row.mu]), _structured_describer(row)))


def _add(evidence: Evidence, name: str, more: Values) -> None:
    """Append values to those of a metric."""
    before = evidence.metrics.get(name)
    if before is None:
        evidence.metrics[name] = more
        return
    count = before.values.size

    def describe(row: int) -> dict[str, Any]:
        return before.describe(row) if row < count else more.describe(row - count)

    evidence.metrics[name] = Values(np.concatenate([before.values, more.values]), describe)


def _with_axis(describe: Describe, name: str, axes: tuple[str, ...]) -> Describe:
    axis = name.partition(".")[0]
    return lambda row: {**describe(row), "axis": axis if axis in axes else "both"}


def plant_facts(plants: Plants, row: int) -> dict[str, Any]:
    """Return one plant as JSON values."""
    axes = {
        axis: dict(zip((f"static_gain_{plants.unit}", "pole_per_s", "dead_time_s"), numbers.tolist(), strict=True))
        for axis, numbers in zip(plants.axes, plants.numbers[row], strict=True)
    }
    return {
        "kind": "linear", "name": plants.names[row], **axes, "cross": plants.cross[row].tolist(),
        "numerator": plants.numerator[row].tolist(), "denominator": plants.denominator[row].tolist(),
        "delay_samples": plants.delay[row].tolist(), "sample_time_s": plants.sample_time,
    }  # fmt: skip


def _structured_describer(row: StructuredResult) -> Describe:
    at = float(row.frequency[int(np.argmax(row.upper))])
    facts = {"kind": "box", "name": "the whole box", "axis": row.axes, "frequency_rad_s": at}
    return lambda _: facts


def _step_describer(evidence: Evidence, name: str) -> Describe:
    worse = evidence.steps.worse[name]
    return lambda row: {**plant_facts(evidence.stepped, row), "axis": evidence.stepped.axes[int(worse[row])]}


def _neck_describer(evidence: Evidence, controller: ControllerUnderTest, asked: Requirements) -> Describe:
    def describe(row: int) -> dict[str, Any]:
        run, at = evidence.necks[row], step_time(controller.block, asked)
        size = float(asked.sim["size_deg"])
        parameters = {} if run.parameters is None else neck_changes(run.parameters, controller.robot)
        middle, shares = start_of(controller.robot), direction(run.orientation, controller.robot)
        return {
            "kind": "own" if run.parameters is None else "neck", "name": run.name, "parameters": parameters,
            "payload_kg": run.payload,
            **{f"{name}_{error_unit(controller.robot)[0]}": float(asked.scale.shown(there)) + size * share
               for name, there, share in zip(controller.robot.outputs.names, middle, shares, strict=True)},
            "seed": run.seed, "at_s": at, "duration_s": at + float(asked.sim["duration_s"]),
            "sample_time_s": controller.block.sample_time, "order": controller.order,
        }  # fmt: skip

    return describe


def worst_row(values: Mapping[str, Values], metric: str, bound: str) -> int:
    """Return the row of the worst value of a metric: NaN first, then the smallest for "min", else the largest."""
    found = values[metric].values
    # Both take the first NaN.
    return int(np.argmin(found) if bound == "min" else np.argmax(found))
