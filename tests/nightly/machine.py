"""A virtual machine with Debian's own kernel over this machine's files: what `make nightly-can` and -systemd boot.

The kernel's package, and any other, is fetched by apt-get and unpacked into build/nightly, never installed. The guest
sees the host's files read only by 9p, under an overlay in its memory: it may write anywhere and nothing is kept.

KVM is used where the processor itself offers it (vmx or svm); elsewhere the machine is emulated, and then its clock
counts instructions (`-icount`): one a nanosecond, whatever else the host does.

Debian: qemu-system-x86 busybox-static kmod cpio iproute2.
"""

from __future__ import annotations

import os
import queue
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "nightly"
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "overlay", "can", "can_raw", "can_bcm", "can_dev", "vcan", "sja1000",
           "kvaser_pci")  # fmt: skip
TOOLS = ("qemu-system-x86_64", "busybox", "modprobe", "cpio", "ip", "apt-get", "dpkg-deb")
SHARE = "trans=virtio,version=9p2000.L,msize=512000,cache=loose,ro"
COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
BEGIN, END = "GUEST-BEGIN", "GUEST-END"

INIT = """#!/bin/busybox sh
b=/bin/busybox
$b mount -t proc none /proc
$b mount -t sysfs none /sys
$b mount -t devtmpfs none /dev
for module in {modules}; do $b insmod /modules/$module || echo "no $module"; done
$b mount -t 9p -o {share} root /lower
{second}
$b mount -t tmpfs -o size=80% none /upper
$b mkdir /upper/files /upper/work
$b mount -t overlay -o lowerdir={lower},upperdir=/upper/files,workdir=/upper/work none /host || $b poweroff -f
for place in proc sys dev; do $b mount --move /$place /host/$place; done
$b mkdir -p /host/dev/shm
$b mount -t tmpfs none /host/dev/shm
$b mount -t tmpfs none /host/run
$b mkdir -p /host/run/softneck
$b cp /files/* /host/run/softneck
echo {begin}
exec $b switch_root /host /bin/bash /run/softneck/start.sh
"""
# Process 1 of a guest without systemd.
START = """/bin/bash /run/softneck/guest.sh 2>&1
echo {end} $?
/bin/busybox poweroff -f
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guest:
    """What a guest runs.

    Attributes:
        files: texts put into its /run/softneck; `start.sh` becomes process 1, by default it runs `guest.sh` and ends.
        packages: Debian packages unpacked over the host's files.
        options: further words of the kernel's command line.
        seconds: when it is given up [s].
    """

    files: dict[str, str]
    packages: tuple[str, ...] = ()
    options: str = ""
    seconds: float = 1800.0


def require_tools() -> None:
    """End with one line if a program is missing."""
    missing = [name for name in TOOLS if shutil.which(name) is None]
    if missing:
        sys.exit(
            f"nightly: {', '.join(missing)} missing; "
            "on Debian: apt-get install qemu-system-x86 busybox-static kmod cpio iproute2"
        )


def has_kvm() -> bool:
    """Whether the processor itself runs guests: /dev/kvm alone may be a software that boots no plain kernel."""
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    return os.access("/dev/kvm", os.R_OK | os.W_OK) and re.search(r"^flags.*\b(vmx|svm)\b", flags, re.M) is not None


def unpacked(package: str, folder: Path) -> None:
    """Fetch a Debian package and unpack it into `folder`."""
    with tempfile.TemporaryDirectory(dir=BUILD) as name:
        fetched = subprocess.run(["apt-get", "download", package], cwd=name, capture_output=True, text=True)
        if fetched.returncode != 0:
            said = [line for line in fetched.stderr.splitlines() if line.startswith("E:")][:1]
            sys.exit(f"nightly: apt-get download {package} failed: {' '.join(said) or 'no reason given'}")
        subprocess.run(["dpkg-deb", "-x", str(next(Path(name).glob("*.deb"))), str(folder)], check=True)


def kernel() -> tuple[Path, str]:
    """Return the kernel's tree and version; it is fetched if it is not here yet."""
    base = BUILD / "kernel"
    BUILD.mkdir(parents=True, exist_ok=True)
    if not list(base.glob("boot/vmlinuz-*")):
        shown = subprocess.run(
            ["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True, check=True
        )
        names = [line.split()[-1] for line in shown.stdout.splitlines() if "Depends: linux-image" in line]
        if not names:
            sys.exit("nightly: apt knows no linux-image-amd64; run `apt-get update`")
        unpacked(names[0], base)
    version = max(base.glob("boot/vmlinuz-*")).name.removeprefix("vmlinuz-")
    subprocess.run(["depmod", "-b", str(base), version], check=True)
    return base, version


def layer(packages: Sequence[str]) -> Path:
    """Return the tree of the packages, which lies over the host's files."""
    folder = BUILD / "-".join(packages)
    if not folder.exists():
        for package in packages:
            unpacked(package, folder)
        # The host's /lib is a link into /usr, which a folder of the layer would hide.
        for name in ("bin", "sbin", "lib"):
            if (folder / name).is_dir():
                shutil.copytree(folder / name, folder / "usr" / name, symlinks=True, dirs_exist_ok=True)
                shutil.rmtree(folder / name)
    return folder


def initramfs(folder: Path, guest: Guest) -> tuple[Path, Path]:
    """Return kernel and archive: busybox, the modules in their order, and what the guest runs."""
    base, version = kernel()
    tree = folder / "tree"
    for name in ("bin", "modules", "proc", "sys", "dev", "lower", "layer", "upper", "host", "files"):
        (tree / name).mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), tree / "bin" / "busybox")
    names: list[str] = []
    for module in MODULES:
        command = ["modprobe", "-d", str(base), "-S", version, "--show-depends", module]
        shown = subprocess.run(command, capture_output=True, text=True, check=True)
        for line in shown.stdout.splitlines():
            path = Path(line.split()[1])
            if line.startswith("insmod ") and path.name not in names:
                names.append(path.name)
                shutil.copy(path, tree / "modules" / path.name)
    second = f"$b mount -t 9p -o {SHARE} layer /layer" if guest.packages else ""
    lower = "/layer:/lower" if guest.packages else "/lower"
    given = {"share": SHARE, "second": second, "lower": lower, "begin": BEGIN}
    text = INIT.format(modules=" ".join(names), **given)
    (tree / "init").write_text(text, encoding="utf-8")
    (tree / "init").chmod(0o755)
    for name, text in {"start.sh": START.format(end=END), **guest.files}.items():
        (tree / "files" / name).write_text(text, encoding="utf-8")
    archive = folder / "initramfs.cpio"
    listed = "\n".join(str(path.relative_to(tree)) for path in sorted(tree.rglob("*")))
    with archive.open("wb") as out:
        subprocess.run(["cpio", "-o", "-H", "newc", "--quiet"], cwd=tree, input=listed.encode(), stdout=out, check=True)
    return base / "boot" / f"vmlinuz-{version}", archive


