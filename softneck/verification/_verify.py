"""Verify a controller on every plant, requirement by requirement, and write its certificate."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import (
    Progress,
    ReprMixin,
    SettingsError,
    certificate_contents,
    one_blas_thread,
    shown_progress,
    to_json,
)
from softneck.design import own_object
from softneck.estimation import robot_of
from softneck.plant import NeckParameters, VirtualNeck
from softneck.robot import Robot, load_for_robot
from softneck.signals import require_same_robot

from ._evidence import Evidence, gather, worst_row
from ._experiments import crossing_values
from ._linear import ControllerUnderTest, controller_under_test
from ._metrics import Scale
from ._neck_loops import (
    ALONE,
    check_blocks,
    is_simulation_model,
    make_simulation_model,
    named_plants,
    unrecorded_conditions,
)
from ._plants import PlantSource, source_of_family, source_of_model
from ._requirements import Requirement, Requirements, expand_metrics, make_requirements, read_requirements
from ._steps import check_ports
from ._worst import write_linear, write_neck


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Verdict(ReprMixin):
    """The verdict on one requirement.

    `requirement`: metric, bound and limit. `value`: of the worst plant; inf where a level is never reached, None if not
    computed. `holds`: None for a default on simulated loops that no plant shows. `worst`: the worst plant, as JSON
    values. `note`: why it was not computed, does not count or does not hold.
    """

    requirement: Requirement
    value: float | None
    holds: bool | None
    worst: Mapping[str, Any]
    note: str = ""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Verification(ReprMixin):
    """Result of a verification: each requirement with its worst plant.

    Attributes:
        verdicts: one for each requirement.
        evidence: all results.
        controller: under test.
        necks: sources of plants.
        requirements: of the verdicts.
        files: role -> (path, SHA-256) of every file read.
        observer: whether the simulated loops had one.
        wall_time: [s].
        tested: name of a family -> facts on the recordings that it was tested against.
    """

    verdicts: list[Verdict]
    evidence: Evidence
    controller: ControllerUnderTest
    necks: list[PlantSource]
    requirements: Requirements
    files: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    observer: bool
    wall_time: float = 0.0
    tested: Mapping[str, Any] = field(default_factory=dict)

    @property
    def holds(self) -> bool:
        """Whether no requirement fails and one is judged at least: where nothing was computed nothing holds."""
        found = {verdict.holds for verdict in self.verdicts}
        return True in found and False not in found

    @property
    def failed(self) -> list[Verdict]:
        """The failed requirements."""
        return [verdict for verdict in self.verdicts if verdict.holds is False]

    def order_words(self) -> str:
        """Return a text about the delay that the loop's order adds."""
        extra = self.controller.extra
        words = "no sample" if extra == 0 else f"{extra} sample{'s' if extra > 1 else ''}"
        return f"{self.controller.order} order: {words} of delay added to every plant"

    def summary(self) -> str:
        """Return a summary of one line."""
        count, absent = len(self.verdicts), sum(verdict.value is None for verdict in self.verdicts)
        held = sum(verdict.holds is True for verdict in self.verdicts)
        text = f"{held} of {count} requirements hold" if held < count else f"all {count} requirements hold"
        text += f", {absent} {'is' if absent == 1 else 'are'} not computed" if absent else ""
        text += "".join(f"; {part.statement()}" for part in self.evidence.drawn)
        return (
            f"{text}; {len(self.evidence.plants)} plants, {len(self.evidence.necks)} simulated loops, "
            f"{self.order_words()}; {self.wall_time:.1f} s"
        )

    def contents(
        self, loops: Mapping[int, Path] | None = None, further: Mapping[str, Any] | None = None
    ) -> dict[str, Any]:
        """Return the certificate's JSON values, under its seal.

        `loops` maps a verdict's number to the loop file of its worst plant; `further` are entries of the command.
        """
        rows = []
        for number, verdict in enumerate(self.verdicts):
            item = verdict.requirement
            row = {
                "metric": item.metric, "bound": item.bound, "limit": item.limit, "value": verdict.value,
                "holds": verdict.holds, "worst": dict(verdict.worst),
            }  # fmt: skip
            if verdict.note:
                row["note"] = verdict.note
            if loops and number in loops:
                row["loop"] = str(loops[number])
            rows.append(row)
        evidence, scale, robot = self.evidence, self.requirements.scale, self.controller.robot
        more = {
            "requirements": rows,
            "not_computed": evidence.not_computed,
            "order": self.controller.order,
            "extra_delay_samples": self.controller.extra,
            "sample_time_s": self.controller.block.sample_time,
            "controller_kind": self.controller.block.kind,
            "units": [robot.motors.unit, robot.outputs.unit],
            "observer": self.observer,
            "plants": {"count": len(evidence.plants), "sources": [_source_facts(neck) for neck in self.necks]},
            "virtual_neck_loops": len(evidence.necks),
            "foreign_plants": evidence.foreign,
            **validity(evidence, self.tested),
            "draws": [part.facts() for part in evidence.drawn],
            "settings": {name: self.requirements.table(name) for name in ("uncertainty", "sampling", "step", "sim")},
        }
        if robot.in_header():
            more["robot"] = {"name": robot.name, "hash": robot.hash}
            more["scale"] = {"time": scale.time, "size": scale.size}
        return certificate_contents(
            "verify", holds=self.holds, files=self.files, more=to_json(more | dict(further or {}))
        )

    def write_worst(
        self, folder: str | Path, *, controller: str | Path, observer: str | Path | None = None, force: bool = False
    ) -> dict[int, Path]:
        """Write a loop file for the worst plant of each requirement; return number of the verdict -> file.

        `controller` and `observer` are their files; `force` replaces existing loop files.
        """
        paths = Path(controller), None if observer is None else Path(observer)
        with _new_files_removed_on_failure(Path(folder)):
            return self._write_worst(Path(folder), *paths, force)

    def _source_of(self, plant: str) -> PlantSource:
        return next(source for source in self.necks if plant.startswith(f"{source.name}: "))

    def _write_worst(self, target: Path, controller: Path, observer: Path | None, force: bool) -> dict[int, Path]:
        files: dict[int, Path] = {}
        axes = self.controller.robot.outputs.names
        for number, verdict in enumerate(self.verdicts):
            worst, name = dict(verdict.worst), verdict.requirement.metric.replace(".", "_")
            if worst.get("kind") == "linear":
                facts = {
                    "name": worst["name"], "numerator": worst["numerator"], "denominator": worst["denominator"],
                    "delay": worst["delay_samples"], "cross": worst["cross"], "sample_time": worst["sample_time_s"],
                    "axis": axes.index(worst["axis"]) if worst["axis"] in axes else 0,
                }  # fmt: skip
                files[number] = write_linear(
                    target, name, facts, controller=controller, asked=self.requirements,
                    block=self.controller.block, weights=self._source_of(worst["name"]).weights, force=force,
                )  # fmt: skip
            elif worst.get("kind") == "neck":
                paths = controller, observer
                files[number] = write_neck(target, name, worst, *paths, robot=self.controller.robot, force=force)
        return files


