"""Simulated drives that are not set up as the drives file says: what a commissioning has to find."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from softneck.drives.bus._file import DrivesFile
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._sensor_source import Axes, axes_of, inverse, said_of
from softneck.drives.running._virtual import simulated_plant
from softneck.drives.simulated import SimulatedNeck
from softneck.drives.simulated._drives import Sample, twin
from softneck.drives.simulated._springs import SimulatedSprings
from softneck.plant import NeckParameters

# How a mistake is written, for people.
KINDS = ("reversed:N", "exchanged:N:M", "gear:N:FACTOR", "lines:N:FACTOR", "current:N:FACTOR", "axes", "sign:OUTPUT",
         "late:SECONDS", "duplicate:N")  # fmt: skip
_SAID = {kind.partition(":")[0]: kind.count(":") for kind in KINDS}


@dataclass(frozen=True, slots=True)
class Planted:
    """How the simulated drives are really set up.

    Attributes:
        file: the drives file that would be right; its drives stand in the order of the tendons.
        late: the sensor is by so much [s].
        twins: node numbers that a second device has as well.
    """

    file: DrivesFile
    late: float = 0.0
    twins: tuple[int, ...] = ()


def plant(file: DrivesFile, mistakes: Sequence[str]) -> Planted:
    """Return how drives are set up where `file` is right but for `mistakes`, such as `reversed:1` or `gear:2:0.5`.

    Motors are those of `file`; what is exchanged goes with its drive.

    Raises:
        ValueError: a mistake that is none.
    """
    planted = Planted(file)
    # What is exchanged comes last: until then motors stand where the file has them.
    for mistake in sorted(mistakes, key=lambda text: text.startswith("exchanged")):
        try:
            kind, *said = mistake.split(":")
            if len(said) != _SAID[kind]:
                raise ValueError(mistake)
            planted = _with(planted, kind, *said)
        except (ValueError, KeyError) as error:
            raise ValueError(f"a mistake is one of {', '.join(KINDS)}; got `{mistake}`.") from error
    return planted


_SCALES = {"gear": "gear", "lines": "counts_per_turn", "current": "peak_current"}


def _with(planted: Planted, kind: str, *said: str) -> Planted:
    drives, file = list(planted.file.drives), planted.file
    outputs = file.moves.outputs.names
    if kind == "exchanged":
        a, b = (_motor(text, len(drives)) for text in said)
        if a == b:
            raise ValueError(said)
        drives[a], drives[b] = drives[b], drives[a]
    elif kind in ("reversed", *_SCALES):
        (where, *factor) = said
        j = _motor(where, len(drives))
        scale = drives[j].scale
        if kind == "reversed":
            drives[j] = replace(drives[j], scale=replace(scale, reversed=not scale.reversed))
        else:
            name = _SCALES[kind]
            changed = replace(scale, **{name: getattr(scale, name) * float(factor[0])})
            drives[j] = replace(drives[j], scale=changed)
    elif kind in ("axes", "sign"):
        turn: Axes = ((1, 1.0), (0, 1.0), *((k, 1.0) for k in range(2, len(outputs)))) if kind == "axes" else tuple(
            (k, -1.0 if name == said[0] else 1.0) for k, name in enumerate(outputs)
        )  # fmt: skip
        if kind == "sign" and said[0] not in outputs:
            raise ValueError(said[0])
        before = axes_of(file.sensor_axes, outputs)
        axes = tuple((before[n][0], sign * before[n][1]) for n, sign in turn)
        return replace(planted, file=replace(file, sensor_axes=said_of(axes, outputs)))
    elif kind == "late":
        late = float(said[0])
        # Samples are kept for so long; a minute is more than any sensor needs.
        if not 0.0 <= late <= 60.0:
            raise ValueError(late)
        return replace(planted, late=late)
    else:
        return replace(planted, twins=(*planted.twins, file.nodes[_motor(said[0], len(drives))]))
    return replace(planted, file=replace(file, drives=tuple(drives)))


def _motor(text: str, count: int) -> int:
    number = int(text)
    if not 1 <= number <= count:
        raise ValueError(text)
    return number - 1


def planted_link(
    believed: DrivesFile, planted: Planted, neck: NeckParameters | None, *, sample_time: float, seed: int = 0
) -> VirtualLink:
    """Return simulated drives that are set up as `planted` says, on a bus that is read as `believed` says."""
    turns = simulated_plant(planted.file, neck, sample_time=sample_time, homed=False, seed=seed)
    outputs = believed.moves.outputs.names
    # As it is mounted, and read as it is believed to be.
    true = inverse(axes_of(planted.file.sensor_axes, outputs))
    axes = [(true[n][0], sign * true[n][1]) for n, sign in axes_of(believed.sensor_axes, outputs)]
    mounted = MountedOtherwise(turns, axes, late=planted.late)
    link = VirtualLink(mounted)  # pyright: ignore[reportArgumentType]  # it stands for what it is around
    turns.drives = (*turns.drives, *(twin(node, turns.settings) for node in planted.twins))
    return link


class MountedOtherwise:
    """A neck, or springs, whose sensor has other axes and signs, and tells what was `late` [s] before.

    All else is that of what it stands around.
    """

    def __init__(
        self, neck: SimulatedNeck | SimulatedSprings, axes: Sequence[tuple[int, float]], *, late: float = 0.0
    ) -> None:
        """Let output k of the sensor be `sign` times the true output `number`: (number, sign) is `axes[k]`."""
        count = len(neck.newest.values)
        if sorted(number for number, _ in axes) != list(range(count)):
            raise ValueError(f"`axes` must name each of the {count} outputs once.")
        self._neck, self._axes = neck, tuple(axes)
        samples = round(late / neck.settings.sample_time)
        self._past: deque[Sample] = deque([neck.newest] * (samples + 1), samples + 1)
        self.newest: Sample = self._turned(neck.newest)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._neck, name)

    def sample(self, now: float) -> Sample:
        """Take one sample, and tell the one that is due."""
        self._past.append(self._neck.sample(now))
        self.newest = self._turned(self._past[0]._replace(time=now))
        return self.newest

    def _turned(self, sample: Sample) -> Sample:
        values, rates = (
            tuple(sign * given[number] for number, sign in self._axes) for given in (sample.values, sample.rates)
        )
        return Sample(sample.time, values, rates, valid=sample.valid)
