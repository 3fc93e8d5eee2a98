"""Print how well `validity` foretells errors within 2 deg on excitations never seen: Brier score and reliability.

`python benchmarks/validity.py [NECK...] [--kinds KIND...] [--seed N]`

Models are trained on 140 s of Eq. 22 and judged on other excitations in free run. The base rate beside each score is
that of who knows how often these very rows stay within the tolerance and nothing else: no model can know that before.
Nothing is chosen here; that is done by `leave_one_neck_out.py validity.*`, whose folder keeps the models as well.
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.leave_one_neck_out import Run, fitted
from softneck.core import KINDS, Matrix, resolve
from softneck.identification import Model
from softneck.identification.models._model import WARM_UP
from softneck.identification.models._validity import tolerance_of, with_validity_region
from softneck.identification.validation._error_statistics import reliability
from softneck.signals import Recording, signal
from tests.foreign_necks.necks import CHOOSING

TESTS = {"steps": None, "sine": None, "rotation": None, "aprbs": 40.0, "multisine": 40.0}


def judged(model: Model, test: Recording) -> tuple[Matrix, np.ndarray]:
    """Return validity and whether all errors were within the tolerance, in free run behind the warm-up (rows,)."""
    outputs, allowed = model.simulate(test)[WARM_UP:], tolerance_of(model)
    held = (np.abs(test.outputs[WARM_UP:] - outputs[:, :2]) <= allowed).all(axis=1)
    return outputs[:, -1], np.asarray(held)


def main() -> None:
    """Read the command line, train, and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("necks", nargs="*", default=["chain", "foam"], help=", ".join(CHOOSING))
    parser.add_argument("--kinds", nargs="+", default=["oe", "greybox", "nn"])
    parser.add_argument("--seed", type=int, default=0, help="of the sensor's noise (0)")
    wanted = parser.parse_args()
    print(f"{'kind':>10}{'neck':>9}{'test':>11}{'mean':>7}{'held':>7}{'Brier':>8}{'base rate':>11}")
    for kind in wanted.kinds:
        everything = []
        for name in wanted.necks:
            run = Run(name, wanted.seed, 0)
            train = run(signal("eq22"), 1).rows(0, 7000)
            # Trained once; what it takes for granted beyond is today's.
            model = with_validity_region(fitted(resolve(KINDS[kind].settings)(), run, train), train)
            for number, (test, duration) in enumerate(TESTS.items(), start=2):
                everything.append(judged(model, run(signal(test, duration=duration), number)))
                _line(kind, name, test, *everything[-1])
        predicted, held = (np.concatenate(parts) for parts in zip(*everything, strict=True))
        _line(kind, "all", "all", predicted, held)
        bins = ", ".join(f"{b['predicted']:.2f}: {b['held']:.2f}" for b in reliability(predicted, held))
        print(f"{'':>10} predicted: observed  {bins}", flush=True)


def _line(kind: str, neck: str, test: str, predicted: Matrix, held: np.ndarray) -> None:
    brier, base = np.mean((predicted - held) ** 2), held.mean() * (1.0 - held.mean())
    print(f"{kind:>10}{neck:>9}{test:>11}{predicted.mean():7.2f}{held.mean():7.2f}{brier:8.3f}{base:11.3f}", flush=True)


if __name__ == "__main__":
    main()