@contextmanager
def _new_files_removed_on_failure(folder: Path) -> Iterator[None]:
    """Remove the files that were added to a folder inside, and the folder if it is new, where an error ends it."""
    known = set(folder.iterdir()) if folder.is_dir() else set[Path]()
    try:
        yield
    except BaseException:
        for path in set(folder.iterdir()) - known if folder.is_dir() else ():
            path.unlink(missing_ok=True)
        if not known:
            with suppress(OSError):  # it holds what others put there, or was never made
                folder.rmdir()
        raise


def with_robot(thing: Any, robot: Robot) -> Any:
    """Return a simulation model; a neck's physics are scaled to the robot."""
    return VirtualNeck.of(robot, thing) if isinstance(thing, NeckParameters) else thing


def sources_of(things: Mapping[str, Any], requirements: Requirements | None = None) -> list[PlantSource]:
    """Return linear models and families, by name, as sources of plants.

    The requirements give the uncertainty of a model; without them it is certain. Raises SettingsError: none, an empty
    family, one that is not linear.
    """
    if not things:
        raise SettingsError("no plant: give at least one MODEL or FAMILY.")
    keys = {"gain": ("gain_pct", 100.0), "pole": ("pole_pct", 100.0), "delay": ("delay_ms", 1e3)}
    asked = {} if requirements is None else requirements.uncertainty
    spread = {name: asked.get(key, 0.0) / unit for name, (key, unit) in keys.items()}
    necks = []
    for name, thing in things.items():
        if hasattr(thing, "axes") and hasattr(thing, "cross"):
            necks.append(source_of_family(thing, name))
        elif hasattr(thing, "tf"):
            necks.append(source_of_model(thing, name, spread))
        else:
            raise SettingsError(f"{name}: a linear model or a family is needed; this is a {type(thing).__name__}.")
    return necks


