"""Drives, inclinometer and host as processes of their own on a real bus: `python tests/drives/processes.py [CASE...]`.

Prints one JSON line for each case. Without --bus it moves into a network namespace with nothing but a loopback of its
own and uses UDP multicast there. What happened is judged from the drives' side: their process reports each change of a
power state with its monotonic time, which all processes of a machine share.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

try:
    from .forked import Forked, imports_in
    from .processes_project import bring_up, too_busy, write_project
except ImportError:  # run as a script
    from forked import Forked, imports_in  # type: ignore[no-redef]
    from processes_project import bring_up, too_busy, write_project  # type: ignore[no-redef]

UDP = "udp_multicast:239.74.163.2"
INSIDE = "SOFTNECK_OWN_NETWORK"
NAMESPACE = (
    ("unshare", "--net") if os.name == "posix" and os.geteuid() == 0 else ("unshare", "--net", "--map-root-user")
)
OFF, FAULT = "DISABLED", "FAULT"
ARM = "SOFTNECK_ARM"
# linux/can/error.h
CAN_ERR_BUSOFF = 0x40
SLEEP = 0.01


@dataclass
class World:
    """The processes of one case; `patience` stretches all waiting, for slow machines [-]."""

    folder: Path
    bus: str = UDP
    link: str = "lo"
    period: float = 0.01
    patience: float = 1.0
    extra: tuple[str, ...] = ()
    realtime: bool = False
    drives_bus: str = ""
    forking: bool = False
    profile: str = "ipos2015"
    changes: list[dict[str, Any]] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    children: list[Any] = field(default_factory=list)
    longest_step: float = 0.0

    def start(self, loop: str = "loop") -> None:
        """Start all three and wait until the controller runs."""
        self.drives = self._spawn(
            "-m", "softneck.drives.simulated", self.drives_bus or self.bus, "--homed", "--report",
            "--cycle", str(self.period), "--profile", self.profile, stdout=subprocess.PIPE,
        )  # fmt: skip
        threading.Thread(target=self._read, daemon=True).start()
        self.wait(lambda: len(self.changes) >= 3, "the drives", 60.0)
        self._first(self.drives, 41)
        self.notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        address = self.folder / "notify.socket"
        self.notify.bind(str(address))
        threading.Thread(target=self._listen, args=(self.notify,), daemon=True).start()
        os.environ[ARM] = f"MOVE {self.bus.partition(':')[2]}"
        os.environ.update(NOTIFY_SOCKET=str(address), WATCHDOG_USEC="400000")
        try:
            self.host = self.run(loop)
        finally:
            for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC"):
                del os.environ[name]
        self.until(lambda: "READY=1" in self.told, "the checks", 60.0)
        self._first(self.host, 40)
        self.until(lambda: "STATUS=running" in self.told, "the loop", 60.0)

    def until(self, done: Callable[[], bool], what: str, seconds: float) -> None:
        """Wait until `done`; raise if the host ends before."""
        self.wait(lambda: done() or self.host.poll() is not None, what, seconds)
        if not done():
            code, result, line = self.ended()
            raise RuntimeError(f"the host ended before {what} with {code}: {line}; {result}")

    def run(self, loop: str, *, arm: bool = True) -> Any:
        """Start `softneck drives run`."""
        code = "from softneck.cli import main; main()"
        files = {"--loop": f"{loop}.toml", "--drives": "drives.toml", "-o": f"run_{time.monotonic_ns()}.csv"}
        words = ["drives", "run", str(self.folder / "pi.npz"), "--bus", self.bus, "--json", *(["--arm"] if arm else [])]
        # On SocketCAN a run is logged unasked, into the folder of whoever plays this.
        words += [] if "--log" in self.extra else ["--log", "none"]
        words += ["--override", "certificate", *self.extra]
        for option, name in files.items():
            words += [option, str(self.folder / name)]
        return self._spawn("-c", code, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def command(self, words: list[str]) -> Any:
        """Start another `softneck` command."""
        code = "from softneck.cli import main; main()"
        return self._spawn("-c", code, *words, stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def _first(self, child: Any, priority: int) -> None:
        """Let a process go before all ordinary ones from now on: while it imported, it would hold other loops up.

        Above the loop stand the simulated drives, for hardware that no process holds up.
        """
        if self.realtime and child.poll() is None:
            for task in Path(f"/proc/{child.pid}/task").iterdir():
                os.sched_setscheduler(int(task.name), os.SCHED_FIFO, os.sched_param(priority))

    def _spawn(self, *arguments: str, stdout: int = subprocess.DEVNULL, stderr: int = subprocess.DEVNULL) -> Any:
        """Start a process."""
        if self.forking:
            self.children.append(Forked(arguments))
            return self.children[-1]
        command = [sys.executable, *arguments]
        child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=stdout, stderr=stderr)
        self.children.append(child)
        return child

    def _read(self) -> None:
        for line in self.drives.stdout or ():
            self.changes.append(json.loads(line))

    def _listen(self, source: socket.socket) -> None:
        while True:
            try:
                self.told.append(source.recv(200).decode())
            except OSError:
                return

    @property
    def states(self) -> dict[int, str]:
        """State of each drive as its own process said last."""
        return {change["node"]: change["state"] for change in list(self.changes)}

    def all(self, *states: str) -> bool:
        """Whether all three are in one of `states`."""
        return len(self.states) == 3 and all(state in states for state in self.states.values())

    def left(self, since: float) -> float | None:
        """When the last of the three left Operation Enabled after `since`, seconds later; None if one did not."""
        times = {}
        for change in list(self.changes):
            if change["time_s"] >= since and change["state"] != "ENABLED":
                times.setdefault(change["node"], change["time_s"])
        return max(times.values()) - since if len(times) == 3 else None

    def enabled_after(self, since: float) -> bool:
        """Whether any drive was enabled again."""
        return any(change["state"] == "ENABLED" and change["time_s"] > since for change in list(self.changes))

    def wait(self, done: Callable[[], bool], what: str, seconds: float) -> None:
        """Wait until `done`."""
        until = time.monotonic() + seconds * self.patience
        while not done():
            if time.monotonic() > until:
                raise RuntimeError(f"waited {seconds * self.patience:g} s for {what}")
            time.sleep(SLEEP)

    def ended(self, child: Any = None, seconds: float = 20.0) -> tuple[int, dict[str, Any], str]:
        """Wait for a host; return exit code, JSON, last line on stderr."""
        child = child or self.host
        out, error = child.communicate(timeout=seconds * self.patience)
        lines, result = error.decode().strip().splitlines(), json.loads(out) if out.strip() else {}
        self.longest_step = max(self.longest_step, result.get("longest_step_s", 0.0))
        return child.returncode, result, lines[-1] if lines else ""

    def close(self) -> None:
        """End what this world started."""
        for child in self.children:
            if child.poll() is None:
                child.kill()
            child.wait()
            for pipe in (child.stdout, child.stderr):
                if pipe is not None and child is not self.drives:
                    pipe.close()
        if hasattr(self, "notify"):
            self.notify.close()
        (self.folder / "notify.socket").unlink(missing_ok=True)
        (self.folder / "hung").unlink(missing_ok=True)


def rest(world: World, since: float) -> dict[str, Any]:
    """Wait a while and return what the drives say then."""
    time.sleep(0.3 * world.patience)
    return {"states": sorted(world.states.values()), "enabled_again": world.enabled_after(since)}


def killed(world: World) -> dict[str, Any]:
    """kill -9 of the host."""
    since = time.monotonic()
    world.host.kill()
    world.wait(lambda: world.all(FAULT), "Fault", 5.0)
    code = world.host.wait()
    return {"reaction_s": world.left(since), "exit": code, **rest(world, since)}


def paused(world: World) -> dict[str, Any]:
    """SIGSTOP, a second, SIGCONT: the resumed master must not enable."""
    since = time.monotonic()
    world.host.send_signal(signal.SIGSTOP)
    world.wait(lambda: world.all(FAULT), "Fault", 5.0)
    time.sleep(1.0)
    world.host.send_signal(signal.SIGCONT)
    code, result, _ = world.ended()
    return {"reaction_s": world.left(since), "exit": code, "event": result["fault"]["event"], **rest(world, since)}


def hung(world: World) -> dict[str, Any]:
    """A part of the controller never returns."""
    world.until((world.folder / "hung").exists, "the hang", 20.0)
    time.sleep(0.01)
    since = float((world.folder / "hung").read_text())
    world.wait(lambda: world.all(FAULT), "Fault", 5.0)
    fed = sum(text == "WATCHDOG=1" for text in world.told)
    time.sleep(0.5)
    still_fed = sum(text == "WATCHDOG=1" for text in world.told) > fed
    world.host.kill()
    return {"reaction_s": world.left(since), "exit": world.host.wait(), "still_fed": still_fed, **rest(world, since)}


def second_master(world: World) -> dict[str, Any]:
    """Another `softneck drives run` is refused, and the first one goes on."""
    since = time.monotonic()
    code, _, line = world.ended(world.run("short"), seconds=60.0)
    went_on = world.all("ENABLED")
    world.host.terminate()
    first, result, _ = world.ended()
    return {
        "reaction_s": None,
        "exit": first,
        "event": (result["fault"] or {}).get("text"),
        "second_exit": code,
        "line": line,
        "went_on": went_on,
        **rest(world, since),
    }


def unarmed(world: World) -> dict[str, Any]:
    """Without --arm, without the words, with another bus' words: refused; the running master sees no frame of them."""
    words = os.environ.pop(ARM)
    refused = [world.ended(world.run("short", arm=False), seconds=60.0)]
    refused.append(world.ended(world.run("short"), seconds=60.0))
    os.environ[ARM] = f"{words}0"
    refused.append(world.ended(world.run("short"), seconds=60.0))
    went_on = world.all("ENABLED")
    world.host.terminate()
    code, _, _ = world.ended()
    return {"reaction_s": None, "exit": code, "refused": [found[0] for found in refused],
            "lines": [found[2] for found in refused], "went_on": went_on, **rest(world, math.inf)}  # fmt: skip


