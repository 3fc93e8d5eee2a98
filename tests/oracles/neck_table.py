"""Steps of the virtual neck under a controller: every orientation with every payload, judged on the true angle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Protocol

from softneck.core import SettingsError, SoftneckError, require_between, require_one_of
from softneck.loop import BlockPart, Loop, LoopResult, Part, RobotReference, metrics, run_loop
from softneck.loop._loop import ORDERS
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block

# What the figures are judged by: name in the table, name in `softneck.loop.metrics`, bound, unit.
# The lab's own loop on the real neck, 15 deg: 7.4 to 21.4 %, 0.28 to 0.42 s, 0.19 to 0.34 deg.
FIGURES: dict[str, tuple[str, float, str]] = {
    "overshoot": ("overshoot_pct", 5.0, "%"),
    "rise": ("rise_s", 0.45, "s"),
    "steady": ("steady_rms_deg", 0.2, "deg"),
}
_AXES = ("pitch", "roll")


class HasBlock(Protocol):
    """A controller or observer that is a block."""

    def block(self) -> Block:
        """Return the block."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class NeckSteps:
    """The steps that a controller is judged on.

    Attributes:
        size: of the step of inclination [rad].
        orientations: directions of the step [rad]; 0 is pitch alone.
        payloads: on the platform [kg], there from the start.
        at: time of the step [s]; before it the loop brings the neck to the vertical.
        duration: of each run [s].
        sensor: inclinometer of the virtual neck.
        neck: preset, or a neck file.
        order: of the loop.
        cocontraction: its reference delta_i [rad].
        seed: of the sensor's noise in the first run; each further run has the next.
    """

    size: float = math.radians(15.0)
    orientations: tuple[float, ...] = (0.0, math.radians(45.0), math.radians(90.0))
    payloads: tuple[float, ...] = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
    at: float = 2.0
    duration: float = 8.0
    sensor: str = "3dm-gx5"
    neck: str = "paper"
    order: str = "sequential"
    cocontraction: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        require_between("size", self.size, 0.001, 0.8, "rad")
        if not self.orientations or not self.payloads:
            raise SettingsError("give at least one orientation and one payload.")
        for payload in self.payloads:
            require_between("payloads", payload, 0.0, 5.0, "kg")
        require_between("at", self.at, 0.0, 1e4, "s")
        require_between("duration", self.duration, self.at + 1.0, 1e5, "s")
        require_between("cocontraction", self.cocontraction, -6.0, 6.0, "rad")
        require_one_of("order", self.order, ORDERS)

    def parameters(self) -> NeckParameters:
        """Return the neck's numbers."""
        return NeckParameters.preset(self.neck).with_sensor(self.sensor)

    def cases(self) -> list[tuple[float, float]]:
        """Return orientation [rad] and payload [kg] of every run."""
        return [(orientation, payload) for orientation in self.orientations for payload in self.payloads]


@dataclass(frozen=True, slots=True, kw_only=True)
class NeckCase:
    """One run.

    Attributes:
        orientation: [rad].
        payload: [kg].
        overshoot: [%], the larger of the axes that step.
        rise: 10 to 90 % [s], the larger of the axes that step; infinite where 90 % is never reached.
        steady: rms error over the last quarter [deg], the larger of both axes.
    """

    orientation: float
    payload: float
    overshoot: float
    rise: float
    steady: float


@dataclass(frozen=True, slots=True, kw_only=True)
class NeckRow:
    """What one controller did in all cases, or why it was not tried.

    Attributes:
        name: of the controller.
        cases: its runs; none if it was skipped.
        skipped: why, or "".
    """

    name: str
    cases: tuple[NeckCase, ...] = ()
    skipped: str = ""

    def worst(self, figure: str) -> float:
        """Return the largest "overshoot" [%], "rise" [s] or "steady" [deg]."""
        return max(getattr(case, figure) for case in self.cases)

    def median(self, figure: str) -> float:
        """Return the median of "overshoot" [%], "rise" [s] or "steady" [deg]."""
        return float(median(getattr(case, figure) for case in self.cases))

    @property
    def holds(self) -> bool:
        """Whether every case keeps every bound of `FIGURES`."""
        return bool(self.cases) and all(self.worst(name) <= bound for name, (_, bound, _) in FIGURES.items())


