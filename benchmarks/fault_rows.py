"""What happens today in each row that the first fault table lacked: `python benchmarks/fault_rows.py [--seed 1]`.

In virtual time, a PI loop or set-points on the paper's neck; rows that need excitation are played until they had it.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from softneck.core import CheckFailedError
from softneck.drives import default_drives, preflight, scan
from softneck.drives.simulated._profiles import PROFILES
from tests.drives.broken import ROWS, play_all
from tests.drives.test_switched_off import short_run, slow
from tests.drives.test_who_is_there import ShortQueue, linked, with_twin, without


def supervised(seed: int) -> Iterator[tuple[str, str]]:
    """Yield each row of the supervisor's, and its event."""
    for name, found in play_all(ROWS, seed, payload=0.1):
        moved = f", {math.degrees(found.beyond):.1f} deg beyond the path"
        yield name, f"{found.event} after {found.after:.2f} s{moved}" if found.event else f"no event{moved}"


def told(job: Callable[[], str]) -> str:
    """Return what `job` says, or the line with which it is refused."""
    try:
        return job()
    except CheckFailedError as error:
        return f"refused: {error}"


def twins() -> str:
    """Start on a bus with two devices at node 2."""
    several = [item["node"] for item in scan(with_twin()) if len(item["serials"]) > 1]
    return f"scan: several devices at node {several}; " + told(
        lambda: _checked(preflight(with_twin(), default_drives()))
    )


def _checked(report: object) -> str:
    report.require()  # type: ignore[attr-defined]
    return "accepted"


def answers(delay: float) -> str:
    """Run where each SDO answer comes late."""
    link = slow("ipos2015", delay)

    def run() -> str:
        ended = short_run(link, "ipos2015")
        ended.require()
        link.receive(0.5)
        return f"{ended.master.supervisor.phase}, faults of the drives {[d.axis.fault for d in link.neck.drives]}"

    return told(run)


def queue() -> str:
    """Scan by an adapter that holds ten frames."""
    link = ShortQueue(default_drives())
    return f"scan: nodes {[item['node'] for item in scan(link)]}, at most {link.most} frames in the queue"


def heartbeat_only() -> str:
    """Check drives that have no life guarding."""
    kept = PROFILES["ds402"]
    PROFILES["ds402"] = lambda: without(0x100C, 0x100D)  # type: ignore[index]
    try:
        file = default_drives("ds402")
        report = preflight(linked(file), file)
        return told(lambda: f"{_checked(report)}, guarded by {report.guarding}")
    finally:
        PROFILES["ds402"] = kept  # type: ignore[index]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    for name, what in supervised(parser.parse_args().seed):
        print(f"{name:36}{what}", flush=True)
    print(f"{'two devices on one node id':36}{twins()}")
    for delay in (0.03, 0.05):
        print(f"{f'SDO answers of {1e3 * delay:.0f} ms':36}{answers(delay)}", flush=True)
    print(f"{'transmit queue of 10 frames':36}{queue()}")
    print(f"{'drives without 100Ch':36}{heartbeat_only()}")


if __name__ == "__main__":
    main()