def intruder(world: World) -> dict[str, Any]:
    """A master that does not listen first sends SYNC messages."""
    import can

    interface, _, channel = world.bus.partition(":")
    with can.Bus(interface=interface, channel=channel) as bus:
        since = time.monotonic()
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        code, result, _ = world.ended()
    return {"reaction_s": world.left(since), "exit": code, "event": result["fault"]["event"], **rest(world, since)}


def cable(world: World) -> dict[str, Any]:
    """The link goes down, and comes back a second later."""
    since = time.monotonic()
    subprocess.run(["ip", "link", "set", world.link, "down"], check=True)
    world.wait(lambda: world.all(FAULT), "Fault", 5.0)
    code, result, _ = world.ended()
    bring_up(world.link)
    time.sleep(0.5)
    return {"reaction_s": world.left(since), "exit": code, "event": result["fault"]["event"], **rest(world, since)}


def bus_off(world: World) -> dict[str, Any]:
    """The adapter says that it is bus-off, by SocketCAN's error frame, as an adapter's driver does."""
    import can

    interface, _, channel = world.bus.partition(":")
    with can.Bus(interface=interface, channel=channel) as bus:
        since = time.monotonic()
        bus.send(can.Message(arbitration_id=CAN_ERR_BUSOFF, is_error_frame=True, is_extended_id=False, dlc=8))
        code, result, _ = world.ended()
    return {"reaction_s": world.left(since), "exit": code, "event": result["fault"]["event"], **rest(world, since)}