def command_line(image: Path, archive: Path, guest: Guest, *, kvm: bool) -> list[str]:
    """Return QEMU's words: two emulated CAN controllers on one emulated bus, no network, console on stdout."""
    processor = ["-accel", "kvm", "-cpu", "host", "-smp", "2"] if kvm else [
        "-accel", "tcg", "-cpu", "max", "-smp", "1", "-icount", "shift=0,sleep=on"]  # fmt: skip
    shares = [("root", "/")] + ([("layer", str(layer(guest.packages)))] if guest.packages else [])
    local = "security_model=none,readonly=on,multidevs=remap"
    files = [word for tag, path in shares for word in ("-virtfs", f"local,path={path},mount_tag={tag},{local}")]
    controller = ["-device", "kvaser_pci,canbus=canbus0"]
    return [
        "qemu-system-x86_64", *processor, "-m", "4096", "-nodefaults", "-display", "none", "-nic", "none",
        "-no-reboot", "-serial", "stdio", "-kernel", str(image), "-initrd", str(archive),
        "-append", f"console=ttyS0 quiet panic=-1 mitigations=off {guest.options}".strip(),
        *files, "-object", "can-bus,id=canbus0", *controller, *controller,
    ]  # fmt: skip


def boot(guest: Guest, *, kvm: bool) -> list[str]:
    """Return the lines a guest printed; it is ended when it runs for too long, and a line on stderr says so."""
    with tempfile.TemporaryDirectory(dir=BUILD if BUILD.exists() else None) as name:
        image, archive = initramfs(Path(name), guest)
        command = command_line(image, archive, guest, kvm=kvm)
        print(f"QEMU, {'KVM' if kvm else 'emulated, clock of instructions'}, {image.name}", flush=True)
        return _watched(command, guest.seconds)


def _watched(command: list[str], seconds: float) -> list[str]:
    lines: list[str] = []
    arrived: queue.Queue[str | None] = queue.Queue()
    until = time.monotonic() + seconds
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as machine:

        def read() -> None:
            for line in machine.stdout or ():
                arrived.put(COLOUR.sub("", line.rstrip()))
            arrived.put(None)

        threading.Thread(target=read, daemon=True).start()
        try:
            while (line := arrived.get(timeout=max(0.0, until - time.monotonic()))) is not None:
                print(line, flush=True)
                lines.append(line)
        except queue.Empty:
            print(
                f"nightly: the guest was given up after {seconds:g} s; it printed last: {last(lines)}", file=sys.stderr
            )
        finally:
            machine.kill()
    if not any(line.startswith(END) for line in lines):
        print(f"nightly: the guest did not come to its end; it printed last: {last(lines)}", file=sys.stderr)
    return lines


def last(lines: Sequence[str]) -> str:
    """Return the last line that says something."""
    return next((line for line in reversed(lines) if line.strip()), "nothing")