@one_blas_thread
def verify(
    controller: Any,
    plants: Any,
    requirements: Requirements | Mapping[str, Any] | str | Path | None = None,
    *,
    order: str | None = None,
    observer: Any = None,
    attempt: int = 1,
    files: Mapping[str, tuple[str, str]] | None = None,
    progress: Progress | None = None,
) -> Verification:
    """Verify a controller on all plants.

    Loops over the draws of a family decide, if it has them; its linear tests are then shown beside.

    Args:
        controller: an object with `block()` or `step`, or its file; linear checks need `ss()`.
        plants: linear models, families, simulation models, or their files: one, a list, or name -> one.
        requirements: beside the defaults: a file, a table like one, or flat as in `{"overshoot_pct": 5}`, which applies
            to the simulation models if there are any, else to the linear plants.
        order: of the loop; default that of the design.
        observer: in the simulated loops; default none.
        attempt: at a certificate over the same family, from 1 on; each has draws of its own and is counted.
        files: role -> (path, SHA-256) of the files read, for the certificate.
        progress: called now and then; default a bar in a terminal.

    Raises:
        SettingsError: another sample time, other channels, no plants.
        DataError: controller, plants and observer of two robots.

    Example:
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> from softneck.signals import signal
        >>> neck = softneck.VirtualNeck(NeckParameters.paper())
        >>> model = softneck.identify("rls", softneck.record(signal("eq22", duration=20.0), neck, seed=1))
        >>> asked = {"sampling": {"plants": 20, "search_generations": 0}, "sim": {"necks": 1}, "overshoot_pct": 20}
        >>> len(softneck.verify(softneck.design_controller("pi", model), {"rls": model}, asked).verdicts) > 10
        True
    """
    begin, controller = time.perf_counter(), load_for_robot(own_object(controller), "controller")
    observer = None if observer is None else load_for_robot(observer, "observer")
    robot, named = robot_of(controller), named_plants(plants)
    for what, thing in (*named.items(), *(() if observer is None else (("observer", observer),))):
        # Neck physics and user functions have no robot; their ports are checked instead.
        if hasattr(thing, "robot") or not is_simulation_model(thing):
            require_same_robot(robot_of(thing), robot, f"the controller and {what}")
    own = {name: with_robot(thing, robot) for name, thing in named.items() if is_simulation_model(thing)}
    linear = {name: thing for name, thing in named.items() if name not in own}
    scale = Scale.of(robot, sources_of(linear))
    if isinstance(requirements, Requirements):
        asked = requirements.at(scale)
    elif isinstance(requirements, Mapping):
        asked = make_requirements(expand_metrics(requirements, robot, stepping=bool(own)), scale=scale)
    else:
        asked = read_requirements(requirements, scale=scale)
    if any(getattr(thing, "draws", None) is not None for thing in linear.values()):
        asked = asked.over_draws()
    necks = sources_of(linear, asked)
    eyes = None if observer is None else observer.block()
    judged = controller_under_test(controller, order=order, observer=observer is not None)
    check_ports(judged.block, robot)
    check_blocks(judged.block, eyes)
    for neck in necks:
        if not math.isclose(neck.sample_time, judged.block.sample_time, rel_tol=1e-6):
            raise SettingsError(
                f"the controller has a sample time of {judged.block.sample_time:g} s, {neck.name} one of "
                f"{neck.sample_time:g} s; design it on a model of its own sample time."
            )
    step = [make_simulation_model(thing, name, robot) for name, thing in own.items()]
    with shown_progress("verify", progress) as tell:
        evidence = gather(
            judged, necks, asked, observer=eyes, progress=tell, families=linear, own=step, attempt=attempt
        )
    tested = {name: thing.findings["tested"] for name, thing in linear.items() if getattr(thing, "measured", {})}
    drawn = [make_simulation_model(item.draws.model, item.family, robot) for item in evidence.drawn]
    elsewhere = unrecorded_conditions(tested, [*step, *drawn], evidence.steps, robot)
    if tested and not judged.laws:
        elsewhere["margins"] = ALONE
    verdicts = [_verdict(item, evidence, elsewhere) for item in asked.bounds]
    return Verification(
        verdicts=verdicts, evidence=evidence, controller=judged, necks=necks, requirements=asked, tested=tested,
        files=dict(files or {}), observer=observer is not None, wall_time=time.perf_counter() - begin,
    )  # fmt: skip


