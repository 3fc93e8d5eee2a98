"""The virtual neck as a block that loops, FMUs and recordings share; its physics for other tendon-driven robots."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from softneck.core import Matrix, ReprMixin, SettingsError, require_between, to_si
from softneck.robot import Robot
from softneck.runtime import Block, Port, sized_name

from ._parameters import NeckParameters
from ._presets import PRESETS

RUNTIME = "softneck.plant._neck_runtime"
# Longest internal step [s]: the fastest mode of the presets is then 0.5 to 0.9 of the inverse step.
INTERNAL_STEP = 0.001
# What the queues must hold: the upper ends of `drive_latency` and `sensor_delay` [s].
_LONGEST_LATENCY = 0.1
_LONGEST_DELAY = 0.2
# Where the tendons of a neck file are meant to stand, and how many outputs it bends [deg].
_MEANT, _BENDS = (0.0, 120.0, 240.0), 2


def _angles(robot: Robot) -> tuple[float, ...]:
    return robot.directions.angles_for(robot.outputs.names)


def has_own_tendons(robot: Robot) -> bool:
    """Return whether a robot's tendons are at 0, 120 and 240 deg, whose measured angles a neck file holds."""
    return _angles(robot) == _MEANT and len(robot.outputs.names) == _BENDS


def tendons_of(robot: Robot, parameters: NeckParameters) -> tuple[float, ...]:
    """Return the tendon angles of a robot [rad]: from the neck file's measurement, else from its robot file."""
    if has_own_tendons(robot):
        return parameters.tendon_angle_1, parameters.tendon_angle_2, parameters.tendon_angle_3
    return tuple(math.radians(angle % 360.0) for angle in _angles(robot))


def _inputs(robot: Robot, ranges: Matrix) -> tuple[Port, ...]:
    set_points = tuple(
        Port(name=name, unit="rad", description=f"position of winch {j + 1}; positive pulls", minimum=float(low),
             maximum=float(high), nominal=1.0)
        for j, (name, (low, high)) in enumerate(zip(robot.set_points, ranges, strict=True))
    )  # fmt: skip
    outputs, shown = robot.outputs.names, robot.outputs.shown
    pushes = ("in the direction of 0 deg", "in the direction of 90 deg")
    if _angles(robot)[0] == 0.0:
        pushes = ("in the direction of tendon 1", "a quarter turn from tendon 1")
    return (
        *set_points,
        Port(name="payload", unit="kg", description="mass on the platform", minimum=0.0, maximum=5.0),
        *(
            Port(name=name, unit="N", description=f"push on the platform {where}")
            for name, where, _ in zip(("push_x", "push_y"), pushes, outputs, strict=False)
        ),
        *(
            Port(name=f"base_tilt_{name}", unit="rad", description=f"lean of the base in {name}", minimum=-1.5,
                 maximum=1.5, display_unit=shown)
            for name in outputs
        ),
    )  # fmt: skip


def _outputs(robot: Robot) -> tuple[Port, ...]:
    outputs, motors = robot.outputs.names, range(1, len(robot.motors.names) + 1)
    first, shown = _angles(robot)[0] == 0.0, robot.outputs.shown
    towards = ("towards tendon 1", "across it") if first else ("towards 0 deg", "towards 90 deg")
    return (
        *(
            Port(
                name=name, unit="rad", description=f"true inclination against the vertical, {where}", display_unit=shown
            )
            for name, where in zip(outputs, towards, strict=False)
        ),
        *(
            Port(
                name=f"{name}_measured",
                unit="rad",
                description=f"{name} as the inclinometer gives it",
                display_unit=shown,
            )
            for name in outputs
        ),
        *(Port(name=f"{name}_rate_measured", unit="rad/s", description=f"{name} rate of the gyro") for name in outputs),
        Port(name="measurement_valid", description="false while the inclinometer drops out", boolean=True, start=1.0),
        *(
            Port(name=name, unit="rad", description=f"encoder of winch {i}")
            for i, name in enumerate(robot.motor_positions, start=1)
        ),
        *(Port(name=f"tension_{i}", unit="N", description=f"tension of tendon {i} at its winch") for i in motors),
        Port(name="compression", unit="m", description="axial compression of the link"),
    )


