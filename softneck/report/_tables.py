"""The demo's tables: ours beside the paper's, like with like."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softneck.cosim import Result
from softneck.identification import INFINITE, Validation

from . import _paper
from ._closing import limits_of
from ._experiments import ValidationPair
from ._packaging import TOLERANCE, PackagedFmu

Head = list[str]
Rows = list[list[str]]
FIT_HEAD = [
    "model on data", "persistence", "one step", "paper, one step", "free run", "paper, free run",
    "free, measured motors", "paper, same", "free run on rough",
]  # fmt: skip
FIT_NOTE = (
    "Fit 100 (1 - |y - yhat| / |y - mean y|) in %, pitch/roll. Persistence repeats the last sample: a one-step fit "
    "that is not above it says nothing. The free run has the set-points alone; that is what an FMU of the plant does. "
    "The paper's SM and NN figures of Tables 3 and 4 are one step ahead, its RLS figures free runs; its section 7.4 is "
    "free run with measured motors. The paper's plant is the real neck, ours the virtual one. nlsm is set membership "
    "over the paper's Eq. 21; nlsm_residual, which the paper does not have, is set membership on what the free run of "
    "rls leaves over: nothing is fed back, so it cannot drift. The last column is of the same kind, identified anew on "
    "the preset rough, which a line follows no better than the paper's neck."
)


def fit_rows(judged: Mapping[tuple[str, str], ValidationPair], rough: Mapping[tuple[str, str], Validation]) -> Rows:
    """Return one row for each model and recording."""
    rows = []
    for (model, data), result in judged.items():
        key = (model, data)
        rows.append(
            [
                f"{model} on {data}",
                _pair(result.free.persistence["1"]),
                _pair(result.free.fits["1"]),
                _published(_paper.ONE_STEP.get(key)),
                _pair(result.free.fits[INFINITE]),
                _published(_paper.FREE_RUN.get(key)),
                _pair(result.measured.fits[INFINITE]),
                _published(_paper.FREE_RUN_MEASURED.get(key)),
                _pair(rough[key].fits[INFINITE]) if key in rough else "",
            ]
        )
    return rows


def fmu_rows(packaged: Mapping[str, PackagedFmu]) -> tuple[Head, Rows]:
    """Return one row for each FMU: how far its free run is from the Python model's."""
    rows = [
        [name, item.path.name, str(item.rows), f"{item.difference:.1e}", "holds" if item.equal else "fails"]
        for name, item in packaged.items()
    ]
    return ["model", "FMU", "samples", "largest difference", f"at most {TOLERANCE:g}"], rows


def loop_rows(loops: Mapping[str, Result]) -> tuple[Head, Rows]:
    """Return one row for each limit of each loop."""
    rows = [
        [
            f"{name}: {row['metric']}",
            "-" if row["value"] is None else f"{row['value']:.3f}",
            f"{row['limit']:g}",
            "holds" if row["holds"] else "fails",
        ]
        for name, row in limits_of(loops)
    ]
    return ["loop and metric", "value", "limit", "verdict"], rows


def demo_json(
    judged: Mapping[tuple[str, str], ValidationPair],
    rough: Mapping[tuple[str, str], Validation],
    packaged: Mapping[str, PackagedFmu],
    loops: Mapping[str, Result],
) -> dict[str, Any]:
    """Return the same as JSON values."""
    return {
        "models": [
            result.free.as_dict() | {"free_run_measured_motors": result.measured.fits[INFINITE]}
            for result in judged.values()
        ],
        "models_on_rough": [result.as_dict() for result in rough.values()],
        "fmus": {
            name: {"fmu": str(item.path), "rows": item.rows, "max_difference": item.difference, "holds": item.equal}
            for name, item in packaged.items()
        },
        "loops": {name: result.report() for name, result in loops.items()},
    }


def score_line(judged: Mapping[tuple[str, str], ValidationPair], model: str) -> str:
    """Return a model's free-run fits as text for its FMU."""
    lines = ["free-run fit from set-points alone [%], pitch/roll"]
    lines += [f"{data}: {_pair(r.free.fits[INFINITE])}" for (name, data), r in judged.items() if name == model]
    return "\n".join(lines)


def _pair(values: Mapping[str, float | None]) -> str:
    return "/".join("-" if value is None else f"{value:.1f}" for value in values.values())


def _published(pair: tuple[float, float] | None) -> str:
    return "" if pair is None else f"{pair[0]:.1f}/{pair[1]:.1f}"
