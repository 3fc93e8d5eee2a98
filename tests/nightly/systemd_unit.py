"""The shipped systemd unit under a real systemd: `make nightly-systemd`, or `python tests/nightly/systemd_unit.py`.

Boots the guest of `machine.py` with Debian's systemd and udev as process 1, installs the shipped unit as it is,
and plays `systemd_guest.py` there: the service is master on can0, simulated drives hang on can1 of the same bus
at 1 Mbit/s. What an emulated machine needs more time for is a drop-in, which is printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from machine import BUILD, END, ROOT, Guest, boot, has_kvm, require_tools
from socketcan import prepare

UNIT = ROOT / "examples" / "drives" / "softneck-neck.service"
PACKAGES = ("systemd", "udev")
OBSERVER = """import pathlib
from time import monotonic, sleep

from softneck.core import load
from softneck.loop import BlockPart

HERE = pathlib.Path(__file__).parent


class Hangs(BlockPart):
    def advance(self, time, inputs):
        if (HERE / "hang").exists():
            (HERE / "hung").write_text(str(monotonic()))
            while True:
                sleep(1.0)
        return super().advance(time, inputs)


def make():
    return Hangs(load(HERE / "kalman.npz", role="observer").block())
"""
# Process 1 becomes systemd. The interpreter of this machine may lie in somebody's home, which the unit cannot see.
START = """export PATH=/usr/sbin:/usr/bin:/sbin:/bin
ip link set lo up
for device in can0 can1; do ip link set $device type can bitrate 1000000 restart-ms 0 && ip link set $device up; done
mkdir -p /opt/softneck/bin /opt/softneck/src /opt/neck /var/cache/softneck
cp -r {package} /opt/softneck/src/
cp -r {project}/. /opt/neck/
cp -a {cache}/. /var/cache/softneck/
useradd --system --home-dir /opt/neck --groups dialout softneck
chown -R softneck: /opt/neck /var/cache/softneck
chmod a+rx {homes}
install -m 755 /run/softneck/softneck /opt/softneck/bin/softneck
install -m 644 /run/softneck/softneck-neck.service /etc/systemd/system/softneck-neck.service
mkdir -p /etc/systemd/system/softneck-neck.service.d
install -m 644 /run/softneck/drop_in.conf /etc/systemd/system/softneck-neck.service.d/guest.conf
install -m 644 /run/softneck/nightly.service /run/softneck/nightly.target /etc/systemd/system/
# What else this machine starts, or has to be set up for it, is no concern of the guest; nor is it a container.
for unit in {masked}; do ln -sf /dev/null /etc/systemd/system/$unit; done
rm -f /.dockerenv
exec /lib/systemd/systemd --unit=nightly.target --show-status=no
"""
MASKED = " ".join(f"systemd-{name}.service" for name in (
    "tmpfiles-setup", "tmpfiles-setup-dev", "sysusers", "firstboot", "repart", "random-seed", "update-utmp",
    "timesyncd", "journal-flush", "machine-id-commit", "binfmt", "pstore", "sysctl")) + " timers.target"  # fmt: skip
COMMAND = """#!/bin/sh
export PYTHONPATH={pythonpath} OPENBLAS_NUM_THREADS=1 MPLBACKEND=Agg NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES=
exec {python} -c "from softneck.cli import main; main()" "$@"
"""
TARGET = """[Unit]
Requires=basic.target
Wants=systemd-udevd.service systemd-udev-trigger.service nightly.service
AllowIsolate=yes
"""
SERVICE = """[Unit]
After=basic.target systemd-udev-trigger.service
[Service]
Type=exec
Environment=PYTHONPATH={pythonpath} OPENBLAS_NUM_THREADS=1 MPLBACKEND=Agg XDG_CACHE_HOME=/var/cache/softneck
Environment=NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= PATH=/usr/sbin:/usr/bin:/sbin:/bin
ExecStart={python} /run/softneck/guest.py {period} {patience} {parts}
ExecStopPost=/bin/sh -c 'echo {end} $EXIT_STATUS; sync; exec /bin/busybox poweroff -f'
StandardOutput=tty
StandardError=tty
TTYPath=/dev/ttyS0
TimeoutStopSec=5
"""


def certified(folder: Path, period: float) -> Path:
    """Return a project whose controller is certified for exactly its loop, and whose observer hangs on demand."""
    prepare(folder, period)
    project = folder / "ds402"
    (project / "hanging_observer.py").write_text(OBSERVER, encoding="utf-8")
    loop = (project / "hangs.toml").read_text(encoding="utf-8")
    loop = f'drives = "drives.toml"\n{loop}[limits]\n"motors.max_rad" = 6.0\n'
    (project / "loop.toml").write_text(loop, encoding="utf-8")
    code = "from softneck.cli import main; main()"
    words = ["simulate", "loop.toml", "--certificate", "loop.certificate.json", "-o", "certified.csv"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code, *words], cwd=project, env=environment, check=True,
                   stdout=subprocess.DEVNULL)  # fmt: skip
    # In the place of `softneck verify`: this controller was designed on Eq. 31, and the guest shows the unit.
    code = "import sys, pathlib; from tests.drives.certified import write_verified; "
    code += "write_verified(pathlib.Path(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, str(project / "pi.npz")], cwd=ROOT, env=environment, check=True)
    return project


def drop_in(python: Path, *, kvm: bool) -> str:
    """Return what this guest changes of the unit."""
    lines = [] if kvm else ["TimeoutStartSec=1200", "TimeoutStopSec=600"]
    if python.parts[1] in ("root", "home"):
        lines.append("ProtectHome=read-only")
    # systemd forgets how a unit ended that nothing refers to any more.
    lines.append("ExecStopPost=/bin/sh -c 'echo $$SERVICE_RESULT $$EXIT_CODE $$EXIT_STATUS > /opt/neck/ended'")
    return "\n".join(["[Service]", *lines, ""])


def main() -> None:
    """Boot, play, print; exit code 1 if something was not as promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["stop", "hang", "kill", "unplug"], help="instead of all")
    parser.add_argument("--no-kvm", action="store_true")
    parser.add_argument("--seconds", type=float, default=3600.0, help="the guest is given up then [s]")
    chosen = parser.parse_args()
    require_tools()
    kvm = has_kvm() and not chosen.no_kvm
    period, patience = (0.01, 1) if kvm else (0.02, 20)
    python = Path(sys.executable).resolve()
    homes = [str(parent) for parent in (*python.parents, *Path(sys.prefix).parents) if parent != Path("/")]
    BUILD.mkdir(parents=True, exist_ok=True)
    changed = drop_in(python, kvm=kvm)
    with tempfile.TemporaryDirectory(dir=BUILD) as name:
        project = certified(Path(name), period)
        given = {"python": sys.executable, "pythonpath": "/opt/softneck/src"}
        files = {
            "start.sh": START.format(
                masked=MASKED, package=ROOT / "softneck", project=project, cache=BUILD / "cache", homes=" ".join(homes)
            ),
            "guest.py": (Path(__file__).parent / "systemd_guest.py").read_text(encoding="utf-8"),
            "softneck": COMMAND.format(**given),
            "softneck-neck.service": UNIT.read_text(encoding="utf-8"),
            "drop_in.conf": changed,
            "nightly.target": TARGET,
            "nightly.service": SERVICE.format(
                **given, period=period, patience=patience, parts=" ".join(chosen.parts), end=END
            ),
        }
        print(f"changed for this guest: {changed.splitlines()[1:]}", flush=True)
        lines = boot(Guest(files=files, packages=PACKAGES, options="fstab=no", seconds=chosen.seconds), kvm=kvm)
    held = [line for line in lines if line.startswith(("yes ", "NO "))]
    good = sum(line.startswith("yes ") for line in held)
    print(f"{good} of {len(held)} promises of the unit held")
    sys.exit(0 if good == len(held) > 0 and any(line.startswith(f"{END} 0") for line in lines) else 1)


if __name__ == "__main__":
    main()
