"""All pairs of planted mistakes through `softneck drives commission`'s moves: named, put right, and the true tilt.

`python benchmarks/commissioning.py [--most N]` goes on where it was stopped (build/commissioning.jsonl; as many
pairs as N in this call, drawn at random, always in the same order) and prints the table.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.drives.commissioning.commissioned import agrees, commissioned
from tests.drives.commissioning.test_commission import MIRROR, all_pairs, named

KEPT = Path("build/commissioning.jsonl")


def main() -> None:
    """Play what is left, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--most", type=int, default=1000)
    left = parser.parse_args().most
    KEPT.parent.mkdir(parents=True, exist_ok=True)
    lines = KEPT.read_text(encoding="utf-8").splitlines() if KEPT.exists() else []
    done = {tuple(item["pair"]): item for item in map(json.loads, lines)}
    pairs = [*all_pairs(), tuple(sorted(MIRROR))]
    for pair in random.Random(0).sample(pairs, len(pairs)):
        if pair in done or left <= 0:
            continue
        left -= 1
        run = commissioned(pair)
        item = {"pair": pair, "named": [named(run, mistake) for mistake in pair], "right": agrees(run),
                "tilt": run.truth.largest, "told": sorted(run.names)}  # fmt: skip
        done[pair] = item
        with KEPT.open("a", encoding="utf-8") as file:
            file.write(json.dumps(item) + "\n")
    print(f"{'pair':34}{'named':>7}{'put right':>11}{'tilt [deg]':>12}  told")
    for (one, other), item in done.items():
        both, right = sum(item["named"]), "yes" if item["right"] else "no"
        print(f"{one + ' + ' + other:34}{both:5}/2{right:>11}{item['tilt']:12.2f}  {', '.join(item['told'])}")
    both = sum(all(item["named"]) for item in done.values())
    right = sum(item["right"] for item in done.values())
    most = max((item["tilt"] for item in done.values()), default=0.0)
    told = f"both named in {both}, put right in {right}, {most:.2f} deg at most"
    print(f"{len(done)} of {len(all_pairs()) + 1} pairs: {told}")


if __name__ == "__main__":
    main()
