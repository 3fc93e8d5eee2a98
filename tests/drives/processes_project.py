"""The project that the processes of `processes.py` run: controller, observer, loop files, drives file; its link."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path
from typing import Any

LOOP = (Path(__file__).parent / "processes_loop.toml").read_text()
HANGS = (Path(__file__).parent / "hanging_observer.py").read_text()
DRIVES = """profile = "{profile}"
bus.period_s = {period}
ramp = {{ settle_s = 0.1, speed_rad_s = 3.0, tolerance_rad = 0.2 }}
sensor = {{ kind = "can", node = 10 }}
guarding.time_s = {guarding}
""" + "".join(f"[[drive]]\nnode = {node}\npeak_current_A = 10.0\n" for node in (1, 2, 3))


def write_project(
    folder: Path, *, duration: float = 3.0, period: float = 0.01, guarding: float = 0.1, profile: str = "ipos2015"
) -> None:
    """Write controller, observer, loop files and drives file; no experiment is needed: the plant is Eq. 31's."""
    import control

    from softneck.design import PiSettings
    from softneck.estimation import KalmanSettings, LinearNeck

    step = 0.02
    pole = math.exp(-5.293 * step)
    tf = control.TransferFunction([0.0913 * (1.0 - pole)], [1.0, -pole, 0.0, 0.0, 0.0, 0.0], step)
    model = LinearNeck(pitch=tf, roll=tf)
    PiSettings().design(model).save(folder / "pi.npz")
    KalmanSettings(sensor="paper").design(model).save(folder / "kalman.npz")
    for name, seconds, observer in (
        ("loop", 60.0, 'file = "kalman.npz"'), ("short", duration, 'file = "kalman.npz"'),
        ("hangs", 60.0, 'python = "hanging_observer:make"'),
    ):  # fmt: skip
        (folder / f"{name}.toml").write_text(LOOP.format(duration=seconds, observer=observer), encoding="utf-8")
    (folder / "hanging_observer.py").write_text(HANGS, encoding="utf-8")
    (folder / "drives.toml").write_text(
        DRIVES.format(profile=profile, period=period, guarding=guarding), encoding="utf-8"
    )


def too_busy(found: dict[str, Any], longest_step: float, guarding: float) -> bool:
    """Whether the machine held the host up, though nobody stopped it: a step took half the drives' guarding time.

    Their last frame may be as old as the other half, and then the host meets their emergency first.
    """
    return not found["exact"] and found["case"] != "paused" and longest_step > 0.5 * guarding


def bring_up(link: str) -> None:
    """Set a link up; multicast over the loopback needs a route."""
    subprocess.run(["ip", "link", "set", link, "up"], check=True)
    if link == "lo":
        subprocess.run(["ip", "link", "set", "lo", "multicast", "on"], check=True)
        subprocess.run(["ip", "route", "add", "224.0.0.0/4", "dev", "lo"], check=True)
