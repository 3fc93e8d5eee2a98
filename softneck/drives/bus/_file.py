"""The drives file: node ids, gear, encoder, signs, limits, sensor, guarding, and the robot that the drives move."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from softneck.core import ReprMixin, SettingsError, require_between, require_one_of, require_positive, require_whole
from softneck.robot import Robot
from softneck.signals import NECK

from ..master import MasterSettings
from ..master._fieldbus import BusSettings
from ..master._settings import LimitSettings, RampSettings, Ranged, WatchSettings, setting
from ..supervision._baseline import Baseline
from ._robot import channels_of, count_word, ranges, require_signs
from ._sensor_source import SENSORS, SensorSource, axes_of
from ._units import DriveScale, current_to_internal, internal_to_current

# Stuffing at its worst needs a fifth more than frames of real data: this part of a bus works and leaves some for SDO,
# emergencies and repeated frames.
MOST = 0.9
# Of set-points, of a drive's answer, of guarding (request, answer, heartbeat), of an inclinometer [bytes].
_RPDO, _TPDO, _GUARD, _SLOPES = 6, 8, 1, 8


def frame_bits(size: int, *, remote: bool = False) -> int:
    """Return the bits of a frame of `size` bytes, with stuffing and interframe space.

    A remote request carries none of them. (Davis, Burns et al. 2007, Eq. 2: g = 34 bits are stuffed beside the data.)
    """
    data = 0 if remote else 8 * size
    return data + 47 + (34 + data - 1) // 4


def bus_load(drives: int, *, cycle: float, guard_cycles: int, bit_rate: int, sensor_period: float = 0.0) -> float:
    """Return the part of the bus that set-points, SYNC, answers, life guarding and an inclinometer need.

    `drives`: number of them. `cycle`: of the bus [s]. `guard_cycles`: between two guarding requests to each.
    `bit_rate`: [bit/s]. `sensor_period`: of an inclinometer on the bus [s]; 0 for none.
    """
    each = frame_bits(_RPDO) + frame_bits(_TPDO)
    each += (frame_bits(_GUARD, remote=True) + frame_bits(_GUARD)) / guard_cycles
    bits = (drives * each + frame_bits(0)) / cycle
    return (bits + (frame_bits(_SLOPES) / sensor_period if sensor_period else 0.0)) / bit_rate


PROFILES = ("ipos2015", "ds402")
# Time in which a drive must notice that the master is gone [s] (fault table: 110 ms with its own slow loop).
_LONGEST_LIFE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveEntry:
    """One [[drive]].

    Attributes:
        node: number on the bus.
        scale: gear, encoder, sign, slow loop, peak current.
        current_limit: of the motor [A].
        vendor, product, serial: identity (1018h), None where any will do.
        firmware: text of 100Ah, None where any will do.
    """

    node: int
    scale: DriveScale
    current_limit: float = 0.0299
    vendor: int | None = None
    product: int | None = None
    serial: int | None = None
    firmware: str | None = None

    def __post_init__(self) -> None:
        require_whole("node", self.node, 1, 126)
        require_positive("current_limit_A", self.current_limit, "A")
        if self.current_limit > self.scale.peak_current:
            raise SettingsError(
                f"`current_limit_A` {self.current_limit:g} is beyond the drive's peak current "
                f"{self.scale.peak_current:g} A; lower it, or correct `peak_current_A`."
            )
        if current_to_internal(self.current_limit, self.scale) == 0:
            raise SettingsError(
                f"`current_limit_A` {self.current_limit:g} is less than one unit of a drive with a peak current of "
                f"{self.scale.peak_current:g} A; is it in amperes?"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarding(Ranged):
    """How drives notice that the master is gone.

    Attributes:
        kind: "auto" probes for a heartbeat consumer (1016h) and takes life guarding where there is none.
        time: after which they act [s].
    """

    kind: str = field(default="auto", metadata={"key": "kind"})
    time: float = setting("time_s", 0.1, 0.02, _LONGEST_LIFE)

    def __post_init__(self) -> None:
        Ranged.__post_init__(self)
        require_one_of("kind", self.kind, ("auto", "life", "heartbeat"))


@dataclass(frozen=True, slots=True, kw_only=True)
class ZeroSettings(Ranged):
    """How `softneck drives commission --only zero` tensions the tendons.

    `current`: of the motor while it pulls [A]; by default 3.25 N with [neck]'s radius, constant and efficiency, the
    pretension of the virtual neck, so that its rest is the zero. At 3.8 N Eq. 22 leaves the motors behind. `speed`: of
    the winch while it pulls [rad/s]. `tilt`: the neck must be upright within this then [rad].
    """

    current: float = setting("current_A", 0.0151, 1e-6, 100.0)
    speed: float = setting("speed_rad_s", 1.0, 0.25, 5.0)
    tilt: float = setting("tilt_deg", math.radians(5.0), math.radians(0.1), math.radians(45.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class Neck(Ranged):
    """Constants that convert motor current into tension.

    `winch_radius`: [m]. `torque_constant`: [N m/A]. `efficiency`: of the gear.
    """

    winch_radius: float = setting("winch_radius_m", 0.0075, 1e-6, 10.0)
    torque_constant: float = setting("torque_constant_Nm_A", 0.0839, 1e-6, 100.0)
    efficiency: float = setting("gear_efficiency", 0.81, 0.1, 1.0)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DrivesFile(ReprMixin):
    """The content of a drives file (`drives.toml`).

    Attributes:
        profile: "ipos2015" or "ds402".
        drives: of the motors, in their order.
        cycle: bus period [s].
        bit_rate: [bit/s].
        guarding, zero, neck, limits, watch, ramps: the tables of those names.
        sensor_kind, sensor_node: "simulated", or "can" for a CiA 410 inclinometer at that node; others need
            `sensor_source`.
        sensor_axes: which of the sensor's own axes each output is, "-" before one that is reversed; () where it sits
            as it should.
        sensor_angle: what is measured beyond it is none of what the drives move [rad].
        quick_stop: deceleration of a quick stop (6085h) [rad/s^2].
        following: window (6065h) [rad].
        robot: what the drives move; None: the neck, with no limits beside those here.
        baseline: undisturbed motion, by which plausibility is judged; None: it is not.
    """

    profile: str
    drives: tuple[DriveEntry, ...]
    cycle: float = 0.01
    bit_rate: int = 1_000_000
    guarding: Guarding = field(default_factory=Guarding)
    zero: ZeroSettings = field(default_factory=ZeroSettings)
    neck: Neck = field(default_factory=Neck)
    limits: LimitSettings = field(default_factory=LimitSettings)
    watch: WatchSettings = field(default_factory=WatchSettings)
    ramps: RampSettings = field(default_factory=RampSettings)
    sensor_kind: str = "simulated"
    sensor_node: int = 10
    sensor_angle: float = 1.2
    sensor_source: SensorSource = field(default_factory=SensorSource)
    sensor_axes: tuple[str, ...] = ()
    quick_stop: float = 200.0
    following: float = 2.0
    robot: Robot | None = None
    baseline: Baseline | None = None

    def __post_init__(self) -> None:
        require_one_of("profile", self.profile, PROFILES)
        require_between("period_s", self.cycle, 0.005, 0.05, "s")
        require_whole("bit_rate", self.bit_rate, 10_000, 1_000_000)
        require_between("quick_stop_rad_s2", self.quick_stop, 1.0, 1e5, "rad/s^2")
        require_between("following_rad", self.following, 0.01, 20.0, "rad")
        require_between("angle", self.sensor_angle, 0.1, 1.6, "rad")
        require_one_of("kind", self.sensor_kind, SENSORS)
        require_whole("node", self.sensor_node, 1, 126)
        nodes, motors = self.nodes, len(self.moves.motors.names)
        if len(nodes) != motors:
            raise SettingsError(f"there are {len(nodes)} drives for the {motors} motors of robot {self.moves.label()}.")
        if len(set(nodes)) != motors:
            word = count_word(motors)
            raise SettingsError(f"the {word} drives need {word} node numbers; got {', '.join(map(str, nodes))}.")
        if self.sensor_kind == "can" and self.sensor_node in nodes:
            raise SettingsError(f"[sensor] node {self.sensor_node} is that of a drive; each device needs its own.")
        axes_of(self.sensor_axes, self.moves.outputs.names)
        if self.baseline is not None and (self.baseline.motors, self.baseline.outputs) != (motors, self._outputs):
            raise SettingsError(
                f"[supervision] `baseline` is of {self.baseline.motors} motors and {self.baseline.outputs} outputs; "
                f"there are {motors} and {self._outputs}. Make one from logs of these drives "
                "(`softneck.drives.baseline`)."
            )
        if self.robot is not None:
            require_signs([drive.scale.reversed for drive in self.drives], self.robot)
        if self.load > MOST:
            raise SettingsError(
                f"{motors} drives every {1e3 * self.cycle:g} ms would take {100.0 * self.load:.0f} % of a bus with "
                f"{self.bit_rate:g} bit/s; at most {100.0 * MOST:g} % work. Raise `bit_rate` or `period_s` of [bus]."
            )

    @property
    def _outputs(self) -> int:
        return len(self.moves.outputs.names)

    @property
    def nodes(self) -> tuple[int, ...]:
        """Node numbers of the motors."""
        return tuple(drive.node for drive in self.drives)

    @property
    def moves(self) -> Robot:
        """The robot that the drives move; the neck if the file names none."""
        return self.robot or NECK

    @property
    def ranges(self) -> tuple[tuple[float, float, float], ...]:
        """Of each motor: lowest and highest set-point [rad], largest speed [rad/s]; the tighter of robot and file."""
        return ranges(self.robot, self.limits)

    @property
    def weights(self) -> tuple[tuple[float, ...], ...]:
        """Directions of the outputs, (outputs, motors); () where they are to be identified."""
        channels = channels_of(self.robot, self.limits)
        return self.watch.weights if channels is None or channels.weights is None else channels.weights

    @property
    def load(self) -> float:
        """The part of the bus that the cyclic traffic takes at worst."""
        return bus_load(
            len(self.drives),
            cycle=self.cycle,
            guard_cycles=self.guard_cycles,
            bit_rate=self.bit_rate,
            # No inclinometer sends more often than the bus turns.
            sensor_period=self.cycle if self.sensor_kind == "can" else 0.0,
        )

    @property
    def guard_cycles(self) -> int:
        """Cycles between two heartbeats of the master: five of them fit into the guarding time."""
        return max(1, math.floor(self.guarding.time / 5.0 / self.cycle + 1e-9))

    def master_settings(
        self, sample_time: float, *, guarding: str = "life", late_modes: tuple[int, ...] = ()
    ) -> MasterSettings:
        """Return the master's settings for controllers of `sample_time` [s].

        Args:
            sample_time: of the controller [s].
            guarding: "life" or "heartbeat".
            late_modes: nodes that take their mode in Operation Enabled alone.

        Raises:
            SettingsError: the bus period does not divide the sample time.
        """
        ratio = sample_time / self.cycle
        if round(ratio) < 1 or not math.isclose(ratio, round(ratio), rel_tol=1e-6):
            raise SettingsError(
                f"the bus period {self.cycle:g} s must divide the controller's sample time {sample_time:g} s; "
                "change `period_s` of [bus]."
            )
        b = self.baseline
        if b is not None and not (math.isclose(b.cycle, self.cycle) and b.sample_cycles == round(ratio)):
            raise SettingsError(
                f"[supervision] `baseline` is of samples every {b.cycle * b.sample_cycles:g} s on a bus of "
                f"{b.cycle:g} s; these are {sample_time:g} s and {self.cycle:g} s. Record one for them."
            )
        scales, neck = [drive.scale for drive in self.drives], self.neck
        # A ds402 drive tells its current in thousandths of the motor's rated one.
        units = [math.copysign(1e-3 * 0.06, scale.counts_per_radian) if self.profile == "ds402" else
                 internal_to_current(1, scale) for scale in scales]  # fmt: skip
        n = [unit * neck.torque_constant * neck.efficiency * scale.gear / neck.winch_radius
             for unit, scale in zip(units, scales, strict=True)]  # fmt: skip
        bus = BusSettings(
            nodes=self.nodes, cycle=self.cycle, guarding=guarding, guard_cycles=self.guard_cycles, late_modes=late_modes
        )
        return MasterSettings(
            counts_per_radian=tuple(scale.counts_per_radian for scale in scales),
            newton_per_unit=tuple(n),
            sample_cycles=round(ratio),
            bus=bus,
            limits=self.limits,
            angle=self.sensor_angle,
            watch=self.watch,
            ramps=self.ramps,
            channels=channels_of(self.robot, self.limits),
            baseline=b,
        )


def default_drives(profile: str = "ipos2015", *, robot: Robot | None = None, **changes: Any) -> DrivesFile:
    """Return the default file of simulated drives: nodes from 1 on, the lab's set-up."""
    entries = []
    for node, sign in enumerate((robot or NECK).motors.sign, start=1):
        entries.append(DriveEntry(node=node, scale=DriveScale(peak_current=10.0, reversed=sign < 0.0)))
    radius = None if robot is None else robot.winch_radius_m
    neck = Neck() if radius is None else Neck(winch_radius=radius)
    file = DrivesFile(profile=profile, drives=tuple(entries), neck=neck, robot=robot)
    return dataclasses.replace(file, **changes)
