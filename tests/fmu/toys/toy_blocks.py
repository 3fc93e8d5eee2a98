"""Two small blocks that exercise every kind of port."""

from __future__ import annotations

import numpy as np

from softneck.runtime import Block, Port

SAMPLE_TIME = 0.02


def lag(pole: float = 0.9, sample_time: float = SAMPLE_TIME) -> Block:
    return Block(
        kind="toy_lag",
        role="plant",
        runtime="toy_lag_runtime",
        sample_time=sample_time,
        arrays=(np.array([[pole, 0.0]]),),
        inputs=(
            Port(name="motor_setpoint_1", unit="rad", minimum=-6.0, maximum=6.0, description="drive <&>"),
            Port(name="driven", boolean=True, start=1.0),
            Port(name="extra", unit="N", missing=True, start=float("nan")),
        ),
        outputs=(
            Port(name="pitch", unit="rad", minimum=-100.0, maximum=100.0, nominal=0.5),
            Port(name="measurement_valid", boolean=True),
        ),
        parameters=(
            Port(name="pitch_start", unit="rad"),
            Port(name="noise_std", unit="rad", minimum=0.0, maximum=1.0),
            Port(name="noise_seed", minimum=0.0),
            Port(name="biased", boolean=True),
        ),
    )


def controller(gain: float = 0.4, sample_time: float = SAMPLE_TIME) -> Block:
    return Block(
        kind="toy_gain",
        role="controller",
        runtime="toy_gain_runtime",
        sample_time=sample_time,
        arrays=(np.array([0.05]),),
        inputs=(Port(name="pitch_reference", unit="rad"), Port(name="pitch", unit="rad")),
        outputs=(Port(name="motor_setpoint_1", unit="rad"),),
        parameters=(Port(name="gain", start=gain),),
    )


def neck(pole: float = 0.9) -> Block:
    return Block(
        kind="toy_neck",
        role="plant",
        runtime="toy_neck_runtime",
        sample_time=SAMPLE_TIME,
        arrays=(np.array([pole]),),
        inputs=(
            *(Port(name=f"motor_setpoint_{j}", unit="rad", minimum=-6.0, maximum=6.0) for j in (1, 2, 3)),
            Port(name="payload", unit="kg"),
        ),
        outputs=(
            *(Port(name=angle, unit="rad") for angle in ("pitch", "roll")),
            *(Port(name=f"motor_position_{j}", unit="rad") for j in (1, 2, 3)),
        ),
        parameters=tuple(Port(name=f"{angle}_start", unit="rad") for angle in ("pitch", "roll")),
    )


def pi(gain: float = 20.0) -> Block:
    return Block(
        kind="toy_pi",
        role="controller",
        runtime="toy_pi_runtime",
        sample_time=SAMPLE_TIME,
        arrays=(np.array([0.0, 1.0]),),
        inputs=(
            *(Port(name=f"{axis}_reference", unit="rad") for axis in ("pitch", "roll")),
            Port(name="cocontraction_reference", unit="rad", minimum=-6.0, maximum=6.0),
            *(Port(name=angle, unit="rad") for angle in ("pitch", "roll")),
        ),
        outputs=tuple(Port(name=f"motor_setpoint_{j}", unit="rad") for j in (1, 2, 3)),
        parameters=(Port(name="gain", start=gain),),
    )