def _verdict(item: Requirement, evidence: Evidence, elsewhere: Mapping[str, str]) -> Verdict:
    values = evidence.metrics.get(item.metric)
    if values is None:
        group = item.metric.partition(".")[0]
        group = "axes" if group in evidence.plants.axes else group
        why = evidence.not_computed.get(item.metric, evidence.not_computed.get(group, "it was not computed"))
        # No model may show it (a tension, a virtual plant, a linear form beside draws), which decides nothing; any
        # other does not hold.
        open_ = (group == "sim" or bool(evidence.drawn)) and not item.asked
        return Verdict(item, None, None if open_ else False, {}, f"not computed: {why}")
    row = worst_row(evidence.metrics, item.metric, item.bound)
    value = float(values.values[row])
    worst = to_json(values.describe(row))
    why = unsupported_reason(item, evidence, elsewhere)
    beside = bool(evidence.drawn) and not any(item.metric in part.values for part in evidence.drawn)
    if beside and not item.asked and not item.metric.startswith("sim.") and (why or not item.holds(value)):
        return Verdict(item, value, None, worst, _LINEAR_NOTE)
    if why:
        return Verdict(item, value, False, worst, why)
    if item.metric.startswith("sim.") and evidence.foreign and not item.asked:
        return Verdict(item, value, None, worst, _BUILT_IN_NOTE)
    return Verdict(item, value, item.holds(value), worst)


_BUILT_IN_NOTE = "shown only: this is a built-in plant; add a model of your robot to count it, or set `[sim] decides`"
_LINEAR_NOTE = "shown only: linear, all amplitudes at once; the draws of the family decide"
# Groups about the loop's response, which the data must support.
_LINEAR_GROUPS = ("stability", "axes", "mimo", "robust")


def unsupported_reason(item: Requirement, evidence: Evidence, elsewhere: Mapping[str, str]) -> str:
    """Return why the data do not support a requirement; else ""."""
    group, _, name = item.metric.partition(".")
    axes = evidence.plants.axes
    if group == "sim":
        missing = [part.unreached["sim"] for part in evidence.drawn if "sim" in part.unreached]
        return "" if evidence.foreign else [*missing, elsewhere.get("sim", "")][0]
    if any(item.metric in part.values for part in evidence.drawn):
        return elsewhere.get("loop", "")
    if group not in (*_LINEAR_GROUPS, "step", *axes):
        return ""
    parts = [part for part in evidence.tested if group not in axes or part.axis == group]
    reasons = [part.why() for part in parts if group != "step" or part.unheard]
    alone = elsewhere.get("margins", "") if name in ("gain_margin", "delay_margin_ms") else ""
    return next((reason for reason in (*reasons, alone, elsewhere.get("loop", "")) if reason), "")


def validity(evidence: Evidence, tested: Mapping[str, Any]) -> dict[str, Any]:
    """Return the validity of a certificate: band, amplitudes, confidence, recordings, margins."""
    bands = np.array([part.band for part in evidence.tested])
    amplitudes = [size for item in tested.values() for size in item["amplitude"] if size > 0.0]
    simulated = crossing_values(evidence.crossings)

    def least(values: Any, factor: float = 1.0) -> float | None:
        return None if values is None else factor * float(np.min(values))

    def linear(name: str) -> Any:
        parts = [part.margins[f"{axis}.{name}"].min() for part in evidence.linear for axis in part.plants.axes]
        return [*parts, *(part.margins[name] for part in evidence.tested if name in part.margins)] or None

    return {
        "band_rad_s": [bands[:, 0].max(), bands[:, 1].min()] if len(bands) else None,
        "amplitude_rad": [min(amplitudes), max(amplitudes)] if amplitudes else None,
        "confidence_level": min((item["confidence"] for item in tested.values()), default=None),
        "recordings": [
            {"family": family, "name": name, "sha256": digest}
            for family, item in tested.items() for name, digest in zip(item["names"], item["sha256"], strict=True)
        ],
        "margins": {
            "linear": {"gain_ratio": least(linear("gain_margin")), "delay_s": least(linear("delay_margin_ms"), 1e-3)},
            "simulated": {
                "gain_ratio": least(simulated.get("axes.gain_margin", (None,))[0]),
                "delay_s": least(simulated.get("axes.delay_margin_ms", (None,))[0], 1e-3),
            },
        },
    }  # fmt: skip


def _source_facts(neck: PlantSource) -> dict[str, Any]:
    found: dict[str, Any] = {"name": neck.name, "kind": neck.kind, "cross": neck.cross}
    for axis, box in zip(neck.names, neck.axes, strict=True):
        found[axis] = {"nominal": box.nominal, "low": box.low, "high": box.high, "samples": len(box.samples)}
        found[axis]["unit"] = [neck.gain_unit, "1/s", "s"]
    return found