def sensor_stopped(world: World) -> dict[str, Any]:
    """The inclinometer's process stands still: the host goes to rest and off."""
    since = time.monotonic()
    world.drives.send_signal(signal.SIGUSR2)
    code, result, _ = world.ended()
    fault = result["fault"]
    return {"reaction_s": fault["time_s"] - since, "exit": code, "event": fault["event"], **rest(world, since)}


def drives_gone(world: World) -> dict[str, Any]:
    """kill -9 of the drives' process: none of them answers any more."""
    since = time.monotonic()
    world.drives.kill()
    code, result, _ = world.ended()
    fault = result["fault"]
    return {"reaction_s": fault["time_s"] - since, "exit": code, "event": fault["event"], "states": ["gone"],
            "enabled_again": False}  # fmt: skip


def terminated(world: World) -> dict[str, Any]:
    """SIGTERM: to rest, then off."""
    since = time.monotonic()
    world.host.terminate()
    code, result, _ = world.ended()
    told = {what: f"{word}=1" in world.told for what, word in (("ready", "READY"), ("fed", "WATCHDOG"))}
    told["stopping"] = world.told[-1:] == ["STOPPING=1"]
    return {"reaction_s": None, "exit": code, "phase": result["phase"], **told, **rest(world, since)}


def _emergency_then_interrupt(delay: float) -> Callable[[World], dict[str, Any]]:
    """A drive's short-circuit emergency, and somebody who presses Ctrl-C `delay` [s] later."""

    def act(world: World) -> dict[str, Any]:
        since = time.monotonic()
        _send(world, (0x082, bytes([0x10, 0x23, 0x01, 0, 0, 0, 0, 0])))
        time.sleep(delay)
        world.host.send_signal(signal.SIGINT)
        return {"reaction_s": world.left(since), **_told(world), **rest(world, since)}

    return act


