"""The virtual neck as a block that loops, FMUs and recordings share."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softneck.core import SettingsError, require_between
from softneck.runtime import Block, Port

from ._parameters import NeckParameters

RUNTIME = "softneck.plant._neck_runtime"
# Longest internal step [s]: the fastest mode of the presets is then 0.5 to 0.9 of the inverse step.
INTERNAL_STEP = 0.001
# What the queues must hold: the upper ends of `drive_latency` and `sensor_delay` [s].
_LONGEST_LATENCY = 0.1
_LONGEST_DELAY = 0.2


def _inputs(limit: float) -> tuple[Port, ...]:
    set_points = tuple(
        Port(name=f"motor_setpoint_{i}", unit="rad", description=f"position of winch {i}; positive pulls",
             minimum=-limit, maximum=limit, nominal=1.0)
        for i in (1, 2, 3)
    )  # fmt: skip
    return (
        *set_points,
        Port(name="payload", unit="kg", description="mass on the platform", minimum=0.0, maximum=5.0),
        Port(name="push_x", unit="N", description="push on the platform in the direction of tendon 1"),
        Port(name="push_y", unit="N", description="push on the platform, a quarter turn from tendon 1"),
        Port(name="base_tilt_pitch", unit="rad", description="lean of the base in pitch", minimum=-1.5, maximum=1.5),
        Port(name="base_tilt_roll", unit="rad", description="lean of the base in roll", minimum=-1.5, maximum=1.5),
    )


def _outputs() -> tuple[Port, ...]:
    return (
        Port(name="pitch", unit="rad", description="true inclination against the vertical, towards tendon 1"),
        Port(name="roll", unit="rad", description="true inclination against the vertical, across it"),
        Port(name="pitch_measured", unit="rad", description="pitch as the inclinometer gives it"),
        Port(name="roll_measured", unit="rad", description="roll as the inclinometer gives it"),
        Port(name="pitch_rate_measured", unit="rad/s", description="pitch rate of the gyro"),
        Port(name="roll_rate_measured", unit="rad/s", description="roll rate of the gyro"),
        Port(name="measurement_valid", description="false while the inclinometer drops out", boolean=True, start=1.0),
        *(Port(name=f"motor_position_{i}", unit="rad", description=f"encoder of winch {i}") for i in (1, 2, 3)),
        *(Port(name=f"tension_{i}", unit="N", description=f"tension of tendon {i} at its winch") for i in (1, 2, 3)),
        Port(name="compression", unit="m", description="axial compression of the link"),
    )


@dataclass(frozen=True, slots=True)
class VirtualNeck:
    """A physics model of the tendon-driven soft neck (docs, "The virtual neck")."""

    parameters: NeckParameters

    def block(self, *, noise_seed: int = 0, sample_time: float = 0.02, internal_step: float = INTERNAL_STEP) -> Block:
        """Return the neck as a plant of that sample time [s].

        Args:
            noise_seed: seed of the sensor's noise; equal seeds give equal bits.
            sample_time: [s], 0.001 to 0.1.
            internal_step: longest [s]; a sample takes as few equal steps as keep within it. Stiff necks take more.

        Raises:
            SettingsError: a time out of range, or a seed that is not an integer >= 0.
        """
        require_between("sample_time", sample_time, 0.001, 0.1, "s")
        require_between("internal_step", internal_step, 1e-6, sample_time, "s")
        # 1e-9: 0.003 / 0.001 is a little more than 3, by rounding only.
        substeps = math.ceil(sample_time / internal_step * (1.0 - 1e-9))
        if isinstance(noise_seed, bool) or noise_seed != int(noise_seed) or not 0 <= noise_seed < 2**31 - 1:
            raise SettingsError(f"`noise_seed` must be an integer from 0 to 2147483646; got {noise_seed}.")
        queue = math.ceil(_LONGEST_LATENCY / sample_time) + 1
        history = math.ceil(_LONGEST_DELAY / sample_time) + 2
        seed = Port(
            name="noise_seed", description="seed of the sensor's noise", start=float(noise_seed), minimum=0.0,
            integer=True,
        )  # fmt: skip
        return Block(
            kind="virtual_neck",
            role="plant",
            runtime=RUNTIME,
            sample_time=sample_time,
            arrays=([[sample_time, substeps, queue, history]],),  # pyright: ignore[reportArgumentType]
            inputs=_inputs(self.parameters.position_limit),
            outputs=_outputs(),
            parameters=(*self.parameters.ports(), seed),
        )

    def summary(self) -> str:
        """Return a few lines on the neck, for people."""
        p = self.parameters
        return "\n".join(
            [
                "virtual neck: a physics model of the tendon-driven soft neck",
                f"link {1e3 * p.link_length:.1f} mm, tendons at {1e3 * p.attachment_radius:.1f} mm, "
                f"winch {1e3 * p.winch_radius:.1f} mm",
                f"inclinometer noise {math.degrees(p.noise_std):.3f} deg",
            ]
        )
