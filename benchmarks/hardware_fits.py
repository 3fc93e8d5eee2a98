"""Print the tables of docs/howto/which_model.md on recordings from hardware, which are no part of the project.

`python benchmarks/hardware_fits.py FOLDER [--data arm payload] [KIND...]`, FOLDER holding `arm_multisine` and
`neck_closedloop` as the lab published them (HUMASoft/Soft-Arm @ faf9a760, HUMASoft/Data-and-Results @ 704ab9ab).

The arm: train on rows 1 to 13,000, test on the rest; yaw drifts, so read pitch. The neck in closed loop: train on
0 and 1000 g, test on 400 g. Every kind has its defaults, each linear one as many poles as its hold-out asks for.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from pathlib import Path

from softneck.core import KINDS, SoftneckError, resolve
from softneck.identification import INFINITE, Model, OutputError, SetMembership, validate
from softneck.signals import Recording, concatenate, import_log, read_layout

LAYOUTS = Path(__file__).parents[1] / "examples" / "layouts"
ALL = ("rls", "oe", "oe best", "nlsm", "play", "nn", "greybox")
_HOLD_OUT = 0.8


def arm(folder: Path) -> tuple[Recording, Recording]:
    """Return what to train on and what to test on."""
    layout = dataclasses.replace(read_layout(LAYOUTS / "arm_multisine.toml"), rows=(0, 20_000))
    whole = import_log(folder / "arm_multisine" / "arm_multisine_400s.csv", layout).recording
    return whole.rows(0, 13_000), whole.rows(13_000, 20_000)


def payload(folder: Path) -> tuple[Recording, Recording]:
    """Return 0 and 1000 g to train on, 400 g to test on."""
    layout = read_layout(LAYOUTS / "neck_closedloop.toml")
    names = ("000", "1000", "400")
    read = [import_log(folder / "neck_closedloop" / f"frontier_test_{m}gr.csv", layout).recording for m in names]
    return concatenate(read[:2]), read[2]


def trained(kind: str, train: Recording) -> Model:
    """Return a model with the kind's defaults."""
    if kind == "oe best":
        return best_linear(train)
    return SetMembership(form="residual").fit(train) if kind == "nlsm" else resolve(KINDS[kind].settings)().fit(train)


def best_linear(train: Recording) -> Model:
    """Return the output-error model whose poles and source are best in free run on the last fifth of the rows."""
    head, tail = train.split(_HOLD_OUT)
    choices = [OutputError(nf=n, nb=n, source=s) for n in (1, 2, 3) for s in ("set_points", "positions")]

    def score(settings: OutputError) -> float:
        try:
            fits = validate(settings.fit(head), tail, horizons=(INFINITE,)).fits[INFINITE]
        except SoftneckError:
            return float("-inf")
        return fits["pitch"] if fits["pitch"] is not None else float("-inf")

    return max(choices, key=score).fit(train)


def main() -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("kinds", nargs="*", default=ALL)
    parser.add_argument("--data", nargs="+", default=["arm", "payload"], choices=["arm", "payload"])
    wanted = parser.parse_args()
    for data in wanted.data:
        train, test = (arm if data == "arm" else payload)(wanted.folder)
        for kind in wanted.kinds:
            wall, cpu = time.perf_counter(), time.process_time()
            try:
                model = trained(kind, train)
            except SoftneckError as error:
                print(data, kind, error, flush=True)
                continue
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            judged = validate(model, test, horizons=(1, INFINITE))
            fits = [
                "/".join("-" if v is None else f"{v:.1f}" for v in judged.fits[h].values()) for h in (INFINITE, "1")
            ]
            print(
                f"{data} {kind}: free run {fits[0]}, one step {fits[1]}; {wall:.1f} s, {cpu:.1f} s of processor",
                flush=True,
            )


if __name__ == "__main__":
    main()