NECK_HEAD = ("controller", "overshoot [%]", "rise [s]", "steady rms [deg]", "all cases")


def neck_table(
    controllers: Mapping[str, HasBlock | Part],
    observer: HasBlock | Part | None,
    steps: NeckSteps | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
) -> list[NeckRow]:
    """Return a row for each controller; one that fails gets the reason instead of figures.

    Args:
        controllers: by name, each with `block()` or a part of a loop.
        observer: between the inclinometer and the controllers; None for none.
        steps: what they are judged on.
        parameters: of all controllers, such as `lead_limit`.
    """
    steps = NeckSteps() if steps is None else steps
    return [
        neck_row(name, controller, observer, steps, parameters=parameters) for name, controller in controllers.items()
    ]


def neck_row(
    name: str,
    controller: HasBlock | Part,
    observer: HasBlock | Part | None,
    steps: NeckSteps,
    *,
    parameters: Mapping[str, float] | None = None,
) -> NeckRow:
    """Return the row of one controller."""
    try:
        cases = tuple(
            _case(neck_step(controller, observer, steps, i, parameters=parameters), steps.cases()[i])
            for i in range(len(steps.cases()))
        )
    except SoftneckError as error:
        return NeckRow(name=name, skipped=str(error))
    return NeckRow(name=name, cases=cases)


def neck_step(
    controller: HasBlock | Part,
    observer: HasBlock | Part | None,
    steps: NeckSteps,
    case: int,
    *,
    parameters: Mapping[str, float] | None = None,
) -> LoopResult:
    """Return the signals of run number `case` of `steps.cases()`; `parameters` are the controller's."""
    orientation, payload = steps.cases()[case]
    plant = VirtualNeck(steps.parameters()).block(noise_seed=steps.seed + case)
    # cos(90 deg) is 6e-17: an axis that does not step must not count as one that does.
    pitch, roll = (
        steps.size * (0.0 if abs(part) < 1e-9 else part) for part in (math.cos(orientation), math.sin(orientation))
    )
    return run_loop(
        Loop(
            plant=BlockPart(plant),
            controller=_part(controller),
            observer=None if observer is None else _part(observer),
            reference=_Step(pitch=pitch, roll=roll, at=steps.at, cocontraction=steps.cocontraction),
            duration=steps.duration,
            order=steps.order,
            plant_inputs={"payload": payload},
            controller_parameters=parameters or {},
        )
    )


def table_cells(rows: Sequence[NeckRow]) -> list[tuple[str, ...]]:
    """Return the rows as text under `NECK_HEAD`, worst and median of each figure."""
    cells = []
    for row in rows:
        if row.skipped:
            cells.append((row.name, "-", "-", "-", f"skipped: {row.skipped}"))
            continue
        figures = [
            f"{row.worst(name):.{places}f} ({row.median(name):.{places}f})"
            for name, places in (("overshoot", 1), ("rise", 2), ("steady", 2))
        ]
        cells.append((row.name, *figures, "hold" if row.holds else "do not hold"))
    return cells


def _case(result: LoopResult, case: tuple[float, float]) -> NeckCase:
    found, (orientation, payload) = metrics(result), case
    stepped = [axis for axis in _AXES if found[axis]["overshoot_pct"] is not None]
    values: dict[str, Any] = {
        name: max(_known(found[axis][key]) for axis in (_AXES if name == "steady" else stepped))
        for name, (key, _, _) in FIGURES.items()
    }
    return NeckCase(orientation=orientation, payload=payload, **values)


def _known(value: float | None) -> float:
    return math.inf if value is None else value


def _part(thing: HasBlock | Part) -> Part:
    """Return a part that a loop can step; a part is taken as it is."""
    return thing if hasattr(thing, "advance") else BlockPart(thing.block())  # pyright: ignore


@dataclass(frozen=True, slots=True, kw_only=True)
class _Step:
    """A step of the angles at `at`, with a co-contraction that is there from the start."""

    pitch: float
    roll: float
    at: float
    cocontraction: float

    def __call__(self, time: float, /) -> tuple[float, float, float]:
        """Return the reference at `time` [s]."""
        step = RobotReference(kind="step", values=(self.pitch, self.roll), at=self.at)(time)
        return step[0], step[1], self.cocontraction