def _send(world: World, *frames: tuple[int, bytes]) -> None:
    import can

    interface, _, channel = world.bus.partition(":")
    with can.Bus(interface=interface, channel=channel) as bus:
        for identifier, data in frames:
            bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))


def _told(world: World) -> dict[str, Any]:
    """Wait for the host; return exit code, event, and how many rows of the run were kept."""
    code, result, line = world.ended()
    recording = result.get("recording")
    rows = len(Path(recording).read_text().splitlines()) - 1 if recording else 0
    return {"exit": code, "event": (result["fault"] or {}).get("event"), "kept": rows > 5, "line": line}


def interrupted_thrice(world: World) -> dict[str, Any]:
    """Ctrl-C three times, 150 ms apart."""
    since = time.monotonic()
    for _ in range(3):
        world.host.send_signal(signal.SIGINT)
        time.sleep(0.15)
    return {"reaction_s": world.left(since), **_told(world), **rest(world, since)}


def terminated_while_writing(world: World) -> dict[str, Any]:
    """Ctrl-C, and as soon as the drives are off SIGTERM again and again."""
    since = time.monotonic()
    world.host.send_signal(signal.SIGINT)
    world.wait(lambda: world.all(OFF) or world.host.poll() is not None, "off", 20.0)
    while world.host.poll() is None:
        world.host.terminate()
        time.sleep(0.01)
    return {"reaction_s": None, **_told(world), **rest(world, since)}


def descriptors_exhausted(world: World) -> dict[str, Any]:
    """The host may open no further file from now on."""
    import resource

    since, opened = time.monotonic(), Path(f"/proc/{world.host.pid}/fd").iterdir()
    most = max(int(one.name) for one in opened) + 1
    resource.prlimit(world.host.pid, resource.RLIMIT_NOFILE, (most, most))
    world.host.terminate()
    return {"reaction_s": None, **_told(world), **rest(world, since)}


