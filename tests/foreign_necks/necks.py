"""The foreign necks: plants that share no equation with ours, to judge on what was never fitted to them.

Each has the inputs and outputs of `VirtualNeck`, so that whatever takes a neck's block takes theirs. `seed` draws
tolerances: each seed is another specimen, 0 the nominal one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module

import numpy as np

from softneck.core import Matrix, Vector
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, Port
from softneck.signals import SET_POINTS, Excitation, Recording

from .held_out import HELD_OUT

NECKS = ("chain", "column", "spring", "foam", *HELD_OUT)
# Those on which something may be chosen.
CHOOSING = tuple(name for name in NECKS if name not in HELD_OUT)

# 0.5 ms: the fastest mode of each neck is then below a tenth of what the method stands.
SUBSTEP = 5e-4
_NOISE = ("noise_std", "rate_noise_std", "noise_quantum")
_OWN_CHANNELS = {"pitch": "pitch_measured", "roll": "roll_measured"} | {
    name: f"{name}_measured" for name in ("pitch_rate", "roll_rate")
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ForeignNeck:
    """One specimen of a foreign neck.

    Attributes:
        name: one of `NECKS`.
        seed: of its tolerances; 0 has none.
        noise: False gives a perfect sensor that keeps its lag and delay.
        changes: numbers of the plant to put in the place of its own, by name.
    """

    name: str
    seed: int = 0
    noise: bool = True
    changes: tuple[tuple[str, tuple[float, ...]], ...] = ()

    @property
    def runtime(self) -> str:
        """Dotted name of its runtime module."""
        return f"tests.foreign_necks._{self.name}_runtime"

    def numbers(self) -> dict[str, Vector]:
        """Return the plant's numbers by name."""
        table = getattr(import_module(self.runtime), self.name.upper())
        rng = np.random.default_rng(self.seed)
        found = {}
        for name, (value, spread) in table.items():
            values = np.atleast_1d(np.asarray(value, dtype=float))
            # Cut at two standard deviations: a neck that nobody would have sold is none.
            drawn = np.clip(rng.standard_normal(values.size), -2.0, 2.0)
            found[name] = values * np.exp(spread * drawn) if self.seed else values
        if not self.noise:
            found |= {name: np.zeros(1) for name in _NOISE}
        return found | {name: np.array(values) for name, values in self.changes}

    def block(self, *, noise_seed: int = 0, sample_time: float = 0.02) -> Block:
        """Return the neck as a plant with the virtual neck's ports."""
        like = VirtualNeck(NeckParameters.paper()).block()
        setup = np.array([sample_time, round(sample_time / SUBSTEP)])
        ports = [
            Port(name="noise_seed", description="seed of the sensor's noise", start=float(noise_seed), integer=True)
        ]
        for name, values in self.numbers().items():
            names = [name] if values.size == 1 else [f"{name}_{i}" for i in range(1, values.size + 1)]
            ports += [Port(name=part, start=float(value)) for part, value in zip(names, values, strict=True)]
        return Block(
            kind=self.name, role="plant", runtime=self.runtime, sample_time=sample_time, arrays=(setup,),  # pyright: ignore[reportArgumentType]
            inputs=like.inputs, outputs=like.outputs, parameters=tuple(ports),
        )  # fmt: skip


def record(
    excitation: Excitation, neck: ForeignNeck, *, seed: int = 0, payload: float = 0.0, warm: float = 0.0
) -> Recording:
    """Run a signal on a foreign neck as `softneck.plant.record` does on the virtual one: settle, ramp in, record.

    Args:
        excitation: set-points (time, 3) [rad] at its sample time.
        neck: the specimen.
        seed: of the sensor's noise.
        payload: mass on the platform [kg].
        warm: how long it has been moved before [s], by slow circles; 0 begins cold.
    """
    P: Matrix = np.asarray(excitation.set_points, dtype=np.float64)
    found = record_under(P, neck, np.full(len(P), payload), seed=seed, warm=warm, sample_time=excitation.sample_time)
    return replace(found, time=excitation.time)


def record_under(
    P: Matrix, neck: ForeignNeck, payload: Vector, *, seed: int = 0, warm: float = 0.0, sample_time: float = 0.02
) -> Recording:
    """Run set-points `P` (time, 3) under a payload (time,) that changes on the way; otherwise as `record`."""
    block = neck.block(noise_seed=seed, sample_time=sample_time)
    before = np.vstack([_circles(warm, block.sample_time), _rise(block.sample_time) * P[0]])
    U = np.zeros((len(before) + len(P) - 1, len(block.inputs)))
    U[:, :3], U[:, 3] = np.vstack([before, P[:-1]]), np.concatenate([np.full(len(before), payload[0]), payload[:-1]])
    # Row k is what is measured at t_k, before its set-points act.
    Y = block.run(block.initial_state(), U)[1][len(before) - 1 :]
    rows = dict(zip([port.name for port in block.outputs], Y.T, strict=True))
    kept = [f"{what}_{j}" for what in ("motor_position", "tension") for j in (1, 2, 3)] + ["compression"]
    channels = {name: rows[output].copy() for name, output in _OWN_CHANNELS.items()}
    channels |= {name: rows[name].copy() for name in kept}
    if payload.any():
        channels["payload"] = payload.astype(float)
    return Recording(
        sample_time * np.arange(len(P)), sample_time, {**dict(zip(SET_POINTS, P.T, strict=True)), **channels}
    )


def _circles(length: float, sample_time: float) -> Matrix:
    """Return set-points that lead the neck around every 8 s and back to rest (rows, 3)."""
    t = np.arange(1, round(length / sample_time) + 1)[:, None] * sample_time
    fade = np.minimum(1.0, np.minimum(t, length - t) / 4.0)
    return 2.0 * fade * np.cos(2.0 * np.pi * (t / 8.0 - np.arange(3) / 3.0))


def _rise(sample_time: float) -> Matrix:
    """Return the way from rest to the first row and 3 s there, as `softneck.plant.settle` goes it (rows, 1)."""
    t = np.arange(1, round(4.0 / sample_time) + 1)[:, None] * sample_time
    return 0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, t))
