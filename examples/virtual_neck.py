"""The virtual neck: a step, its hysteresis loop and its slack tendons as figures.

Run `python examples/virtual_neck.py`; the pictures go to `build/virtual_neck`.
"""

from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import SAMPLE_TIME, Excitation, redefine, signal

OUT = Path("build/virtual_neck")
NECK = VirtualNeck(NeckParameters.paper())


def step_figure() -> None:
    """Pitch after a step of motor 1, for three payloads."""
    P = np.zeros((200, 3))
    P[25:, 0] = 3.0
    step = Excitation("step", np.arange(200) * SAMPLE_TIME, P)
    figure, axes = plt.subplots(3, 1, sharex=True, layout="constrained", figsize=(7, 6))
    for payload in (0.0, 0.3, 0.6):
        recording = record(step, NECK, payload=payload, noise=False)
        axes[0].plot(recording.time, np.degrees(recording.outputs[:, 0]), label=f"{payload:g} kg")
        axes[1].plot(recording.time, recording.channels["motor_position_1"])
        axes[2].plot(recording.time, recording.channels["tension_1"])
    for ax, name in zip(axes, ("pitch [deg]", "motor 1 [rad]", "tension 1 [N]"), strict=True):
        ax.set_ylabel(name)
    axes[0].legend()
    axes[2].set_xlabel("time [s]")
    figure.savefig(OUT / "step.svg")


def hysteresis_figure() -> None:
    """Pitch over theta_i, so slowly that neither lag nor viscosity shows."""
    t = np.arange(12_000) * SAMPLE_TIME
    theta = np.minimum(1.0, t / 60.0) * 3.0 * np.sin(2 * np.pi * t / 60.0)
    slow = Excitation("slow sine", t, theta[:, None] * np.array([2.0, -1.0, -1.0]) / 3.0)
    stiff = VirtualNeck(NECK.parameters.replace(hysteresis_torque=0.15))
    figure, ax = plt.subplots(layout="constrained", figsize=(7, 4))
    for neck, name in ((NECK, "paper"), (stiff, "hysteresis_torque = 0.15 N m")):
        recording = record(slow, neck, noise=False)
        ax.plot(redefine(recording.set_points)[:, 0], np.degrees(recording.outputs[:, 0]), label=name)
    ax.set(xlabel="theta_i [rad]", ylabel="pitch [deg]")
    ax.legend()
    figure.savefig(OUT / "hysteresis.svg")


def slack_figure() -> None:
    """Tensions during the paper's identification signal: where a curve is zero, the tendon is slack."""
    recording = record(signal("eq22", duration=20.0), NECK, seed=1)
    figure, axes = plt.subplots(2, 1, sharex=True, layout="constrained", figsize=(7, 5))
    axes[0].plot(recording.time, np.degrees(recording.outputs), label=["pitch", "roll"])
    axes[1].plot(recording.time, np.column_stack([recording.channels[f"tension_{j}"] for j in (1, 2, 3)]))
    axes[0].set_ylabel("angle [deg]")
    axes[0].legend()
    axes[1].set(xlabel="time [s]", ylabel="tension [N]")
    figure.savefig(OUT / "slack.svg")


def main() -> None:
    OUT.mkdir(parents=True, exist_ok=True)
    step_figure()
    hysteresis_figure()
    slack_figure()
    print(f"step.svg, hysteresis.svg and slack.svg are in {OUT}")


if __name__ == "__main__":
    main()