def node_twice(world: World) -> dict[str, Any]:
    """A second device answers each SYNC as node 2 does."""
    import can

    interface, _, channel = world.bus.partition(":")
    since, done = time.monotonic(), threading.Event()

    def answer() -> None:
        with can.Bus(interface=interface, channel=channel) as bus:
            last = b""
            while not done.is_set():
                frame = bus.recv(0.1)
                if frame is None or frame.is_remote_frame:
                    continue
                if frame.arbitration_id == 0x182 and bytes(frame.data) != last:
                    last = bytes(frame.data)
                    bus.send(can.Message(arbitration_id=0x182, data=last, is_extended_id=False))

    thread = threading.Thread(target=answer, daemon=True)
    thread.start()
    found = _told(world)
    done.set()
    thread.join()
    return {"reaction_s": None, **found, **rest(world, since)}


def foreign_abort(world: World) -> dict[str, Any]:
    """While the drives are switched off, another client's aborts of object 6085h come from node 2."""
    since = time.monotonic()
    world.host.terminate()
    while world.host.poll() is None:
        _send(world, *[(0x582, bytes.fromhex("8085600011000906"))] * 5)
        time.sleep(0.002)
    return {"reaction_s": None, **_told(world), **rest(world, since)}


def scan_beside(world: World) -> dict[str, Any]:
    """`scan` beside a run says that another master is there, and the run goes on."""
    since = time.monotonic()
    words = ["drives", "commission", "--only", "scan", "--bus", world.bus, "--json"]
    scan = world.command(words)
    code, _, line = world.ended(scan, seconds=60.0)
    went_on = world.all("ENABLED")
    world.host.terminate()
    found = _told(world)
    return {"reaction_s": None, "scan_exit": code, "scan_line": line, "went_on": went_on, **found,
            **rest(world, since)}  # fmt: skip


def undisturbed(world: World) -> dict[str, Any]:
    """Nothing happens: the cycles."""
    code, result, _ = world.ended(seconds=120.0)
    fault = result["fault"] or {}
    return {"reaction_s": None, "exit": code, "event": fault.get("event"), "text": fault.get("text"),
            "times": result["times"], **rest(world, math.inf)}  # fmt: skip


CASES: dict[str, tuple[Callable[[World], dict[str, Any]], dict[str, Any]]] = {
    "killed": (killed, {"exit": -9, "states": [FAULT] * 3}),
    "paused": (paused, {"exit": 1, "event": "stalled", "states": [FAULT] * 3}),
    "hung": (hung, {"exit": -9, "still_fed": False, "states": [FAULT] * 3}),
    "second_master": (second_master, {"exit": 143, "second_exit": 1, "went_on": True, "states": [OFF] * 3}),
    "intruder": (intruder, {"exit": 1, "event": "second_master", "states": [OFF] * 3}),
    "cable": (cable, {"exit": 1, "event": "bus_off", "states": [FAULT] * 3}),
    "sensor_stopped": (sensor_stopped, {"exit": 1, "event": "sensor_lost", "states": [OFF] * 3}),
    "drives_gone": (drives_gone, {"exit": 1, "event": "bus_silent", "states": ["gone"]}),
    "terminated": (terminated, {"exit": 143, "phase": "done", "fed": True, "ready": True, "stopping": True,
                                "states": [OFF] * 3}),
    "undisturbed": (undisturbed, {"exit": 0, "states": [OFF] * 3}),
    **{
        f"emergency_then_interrupt_{round(1e3 * delay)}_ms": (
            _emergency_then_interrupt(delay),
            {"exit": 1, "event": "emergency", "kept": True, "states": [OFF] * 3},
        )
        for delay in (0.05, 0.15, 0.3)
    },
    "interrupted_thrice": (interrupted_thrice, {"exit": 130, "event": "operator", "kept": True, "states": [OFF] * 3}),
    "terminated_while_writing": (terminated_while_writing, {"exit": 130, "kept": True, "states": [OFF] * 3}),
    "descriptors_exhausted": (descriptors_exhausted, {"exit": 143, "kept": True, "states": [OFF] * 3}),
    "node_twice": (node_twice, {"exit": 1, "event": "node_twice", "kept": True, "states": [OFF] * 3}),
    "foreign_abort": (foreign_abort, {"exit": 143, "event": None, "kept": True, "states": [OFF] * 3}),
    "scan_beside": (scan_beside, {"exit": 143, "scan_exit": 1, "went_on": True, "kept": True, "states": [OFF] * 3}),
}  # fmt: skip
# Only SocketCAN has error frames, and only a bus with a wire behind it wants the words typed.
SOCKETCAN_CASES = {
    **CASES,
    "bus_off": (bus_off, {"exit": 1, "event": "bus_off"}),
    "unarmed": (unarmed, {"exit": 143, "refused": [2, 2, 2], "went_on": True, "states": [OFF] * 3}),
}


