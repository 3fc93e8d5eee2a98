"""Print the free-run fits of docs/howto/which_model.md and docs/theory/set_membership.md.

`python benchmarks/free_run_fits.py forms [PRESET]`: both forms of set membership on preset `paper` or another, from
Eq. 22 and `mixed`, with what their bounds hold and their mean half-width.
`python benchmarks/free_run_fits.py necks [SEED...]`: every kind with its defaults on necks drawn around `paper`
(seeds 100 to 102), trained on Eq. 22.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from softneck.core import silent
from softneck.identification import (
    INFINITE,
    GreyBox,
    Network,
    OutputError,
    Play,
    Rls,
    SetMembership,
    Validation,
    validate,
)
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.report._demo_steps import record_experiments
from softneck.signals import Recording, signal


def main(what: str, which: list[str]) -> None:
    """Run one of the two tables."""
    if what == "forms":
        forms(*which)
    else:
        for seed in which or ("100", "101", "102"):
            necks(int(seed))


def forms(preset: str = "paper") -> None:
    """Print both forms of set membership: fits, coverage and half-widths."""
    neck = NeckParameters.preset(preset)
    data, tests = experiments(neck)
    mixed = record(signal("mixed", duration=140.0), VirtualNeck(neck), seed=1)
    for name, training in {"eq22": data, "mixed": mixed}.items():
        for form in ("paper_eq21", "residual"):
            model = SetMembership(form=form).fit(training)
            for test, recording in tests.items():
                result = validate(model, recording, horizons=(1, INFINITE))
                held = pair(result.coverage_pct)
                width = pair({axis: full / 2 for axis, full in (result.mean_width_deg or {}).items()})
                print(name, form, test, fits(result), f"bounds hold {held} %, {width} deg", flush=True)


def necks(seed: int) -> None:
    """Print every kind on the neck that `seed` draws."""
    data, tests = experiments(NeckParameters.paper().sample(np.random.default_rng(seed)))
    kinds: dict[str, Any] = {
        "rls": Rls(), "oe": OutputError(), "nlsm residual": SetMembership(form="residual"),
        "play": Play(), "greybox": GreyBox(), "nn": Network(),
    }  # fmt: skip
    for name, estimator in kinds.items():
        model = estimator.fit(data)
        row = [f"{test} {fits(validate(model, recording))}" for test, recording in tests.items()]
        print(seed, name, *row, flush=True)


def experiments(neck: NeckParameters) -> tuple[Recording, dict[str, Recording]]:
    """Return the 7,000 rows to train on, and validation and the three tests, with the demo's seeds."""
    recorded = record_experiments(neck, duration=200.0, tell=lambda _: silent)
    return recorded.identification, recorded.judged


def fits(result: Validation) -> str:
    """Return the free-run fits of pitch and roll [%]."""
    return pair(result.fits[INFINITE])


def pair(values: Mapping[str, float | None] | None) -> str:
    """Return two numbers as docs print them."""
    return "/".join("-" if value is None else f"{value:.1f}" for value in (values or {}).values())


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "forms", sys.argv[2:])
