"""What `systemd_unit.py` plays in its guest, with nothing but the standard library: the service, seen from outside.

Prints one line for each promise of the unit, "yes" or "NO" first; exit code 1 if one did not hold.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

UNIT = "softneck-neck.service"
PROJECT = Path("/opt/neck")
PCI = Path("/sys/bus/pci/drivers/kvaser_pci")


class Bench:
    """Simulated drives on can1, and what systemd says of the unit."""

    def __init__(self, period: str, patience: float) -> None:
        """Start the drives; `patience` stretches all waiting [-]."""
        self.patience, self.failed = patience, 0
        self.changes: list[dict] = []
        words = [
            "-m",
            "softneck.drives.simulated",
            "socketcan:can1",
            "--homed",
            "--profile",
            "ds402",
            "--report",
            "--cycle",
            period,
        ]
        # They stand for hardware, which no other process holds up.
        self.drives = subprocess.Popen(
            ["chrt", "-f", "41", sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        threading.Thread(target=self._read, daemon=True).start()
        self.wait(lambda: len(self.changes) >= 3, 30.0)

    def _read(self) -> None:
        for line in self.drives.stdout or ():
            self.changes.append(json.loads(line))

    @property
    def states(self) -> list[str]:
        """State of each drive."""
        return [state for _, state in sorted({change["node"]: change["state"] for change in self.changes}.items())]

    def all(self, state: str) -> bool:
        """Whether all three are in `state`."""
        return self.states == [state] * 3

    def left(self, since: float) -> float:
        """When the last drive left Operation Enabled after `since` [s]."""
        times: dict[int, float] = {}
        for change in self.changes:
            if change["time_s"] >= since and change["state"] != "ENABLED":
                times.setdefault(change["node"], change["time_s"] - since)
        return max(times.values()) if len(times) == 3 else float("nan")

    def wait(self, done: Callable[[], bool], seconds: float) -> bool:
        """Wait until `done`; tell whether it was."""
        until = time.monotonic() + seconds * self.patience
        while not (held := done()) and time.monotonic() < until:
            time.sleep(0.02)
        return held

    def promise(self, text: str, held: bool, seen: object = "") -> None:
        """Print one line."""
        self.failed += not held
        print(f"{'yes' if held else 'NO'} {text}: {seen}", flush=True)
        if not held:
            run("journalctl", "-u", UNIT, "-n", "15", "--no-pager", "-o", "cat", show=True)


def run(*command: str, show: bool = False) -> tuple[int, str]:
    """Run a command; return exit code and output."""
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if show:
        print(done.stdout, end="", flush=True)
    return done.returncode, done.stdout.strip()


def shown() -> dict[str, str]:
    """Return what systemd says of the unit."""
    names = "ActiveState,Result,ExecMainStatus,ExecMainCode,MainPID,NRestarts,StatusText,WatchdogTimestampMonotonic"
    return dict(line.split("=", 1) for line in run("systemctl", "show", UNIT, "-p", names)[1].splitlines())


def brief(found: dict[str, str]) -> str:
    """Return how a run ended."""
    return (
        " ".join(found[name] for name in ("ActiveState", "Result", "ExecMainStatus"))
        + f", {found['NRestarts']} restarts"
    )


def softneck(*words: str) -> tuple[int, str]:
    """Run `softneck` as root, outside of the unit."""
    return run(
        "/opt/softneck/bin/softneck", *words, "--drives", str(PROJECT / "drives.toml"), "--bus", "socketcan:can0"
    )


def rests(bench: Bench, name: str, result: str) -> None:
    """The unit has failed for `result`, its drives are in Fault, and seconds later nothing has started."""
    bench.wait(lambda: shown()["ActiveState"] == "failed", 30.0)
    time.sleep(5.0)
    found = shown()
    good = (found["ActiveState"], found["Result"], found["NRestarts"]) == ("failed", result, "0")
    bench.promise(f"{name}: failed, nothing restarts", good and bench.all("FAULT"), f"{brief(found)}; {bench.states}")


def started_and_stopped(bench: Bench) -> None:
    """Start, signs of life, stop."""
    since = time.monotonic()
    code, said = run("systemctl", "start", UNIT)
    found = shown()
    bench.promise("READY=1 ends the start", code == 0 and found["ActiveState"] == "active",
                  f"{found['ActiveState']} after {time.monotonic() - since:.1f} s {said}")  # fmt: skip
    running = bench.wait(lambda: shown()["StatusText"] == "running", 30.0)
    bench.promise("STATUS tells the phase, drives are enabled", running and bench.all("ENABLED"), bench.states)
    user = run("ps", "-o", "user=,cls=,rtprio=", "-p", found["MainPID"])[1]
    bench.promise("not root, before all ordinary processes", user.split()[:2] == ["softneck", "FF"], user)
    fed = int(shown()["WatchdogTimestampMonotonic"])
    time.sleep(1.0)
    gap = (int(shown()["WatchdogTimestampMonotonic"]) - fed) * 1e-6
    bench.promise("WATCHDOG=1 comes again and again", gap > 0.0, f"{gap:.2f} s later")
    run("systemctl", "stop", UNIT)
    found, ended = shown()["ActiveState"], (PROJECT / "ended").read_text().split()
    good = (found, ended) == ("inactive", ["success", "exited", "143"])
    bench.promise("stop: exit code 143, a success, drives off", good and bench.all("DISABLED"),
                  f"{found} {' '.join(ended)}; {bench.states}")  # fmt: skip


def hung(bench: Bench) -> None:
    """The loop hangs; the drives fault by themselves, and systemd ends the process."""
    run("systemctl", "start", UNIT)
    bench.wait(lambda: shown()["StatusText"] == "running", 30.0)
    (PROJECT / "hang").touch()
    bench.wait((PROJECT / "hung").exists, 30.0)
    time.sleep(0.1)
    since = float((PROJECT / "hung").read_text())
    rests(bench, "a hung loop is killed by the watchdog", "watchdog")
    reaction = bench.left(since)
    bench.promise("its drives stopped before", reaction < 0.5, f"{1e3 * reaction:.0f} ms after the hang")
    for name in ("hang", "hung"):
        (PROJECT / name).unlink(missing_ok=True)
    enabled = sum(change["state"] == "ENABLED" for change in bench.changes)
    code, _ = run("systemctl", "start", UNIT)
    again = sum(change["state"] == "ENABLED" for change in bench.changes) - enabled
    bench.promise("a start without reset is refused", code != 0 and again == 0 and bench.all("FAULT"),
                  f"exit {shown()['ExecMainStatus']}; {bench.states}")  # fmt: skip


def reset(bench: Bench) -> None:
    """Acknowledge the faults, which only somebody does."""
    code, said = softneck("drives", "reset")
    bench.promise("somebody resets", code == 0 and bench.all("DISABLED"), f"{bench.states} {'' if code == 0 else said}")


def killed(bench: Bench) -> None:
    """kill -9 of the main process."""
    reset(bench)
    run("systemctl", "start", UNIT)
    bench.wait(lambda: shown()["StatusText"] == "running", 30.0)
    run("kill", "-9", shown()["MainPID"])
    rests(bench, "kill -9", "signal")


def unplugged(bench: Bench) -> None:
    """The adapter is taken away and put back."""
    reset(bench)
    run("systemctl", "start", UNIT)
    bench.wait(lambda: shown()["StatusText"] == "running", 30.0)
    address = Path("/sys/class/net/can0/device").resolve().name
    (PCI / "unbind").write_text(address)
    gone = bench.wait(lambda: shown()["ActiveState"] in ("failed", "inactive"), 60.0)
    bench.wait(lambda: bench.all("FAULT"), 5.0)
    (PCI / "bind").write_text(address)
    time.sleep(5.0)
    found = shown()
    bench.promise("adapter gone and back: ends, and stays so", gone and found["NRestarts"] == "0"
                  and found["ActiveState"] in ("failed", "inactive") and bench.all("FAULT"),
                  f"{brief(found)}; {bench.states}")  # fmt: skip


def main() -> None:
    """Play all."""
    print("systemd", run("systemctl", "--version")[1].splitlines()[0], flush=True)
    code, said = run("systemd-analyze", "verify", f"/etc/systemd/system/{UNIT}")
    exposure = (
        run("systemd-analyze", "security", "--no-pager", UNIT)[1].splitlines()[-1].encode("ascii", "ignore").decode()
    )
    bench = Bench(sys.argv[1], float(sys.argv[2]))
    bench.promise("systemd-analyze verify", code == 0, said or "no complaint")
    print(exposure, flush=True)
    for name in sys.argv[3:]:
        {"stop": started_and_stopped, "hang": hung, "kill": killed, "unplug": unplugged}[name](bench)
    bench.drives.kill()
    sys.exit(1 if bench.failed else 0)


if __name__ == "__main__":
    main()