def play(name: str, world: World) -> dict[str, Any]:
    """Run one case; `exact` tells whether all ended as it must."""
    act, expected = SOCKETCAN_CASES[name]
    try:
        world.start({"hung": "hangs", "undisturbed": "short"}.get(name, "loop"))
        time.sleep(0.2)
        found = act(world)
    except (RuntimeError, subprocess.TimeoutExpired, KeyError, TypeError) as error:
        found = {"problem": f"{type(error).__name__}: {error}", "states": sorted(world.states.values())}
    finally:
        world.close()
    exact = all(found.get(key) == value for key, value in expected.items()) and found.get("enabled_again") is False
    return {"case": name, "exact": exact, **found}


def main() -> None:
    """Play the cases, all of them `--repeat` times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"of {', '.join(SOCKETCAN_CASES)}")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--bus", default=UDP)
    parser.add_argument("--drives-bus", default="", help="where the drives are, if that interface is another one")
    parser.add_argument("--link", default="lo")
    parser.add_argument("--duration", type=float, default=3.0)
    parser.add_argument("--period", type=float, default=0.01)
    parser.add_argument("--guarding", type=float, default=0.1)
    parser.add_argument("--patience", type=float, default=1.0)
    parser.add_argument("--realtime", action="store_true", help="host and drives before all ordinary processes")
    parser.add_argument("--attempts", type=int, default=1, help="where the machine was too busy for the loop")
    parser.add_argument("--profile", default="ipos2015", help="ds402 is guarded by heartbeats, without remote frames")
    parser.add_argument("--project", type=Path, help="what write_project wrote, instead of writing it")
    parser.add_argument("--fork", action="store_true", help="import once and fork: for slow machines")
    parser.add_argument("--extra", action="append", default=[], help="further option of `softneck drives run`")
    chosen = parser.parse_args()
    if chosen.bus == UDP and INSIDE not in os.environ:
        command = [*NAMESPACE, sys.executable, *sys.argv]
        sys.exit(subprocess.run(command, env={**os.environ, INSIDE: "1"}, check=False).returncode)
    if chosen.bus == UDP:
        bring_up("lo")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if chosen.project:
            shutil.copytree(chosen.project, folder, dirs_exist_ok=True)
        else:
            write_project(
                folder, duration=chosen.duration, period=chosen.period, guarding=chosen.guarding, profile=chosen.profile
            )
        if chosen.fork:
            imports_in(folder)
        for case in [*(chosen.cases or CASES)] * chosen.repeat:
            found: dict[str, Any] = {}
            for attempt in range(chosen.attempts):
                world = World(folder, chosen.bus, chosen.link, chosen.period, chosen.patience, tuple(chosen.extra))
                world.realtime, world.drives_bus = chosen.realtime, chosen.drives_bus
                world.forking, world.profile = chosen.fork, chosen.profile
                found = play(case, world)
                if not too_busy(found, world.longest_step, chosen.guarding) or attempt == chosen.attempts - 1:
                    break
            print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
