"""Real SocketCAN in a virtual machine: `make nightly-can`, or `python tests/nightly/socketcan.py [CASE...]`.

Boots Debian's own kernel (its package is unpacked into build/nightly, never installed) in QEMU, with the host's files
read only by 9p, and plays `tests/drives/processes.py` there: over vcan0, and over two emulated SJA1000 controllers
(kvaser_pci) at 1 Mbit/s on one emulated bus. Needs qemu-system-x86, busybox-static, kmod, cpio, iproute2, apt-get,
dpkg-deb.
Without KVM the machine is emulated and slow: period and patience are relaxed then, and the output says so.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "nightly"
MODULES = ("virtio_pci", "9pnet_virtio", "9p", "can", "can_raw", "can_dev", "vcan", "sja1000", "kvaser_pci")
TOOLS = ("qemu-system-x86_64", "busybox", "modprobe", "cpio", "ip", "apt-get", "dpkg-deb")
DONE = "GUEST-END"

INIT = """#!/bin/busybox sh
/bin/busybox mkdir -p /proc /sys /dev /host
/bin/busybox mount -t proc none /proc
/bin/busybox mount -t sysfs none /sys
/bin/busybox mount -t devtmpfs none /dev
for module in {modules}; do /bin/busybox insmod /modules/$module || echo "no $module"; done
/bin/busybox mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=loose,ro root /host
/bin/busybox mount -t tmpfs none /host/tmp
/bin/busybox mount -t proc none /host/proc
/bin/busybox mount -t sysfs none /host/sys
/bin/busybox mount -t devtmpfs none /host/dev
/bin/busybox mkdir -p /host/dev/shm
/bin/busybox mount -t tmpfs none /host/dev/shm
/bin/busybox mkdir -p /host/tmp/work
/bin/busybox base64 -d /guest.b64 > /host/tmp/guest.sh
/bin/busybox chroot /host /bin/bash /tmp/guest.sh 2>&1
echo {done}
/bin/busybox poweroff -f
"""
GUEST = """export PATH={path} HOME=/tmp PYTHONPATH={pythonpath} OPENBLAS_NUM_THREADS=1 MPLBACKEND=Agg
export XDG_CACHE_HOME=/tmp/cache NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES=
cp -r {cache} /tmp/cache
cd /tmp/work
uname -r
ip link set lo up
ip link add vcan0 type vcan && ip link set vcan0 up
for device in can0 can1; do ip link set $device type can bitrate 1000000 && ip link set $device up; done
ip -brief -details link show type can
for bus in {buses}; do
    echo "== $bus"
    {python} {script} --bus socketcan:${{bus%%/*}} --drives-bus socketcan:${{bus##*/}} --link ${{bus%%/*}} {options}
done
"""


def kernel() -> tuple[Path, Path]:
    """Return the kernel's image and modules, downloaded by apt-get if they are not here yet."""
    BUILD.mkdir(parents=True, exist_ok=True)
    found = sorted(BUILD.glob("kernel/boot/vmlinuz-*"))
    if not found:
        depends = subprocess.run(
            ["apt-cache", "depends", "linux-image-amd64"], capture_output=True, text=True, check=True
        )
        name = next(line.split()[-1] for line in depends.stdout.splitlines() if "Depends: linux-image" in line)
        subprocess.run(["apt-get", "download", name], cwd=BUILD, check=True)
        package = next(BUILD.glob("linux-image-*.deb"))
        subprocess.run(["dpkg-deb", "-x", str(package), str(BUILD / "kernel")], check=True)
        package.unlink()
        found = sorted(BUILD.glob("kernel/boot/vmlinuz-*"))
    version = found[-1].name.removeprefix("vmlinuz-")
    base = BUILD / "kernel"
    subprocess.run(["depmod", "-b", str(base), version], check=True)
    return found[-1], base


def initramfs(base: Path, version: str, folder: Path, guest: str) -> Path:
    """Return an archive with busybox, the modules in their order, and what the guest runs."""
    import base64

    tree = folder / "tree"
    for name in ("bin", "modules", "proc", "sys", "dev", "host"):
        (tree / name).mkdir(parents=True)
    shutil.copy(str(shutil.which("busybox")), tree / "bin" / "busybox")
    names: list[str] = []
    for module in MODULES:
        shown = subprocess.run(
            ["modprobe", "-d", str(base), "-S", version, "--show-depends", module],
            capture_output=True,
            text=True,
            check=True,
        )
        for line in shown.stdout.splitlines():
            if line.startswith("insmod "):
                path = Path(line.split()[1])
                if path.name not in names:
                    names.append(path.name)
                    shutil.copy(path, tree / "modules" / path.name)
    (tree / "init").write_text(INIT.format(modules=" ".join(names), done=DONE), encoding="utf-8")
    (tree / "init").chmod(0o755)
    (tree / "guest.b64").write_bytes(base64.encodebytes(guest.encode()))
    archive = folder / "initramfs.cpio"
    listed = "\n".join(str(path.relative_to(tree)) for path in sorted(tree.rglob("*")))
    with archive.open("wb") as out:
        subprocess.run(["cpio", "-o", "-H", "newc", "--quiet"], cwd=tree, input=listed.encode(), stdout=out, check=True)
    return archive


def warmed(folder: Path) -> Path:
    """Return a cache of compiled functions for any processor: the guest's compiler would need minutes."""
    cache = folder / "cache"
    environment = {**os.environ, "XDG_CACHE_HOME": str(cache), "NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}
    script = ROOT / "tests" / "drives" / "processes.py"
    subprocess.run([sys.executable, str(script), "undisturbed", "--duration", "1"], env=environment, check=True,
                   stdout=subprocess.DEVNULL)  # fmt: skip
    return cache


def main() -> None:
    """Boot, play, print; exit code 1 if a case was not exact."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", default=["undisturbed", "killed", "paused", "hung", "intruder", "cable"])
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--buses", nargs="*", default=["vcan0/vcan0", "can0/can1"], help="master's/drives' interface")
    parser.add_argument("--no-kvm", action="store_true")
    chosen = parser.parse_args()
    missing = [name for name in TOOLS if shutil.which(name) is None]
    if missing:
        sys.exit(f"nightly-can needs {', '.join(missing)}; see the top of {Path(__file__).name}.")
    image, base = kernel()
    fast = os.access("/dev/kvm", os.R_OK | os.W_OK) and not chosen.no_kvm
    relaxed = [] if fast else ["--patience", "10", "--period", "0.02"]
    print(f"QEMU with {'KVM' if fast else 'TCG (emulated)'}; relaxed: {' '.join(relaxed) or 'nothing'}", flush=True)
    with tempfile.TemporaryDirectory(dir=BUILD) as name:
        folder = Path(name)
        guest = GUEST.format(
            path=os.environ["PATH"], pythonpath=":".join(str(ROOT / part) for part in
                ("kit", "identification", "fmu_src", "design", "deploy")),
            cache=warmed(folder), buses=" ".join(chosen.buses), python=sys.executable,
            script=ROOT / "tests" / "drives" / "processes.py",
            options=" ".join([*chosen.cases, f"--repeat={chosen.repeat}", "--attempts=2", "--realtime", *relaxed]),
        )  # fmt: skip
        archive = initramfs(base, image.name.removeprefix("vmlinuz-"), folder, guest)
        # Not all that "max" has can be set where this is a virtual machine itself.
        processor = ["-accel", "kvm", "-cpu", "max,-arch-capabilities"] if fast else ["-accel", "tcg", "-cpu", "max"]
        controller = ["-device", "kvaser_pci,canbus=canbus0"]
        command = [
            "qemu-system-x86_64", *processor, "-smp", "2", "-m", "3072", "-nodefaults", "-display", "none",
            "-no-reboot", "-serial", "stdio", "-kernel", str(image), "-initrd", str(archive),
            "-append", "console=ttyS0 quiet panic=-1 tsc=reliable mitigations=off",
            "-virtfs", "local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap",
            "-object", "can-bus,id=canbus0", *controller, *controller,
        ]  # fmt: skip
        lines = []
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True, errors="replace"
        ) as guest_process:
            try:
                for line in guest_process.stdout or ():
                    print(line.rstrip(), flush=True)
                    lines.append(line)
            finally:
                guest_process.kill()
    played = [line for line in lines if line.startswith('{"case"')]
    good = sum('"exact": true' in line for line in played)
    print(f"{good} of {len(played)} cases exact")
    wanted = len(chosen.cases) * chosen.repeat * len(chosen.buses)
    sys.exit(0 if good == wanted else 1)


if __name__ == "__main__":
    main()