@dataclass(frozen=True, slots=True, repr=False)
class VirtualNeck(ReprMixin):
    """A physics model of the tendon-driven soft neck (docs, "The virtual neck"), or of a robot built like it.

    Attributes:
        parameters: its numbers; the tendons' angles in them are a neck's, other robots tell their own.
        robot: whose tendons, outputs and limits of set-points these are; one output: it bends in one plane.

    Raises:
        SettingsError: a robot without tendons that turn angles, or a link that so many tendons would buckle.

    Example:
        >>> import numpy as np
        >>> import softneck
        >>> from softneck.plant import NeckParameters
        >>> block = softneck.VirtualNeck(NeckParameters.paper()).block()
        >>> state, outputs = block.step(block.initial_state(), np.zeros(len(block.inputs)))
        >>> [port.name for port in block.outputs][:2]
        ['pitch', 'roll']
    """

    parameters: NeckParameters
    robot: Robot = field(default_factory=Robot.preset)

    def __post_init__(self) -> None:
        require_tendons(self.robot)
        self.parameters.check_buckling(len(self.robot.motors.names))

    @classmethod
    def of(cls, robot: Robot, neck: NeckParameters | None = None) -> VirtualNeck:
        """Return the virtual plant of a robot.

        What the robot gives of winch, limits and sensor takes the place of the neck's; the preset `neck` gives nothing.

        Args:
            robot: whose.
            neck: its physics; None takes those that the robot's `plant.neck` names.

        Raises:
            SettingsError: the robot names no plant, or one of its values is not of a tendon-driven robot.
        """
        require_tendons(robot)
        if neck is None:
            name = robot.require("neck", "the virtual plant")
            inside = robot.folder is not None and name not in PRESETS
            neck = NeckParameters.preset(str(robot.folder / name) if inside else name)  # pyright: ignore[reportOptionalOperand]
        if not robot.in_header():
            return cls(neck)
        scale = to_si(robot.outputs.unit)[0]
        given = {
            "winch_radius": robot.winch_radius_m,
            "position_limit": None if robot.motors.setpoint_max is None else float(np.abs(_ranges(robot, 0.0)).max()),
            "sensor_delay": robot.delay_s,
            "noise_std": None if robot.noise_std is None else scale * robot.noise_std,
        }
        return cls(neck.replace(**{name: value for name, value in given.items() if value is not None}), robot)

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
        motors, outputs = len(self.robot.motors.names), len(self.robot.outputs.names)
        setup = [sample_time, substeps, queue, history] + [motors, outputs] * ((motors, outputs) != (3, 2))
        seed = Port(
            name="noise_seed", description="seed of the sensor's noise", start=float(noise_seed), minimum=0.0,
            integer=True,
        )  # fmt: skip
        return Block(
            kind="virtual_neck",
            role="plant",
            runtime=sized_name(RUNTIME, motors, outputs),
            sample_time=sample_time,
            arrays=([setup],),  # pyright: ignore[reportArgumentType]
            inputs=_inputs(self.robot, self.ranges()),
            outputs=_outputs(self.robot),
            parameters=(*self._parameter_ports(), seed),
        )

    def ranges(self) -> Matrix:
        """Return lower and upper limit of each set-point, (motors, 2) [rad]."""
        return _ranges(self.robot, self.parameters.position_limit)

    def _parameter_ports(self) -> tuple[Port, ...]:
        ports = self.parameters.ports()
        if has_own_tendons(self.robot):
            return ports
        first = [port.name for port in ports].index("tendon_angle_1")
        angles = tuple(
            Port(name=f"tendon_angle_{j}", unit="rad", description=f"direction of tendon {j}",
                 start=angle, minimum=-7.0, maximum=7.0)
            for j, angle in enumerate(tendons_of(self.robot, self.parameters), 1)
        )  # fmt: skip
        return (*ports[:first], *angles, *ports[first + 3 :])

    def summary(self) -> str:
        """Return a few lines on the neck, for people."""
        p = self.parameters
        what = f"robot {self.robot.label()}" if self.robot.in_header() else "the tendon-driven soft neck"
        return "\n".join(
            [
                f"virtual neck: a physics model of {what}",
                f"link {1e3 * p.link_length:.1f} mm, tendons at {1e3 * p.attachment_radius:.1f} mm, "
                f"winch {1e3 * p.winch_radius:.1f} mm",
                f"inclinometer noise {math.degrees(p.noise_std):.3f} deg",
            ]
        )


def _ranges(robot: Robot, limit: float) -> Matrix:
    """Return lower and upper limit of each set-point [rad]; +-`limit` if none is given."""
    scale, motors = to_si(robot.motors.unit)[0], len(robot.motors.names)
    given = (robot.motors.setpoint_min, robot.motors.setpoint_max) if robot.in_header() else (None, None)
    low, high = (np.full(motors, end) if side is None else scale * np.array(side)
                 for side, end in zip(given, (-limit, limit), strict=True))  # fmt: skip
    return np.column_stack([low, high])


def require_tendons(robot: Robot, what: str = "the virtual plant") -> None:
    """Raise SettingsError unless tendons on winches bend the robot; `what` names the caller."""
    for part, unit in (("motors", robot.motors.unit), ("outputs", robot.outputs.unit)):
        if to_si(unit)[1] != "rad":
            raise SettingsError(
                f"{what} has {part} in rad or deg, and `{part}.unit` of robot {robot.label()} is {unit}."
            )
    if robot.directions.kind != "tendons":
        raise SettingsError(
            f"{what} must know where tendons stand, and `directions` of robot {robot.label()} are "
            f'"{robot.directions.kind}"; write kind = "tendons" and angles_deg.'
        )
