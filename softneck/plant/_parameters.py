"""The neck's numbers: unit, default, range and source of each, checks, presets, files, random necks."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from softneck.core import FileFormatError, ReprMixin, SettingsError, Vector, read_toml, require_between, require_one_of
from softneck.runtime import Port

from ._presets import PRESETS, SENSORS

# What `sample` scales: nobody has measured these on the neck.
_UNCERTAIN_NAMES = (
    "bending_stiffness", "bending_stiffening", "bending_damping", "axial_stiffness", "axial_damping",
    "hysteresis_torque", "hysteresis_angle", "platform_mass", "link_mass", "tendon_stiffness", "tendon_damping",
    "pretension", "guide_friction", "position_gain", "gear_friction", "sensor_lag", "sensor_delay", "drive_latency",
)  # fmt: skip


def _number(default: float, unit: str, low: float, high: float, text: str, source: str) -> Any:
    about = {"unit": unit, "low": low, "high": high, "text": text, "source": source}
    return field(default=default, metadata=about)


@dataclass(frozen=True, kw_only=True, repr=False)
class NeckParameters(ReprMixin):
    """Every number of the virtual neck; `about(name)` tells its unit, range and source.

    The defaults are the preset `paper`. Sources that read "calibrated" were fitted as the docs page "The
    virtual neck" tells; a "guess" is plausible and nothing more.
    """

    # geometry
    link_length: float = _number(0.107, "m", 0.03, 0.5, "length L0 of the unloaded link", "lab code, version 1")
    attachment_radius: float = _number(0.052, "m", 0.005, 0.2, "radius a of the tendons' attachment", "lab code")
    winch_radius: float = _number(
        0.0075, "m", 0.002, 0.05, "radius of the winch", "paper, section 3.1: pulley of 15 mm"
    )
    tendon_angle_1: float = _number(0.0, "rad", -7.0, 7.0, "direction of tendon 1", "paper, Eq. 5")
    tendon_angle_2: float = _number(2 * math.pi / 3, "rad", -7.0, 7.0, "direction of tendon 2", "paper, Eq. 5")
    tendon_angle_3: float = _number(4 * math.pi / 3, "rad", -7.0, 7.0, "direction of tendon 3", "paper, Eq. 5")
    # link
    bending_stiffness: float = _number(0.61, "N m/rad", 0.01, 20.0, "stiffness against bending", "calibrated")
    bending_stiffening: float = _number(0.2, "N m/rad^3", 0.0, 100.0, "cubic term of the stiffness", "calibrated")
    bending_damping: float = _number(0.06, "N m s/rad", 0.001, 10.0, "viscous loss of bending", "calibrated")
    axial_stiffness: float = _number(475.0, "N/m", 50.0, 1e5, "stiffness against compression", "calibrated")
    axial_stiffening: float = _number(0.0, "N/m^3", 0.0, 1e9, "cubic term of the axial stiffness", "guess")
    axial_damping: float = _number(25.0, "N s/m", 0.1, 1e3, "viscous loss of compression", "calibrated")
    compression_limit: float = _number(0.04, "m", 0.002, 0.2, "compression at which the link rests on itself", "guess")
    hysteresis_torque: float = _number(
        0.019, "N m", 0.0, 5.0, "largest torque of the rate-independent hysteresis", "calibrated"
    )
    hysteresis_angle: float = _number(
        0.045, "rad", 0.005, 1.0, "bending over which the hysteresis builds up", "calibrated"
    )
    stiffness_asymmetry: float = _number(
        -0.05, "1", -0.9, 0.9, "stiffness is (1 + this) in pitch, (1 - this) in roll", "calibrated"
    )
    stiffness_angle: float = _number(
        0.0, "rad", -3.2, 3.2, "turns the two planes of that asymmetry from tendon 1 towards roll", "off but in `rough`"
    )
    rest_pitch: float = _number(
        -0.0152, "rad", -0.3, 0.3, "bend of the unloaded printed link towards tendon 1", "calibrated"
    )
    rest_roll: float = _number(0.0135, "rad", -0.3, 0.3, "bend of the unloaded printed link across it", "calibrated")
    # masses
    platform_mass: float = _number(0.25, "kg", 0.02, 5.0, "platform with sensor", "guess")
    platform_height: float = _number(0.01, "m", -0.05, 0.2, "its centre of mass above the link's end", "guess")
    platform_radius: float = _number(0.06, "m", 0.0, 0.3, "radius of the platform, a disc", "guess")
    payload_height: float = _number(
        0.005, "m", -0.05, 0.3, "centre of mass of the payload above the link's end", "guess"
    )
    link_mass: float = _number(
        0.10, "kg", 0.0, 2.0, "mass of the link; a quarter of it moves with the platform", "guess"
    )
    # tendons
    tendon_stiffness: float = _number(
        1620.0, "N/m", 100.0, 2e5, "stiffness of tendon, anchors and guides in series", "calibrated"
    )
    tendon_damping: float = _number(4.0, "N s/m", 0.0, 500.0, "viscous loss of the tendon", "guess")
    pretension: float = _number(3.25, "N", 0.0, 50.0, "tension of each tendon at rest, after homing", "calibrated")
    guide_friction: float = _number(
        0.055, "1", 0.0, 0.5, "Coulomb friction of the guide as a part of the tension", "calibrated"
    )
    guide_speed: float = _number(0.01, "m/s", 0.0005, 0.1, "speed over which that friction is smoothed", "numerical")
    # drives
    drive_latency: float = _number(
        0.05, "s", 0.0, 0.1, "from set-point to drive: bus cycle and slow loop", "calibrated"
    )
    position_gain: float = _number(10.5, "1/s", 0.5, 200.0, "gain of the position loop", "calibrated")
    speed_limit: float = _number(15.6, "rad/s", 0.1, 100.0, "limit of the winch's speed", "lab code")
    speed_bandwidth: float = _number(150.0, "1/s", 10.0, 2000.0, "bandwidth of the speed loop", "guess")
    speed_integral_time: float = _number(0.05, "s", 0.002, 10.0, "integral time of the speed loop", "guess")
    current_limit: float = _number(0.0299, "A", 0.001, 0.144, "limit of the motor's current", "lab code")
    torque_constant: float = _number(0.0839, "N m/A", 0.001, 1.0, "motor constant", "maxon 118739")
    gear_ratio: float = _number(1539 / 65, "1", 1.0, 500.0, "reduction", "maxon 134777")
    gear_efficiency: float = _number(0.81, "1", 0.2, 1.0, "efficiency of the gear", "guess, typical of two stages")
    rotor_inertia: float = _number(
        1.15e-7, "kg m^2", 1e-9, 1e-4, "rotor with pinion", "guess, typical of a 16 mm motor"
    )
    supply_voltage: float = _number(48.0, "V", 1.0, 100.0, "supply of the drive", "maxon 118739")
    motor_resistance: float = _number(334.0, "ohm", 0.01, 2000.0, "terminal resistance", "maxon 118739")
    gear_friction: float = _number(0.004, "N m", 0.0, 1.0, "Coulomb friction of motor and gear at the winch", "guess")
    encoder_counts: float = _number(48490.0, "1", 0.0, 1e7, "counts per turn of the winch; 0: exact", "maxon 201937")
    position_limit: float = _number(6.0, "rad", 0.1, 100.0, "set-points are clamped to this", "paper, section 3.1")
    # inclinometer
    sensor_lag: float = _number(0.01, "s", 0.002, 1.0, "time constant of the attitude filter", "calibrated")
    sensor_delay: float = _number(0.05, "s", 0.0, 0.2, "transport delay", "calibrated")
    noise_std: float = _number(
        math.radians(0.05), "rad", 0.0, 0.2, "white noise of the angles", "paper preset: 0.05 deg"
    )
    noise_quantum: float = _number(0.0, "rad", 0.0, 0.1, "resolution of the angles", "guess")
    drift_std: float = _number(0.0, "rad", 0.0, 0.2, "standard deviation of the slow bias", "off in the paper preset")
    drift_time: float = _number(5.0, "s", 0.01, 1e5, "memory of the slow bias", "guess")
    rate_noise_std: float = _number(
        math.radians(0.1), "rad/s", 0.0, 1.0, "white noise of the rates", "MPU-9250 data sheet class"
    )
    rate_bias_std: float = _number(
        math.radians(0.2), "rad/s", 0.0, 1.0, "standard deviation of the rates' slow bias", "guess"
    )
    dropout_rate: float = _number(0.0, "1/s", 0.0, 100.0, "dropouts that start per second", "off in the paper preset")
    dropout_time: float = _number(0.1, "s", 0.001, 10.0, "mean length of a dropout", "guess")

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            if isinstance(value, bool) or not isinstance(value, int | float):
                raise SettingsError(f"`{item.name}` must be a number [{item.metadata['unit']}]; got {value!r}.")
            require_between(item.name, float(value), item.metadata["low"], item.metadata["high"], item.metadata["unit"])
        self._check_geometry()
        self.check_buckling(3)

    @classmethod
    def paper(cls) -> NeckParameters:
        """Return the neck calibrated to the paper's figures (Eq. 31, section 6.3)."""
        return cls()

    @classmethod
    def lab(cls) -> NeckParameters:
        """Return the neck fitted to the lab's own open-loop recording."""
        return cls(**PRESETS["lab"])

    @classmethod
    def rough(cls) -> NeckParameters:
        """Return the neck that is as hard for a line to follow as the paper's was (Tables 3 and 4)."""
        return cls(**PRESETS["rough"])

    @classmethod
    def preset(cls, name: str) -> NeckParameters:
        """Return the preset `paper`, `lab`, `rough` or `trunk`, or the neck of the TOML file of that name."""
        return cls(**PRESETS[name]) if name in PRESETS else cls.from_toml(name)

    @classmethod
    def from_toml(cls, path: str | Path) -> NeckParameters:
        """Return a preset with the values of the file; `preset = "lab"` in it starts from that one.

        Raises:
            FileFormatError: no such file, no TOML, or a key that is not a parameter.
            SettingsError: a value outside its range.
        """
        source = Path(path)
        content = read_toml(source, f"use {', '.join(PRESETS)} or a neck file (.toml)")
        preset = content.pop("preset", "paper")
        if not isinstance(preset, str) or preset not in PRESETS:
            raise FileFormatError(f"{source}: `preset` must be one of {', '.join(PRESETS)}; got {preset!r}.")
        names = cls.names()
        unknown = [name for name in content if name not in names]
        if unknown:
            raise FileFormatError(
                f"{source}: `{unknown[0]}` is not a parameter of the neck; it has {', '.join(names)}."
            )
        try:
            return dataclasses.replace(cls.preset(preset), **content)
        except SettingsError as error:
            raise SettingsError(f"{source}: {error}") from error

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """Return the names of all parameters, in the runtime's order."""
        return tuple(item.name for item in dataclasses.fields(cls))

    @classmethod
    def about(cls, name: str) -> dict[str, Any]:
        """Return unit, low, high, text and source of the parameter `name`."""
        for item in dataclasses.fields(cls):
            if item.name == name:
                return dict(item.metadata)
        raise SettingsError(f"`{name}` is not a parameter of the neck; it has {', '.join(cls.names())}.")

    def vector(self) -> Vector:
        """Return the numbers in the runtime's order, shape (n,)."""
        return np.array([float(getattr(self, name)) for name in self.names()])

    def ports(self) -> tuple[Port, ...]:
        """Return the FMI parameters of this neck."""
        return tuple(
            Port(
                name=item.name,
                unit=item.metadata["unit"],
                description=item.metadata["text"],
                start=float(getattr(self, item.name)),
                minimum=item.metadata["low"],
                maximum=item.metadata["high"],
            )
            for item in dataclasses.fields(self)
        )

    def replace(self, **changes: float) -> NeckParameters:
        """Return the same neck with other numbers.

        Raises:
            SettingsError: no such parameter, or a value outside its range.
        """
        for name in changes:
            self.about(name)
        return dataclasses.replace(self, **changes)

    def with_sensor(self, name: str) -> NeckParameters:
        """Return the same neck with one of the lab's inclinometers, `mpu9250` or `3dm-gx5`."""
        require_one_of("sensor", name, tuple(SENSORS))
        return self.replace(**SENSORS[name])

    def sample(self, rng: np.random.Generator, *, spread: float = 0.2) -> NeckParameters:
        """Return a plausible neck around this one, for robustness studies.

        What is measured with a ruler, fixed by a data sheet or a setting stays; stiffnesses, losses,
        masses, friction, gains and delays are scaled by exp(spread n) with n standard normal, cut at 2.5;
        the link's asymmetry and rest bend are shifted by 0.05 and 0.005 rad times n.

        Args:
            rng: random generator.
            spread: relative standard deviation.
        """
        require_between("spread", spread, 0.0, 0.5)
        for _ in range(100):
            changes = {name: self._scale_randomly(name, spread, rng) for name in _UNCERTAIN_NAMES}
            for name, size in (("stiffness_asymmetry", 0.05), ("rest_pitch", 0.005), ("rest_roll", 0.005)):
                changes[name] = getattr(self, name) + size * spread / 0.2 * float(rng.standard_normal())
            try:
                return self.replace(**changes)
            except SettingsError:  # this draw would buckle or leaves a range: not plausible, draw again
                continue
        raise SettingsError(f"no plausible neck within a spread of {spread:g} was found; lower `spread`.")

    def without_noise(self) -> NeckParameters:
        """Return the same neck with a perfect sensor: its lag and delay stay, all that is random goes."""
        return self.replace(
            noise_std=0.0, noise_quantum=0.0, drift_std=0.0, rate_noise_std=0.0, rate_bias_std=0.0, dropout_rate=0.0
        )

    def _scale_randomly(self, name: str, spread: float, rng: np.random.Generator) -> float:
        number = float(np.clip(rng.standard_normal(), -2.5, 2.5))
        return float(getattr(self, name)) * math.exp(spread * number)

    def _check_geometry(self) -> None:
        if self.compression_limit >= 0.9 * self.link_length:
            raise SettingsError(
                f"`compression_limit` must be below 0.9 of `link_length` ({0.9 * self.link_length:g} m); "
                f"got {self.compression_limit:g}."
            )
        stretch = self.pretension / self.tendon_stiffness
        shortest = self.link_length - self.compression_limit
        if stretch >= shortest:
            raise SettingsError(
                f"`pretension` {self.pretension:g} N stretches the tendons by {stretch:g} m: their free length "
                f"would be shorter than the link allows ({shortest:g} m). Lower it or raise `tendon_stiffness`."
            )

    def check_buckling(self, tendons: int) -> None:
        """Raise SettingsError where the weight, and so many tendons at their pretension, would buckle the link."""
        # Straight link: the tendons' tension and the weight take from the bending stiffness (d^2 U / d b^2).
        weight = 9.80665 * (self.platform_mass + 0.25 * self.link_mass)
        moment = 9.80665 * self.platform_mass * self.platform_height
        pressed = tendons * self.pretension * self.link_length / 12.0
        lost = pressed + weight * self.link_length / 3.0 + moment
        least = self.bending_stiffness * (1.0 - abs(self.stiffness_asymmetry))
        if lost >= 0.9 * least:
            raise SettingsError(
                f"`bending_stiffness` must exceed {lost / 0.9 / (1 - abs(self.stiffness_asymmetry)):.3g} N m/rad to "
                f"carry pretension and platform without buckling; got {self.bending_stiffness:g}."
            )
