"""Stability and margins of many loops at once, on their exact discrete responses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError, Vector, require_one_of
from softneck.design import LoopMargins, grid_response, margins_of_loops, two_scalars
from softneck.estimation import robot_of
from softneck.identification import AxisMeasured, response_of, to_state_space
from softneck.loop import ORDERS
from softneck.robot import Robot
from softneck.runtime import Block

from ._plants import Plants, mixing_matrix

# Margins of each axis: those that are better large, and those that are better small.
LARGE = ("disk_margin", "gain_margin", "phase_margin_deg", "delay_margin_ms")
SMALL = ("sensitivity", "complementary", "control_sensitivity")
# Lowest frequency of the neck's grid [rad/s].
_LOWEST_FREQUENCY = 0.02
# Plants whose responses are in memory at once.
_CHUNK_SIZE = 64


@dataclass(frozen=True, slots=True, eq=False)
class LinearLaw:
    """State space of a linear controller, `u = Kr(z) r + Ky(z) y`.

    `A`: (n, n). `Br`, `By`: (n, axes). `C`: (axes, n). `Dr`, `Dy`: (axes, axes). `sample_time`: [s].
    """

    A: Matrix
    Br: Matrix
    By: Matrix
    C: Matrix
    Dr: Matrix
    Dy: Matrix
    sample_time: float

    @classmethod
    def of(cls, system: Any, robot: Robot | None = None) -> LinearLaw:
        """Return the law of a system from references and outputs to the redefined inputs, such as theta_i and phi_i."""
        import control

        if not isinstance(system, control.StateSpace | control.TransferFunction):
            raise SettingsError(
                f"the controller's linear form is a {type(system).__name__}, not a python-control system."
            )
        whose = Robot.preset() if robot is None else robot
        names = whose.outputs.names
        wanted = [*(f"{name}_reference" for name in names), *names], list(whose.input_names)
        given = (list(system.input_labels), list(system.output_labels))
        if given != wanted:
            raise SettingsError(
                f"the controller goes from {', '.join(given[0])} to {', '.join(given[1])}; softneck verifies one from "
                f"{', '.join(wanted[0])} to {', '.join(wanted[1])}."
            )
        form = to_state_space(system)
        if form.dt in (0, None) or isinstance(form.dt, bool):
            raise SettingsError("the controller's linear form must be discrete, with its sample time as dt.")
        A, B, C, D = (np.asarray(item, dtype=np.float64) for item in (form.A, form.B, form.C, form.D))
        m = len(names)
        return cls(A, B[:, :m], B[:, m:], C, D[:, :m], D[:, m:], float(form.dt))

    def feedback(self, frequency: Vector) -> np.ndarray:
        """Return Ky (m, axes, axes) at `frequency` [rad/s]."""
        return grid_response(self.A, self.By, self.C, self.Dy, np.exp(1j * frequency * self.sample_time))

    @property
    def coupled(self) -> bool:
        """Whether the output of one axis changes the input of another."""
        Ky = np.abs(self.feedback(np.geomspace(0.002, math.pi, 20) / self.sample_time))
        # 1e-9: rounding of an allocation that is diagonal.
        others = Ky[:, ~np.eye(Ky.shape[1], dtype=bool)].sum(axis=1)
        return bool(others.max() > 1e-9 * Ky.max())


def frequency_grid(sample_time: float, time: float = 1.0, points: int = 360) -> Vector:
    """Return the frequencies [rad/s] of all margins, up to Nyquist; `time` is the robot's time scale."""
    return np.geomspace(_LOWEST_FREQUENCY / time, math.pi / sample_time, points)


def radii(plants: Plants, law: LinearLaw) -> Vector:
    """Return the spectral radius (n,) of every closed loop, its delay exact."""
    return np.abs(closed_poles(plants, law)).max(axis=1)


def closed_poles(plants: Plants, law: LinearLaw) -> np.ndarray:
    """Return the poles (n, N) of every closed loop, its delay exact."""
    A, B, C = _plant_matrices(plants)
    n, order, nc = len(plants), A.shape[1], len(law.A)
    closed = np.zeros((n, order + nc, order + nc))
    closed[:, :order, :order] = A + B @ law.Dy @ C
    closed[:, :order, order:] = B @ law.C
    closed[:, order:, :order] = law.By @ C
    closed[:, order:, order:] = law.A
    return np.linalg.eigvals(closed)


def _plant_matrices(plants: Plants) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A (n, N, N), B (n, N, axes), C (n, axes, N): observable form of each axis after its delay line."""
    n, m, q = len(plants), len(plants.axes), plants.numerator.shape[2] - 1
    D = int(plants.delay.max(initial=0))
    size = q + D
    A, B, C = np.zeros((n, m * size, m * size)), np.zeros((n, m * size, m)), np.zeros((n, m, m * size))
    rows, X = np.arange(n), mixing_matrix(plants.cross, m)
    for i in range(m):
        at = i * size
        own = slice(at, at + q)
        A[:, own, at] = -plants.denominator[:, i, 1:]
        A[:, at + np.arange(q - 1), at + 1 + np.arange(q - 1)] = 1.0
        source = X[:, i]
        b = plants.numerator[:, i, 1:]
        delay = plants.delay[:, i]
        # The input is the end of the delay line, or the controller's output without delay.
        late = rows[delay > 0]
        A[late[:, None], at + np.arange(q)[None, :], (at + q + delay[late] - 1)[:, None]] += b[late]
        now = rows[delay == 0]
        B[now, own, :] = b[now][:, :, None] * source[now][:, None, :]
        if D:
            B[:, at + q, :] = source
            A[:, at + q + 1 + np.arange(D - 1), at + q + np.arange(D - 1)] = 1.0
        C[:, i, at] = 1.0
    return A, B, C


def loops(plants: Plants, law: LinearLaw, w: Vector) -> tuple[np.ndarray, np.ndarray]:
    """Return the plants P and the open loops at their outputs -P Ky, both (n, m, axes, axes)."""
    G = plants.response(w)
    P = mixing_matrix(plants.cross, G.shape[1])[:, None] * np.swapaxes(G, 1, 2)[..., None]
    return P, -P @ law.feedback(w)


def inverse(M: np.ndarray) -> np.ndarray:
    """Return the inverses of small matrices (..., axes, axes), in closed form for 2 x 2."""
    if M.shape[-1] != 2:
        return np.linalg.inv(M)
    a, b, c, d = M[..., 0, 0], M[..., 0, 1], M[..., 1, 0], M[..., 1, 1]
    found = np.empty_like(M)
    found[..., 0, 0], found[..., 0, 1], found[..., 1, 0], found[..., 1, 1] = d, -b, -c, a
    return found / (a * d - b * c)[..., None, None]


def margins(plants: Plants, law: LinearLaw) -> dict[str, Vector]:
    """Return name -> (n,) margins of every plant: `pitch.disk_margin`, ..., `mimo.disk_margin`, `stability.radius`.

    A loop that is not stable has margin 0 (gain margin 1) and infinite peaks. Gain and phase margins are the smaller of
    both directions.
    """
    parts = [
        _margins(plants.take(np.arange(k, min(k + _CHUNK_SIZE, len(plants)))), law)
        for k in range(0, len(plants), _CHUNK_SIZE)
    ]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def loops_of(plants: Plants, law: LinearLaw, *, peaks: bool = True) -> tuple[LoopMargins, Vector]:
    """Return the margins of the loops of each axis, the others closed, and the spectral radius (n,) of each plant.

    With `peaks` the sizes `more` are |CS| of each axis and the structured singular value of S - I/2 of all axes.
    """
    m = len(plants.axes)
    eye, X, own = np.eye(m), mixing_matrix(plants.cross, m), np.arange(m)

    def evaluate(rows: np.ndarray, w: Vector) -> tuple[np.ndarray, np.ndarray]:
        each, back = np.unique(w, return_inverse=True)
        Ky = law.feedback(each)[back]
        P = X[rows] * plants.response_at(rows, w)[..., None]
        S = inverse(eye - P @ Ky)
        if not peaks:
            return S[:, own, own], np.zeros((w.size, 0))
        at_input = inverse(eye - Ky @ P)
        joint = np.maximum(*(_scalars(M - 0.5 * eye) for M in (S, at_input)))
        return S[:, own, own], np.column_stack([np.abs((Ky @ S)[:, own, own]), joint])

    poles = closed_poles(plants, law)
    made = margins_of_loops(evaluate, poles, plants.sample_time, int(plants.delay.max(initial=0)))
    return made, np.abs(poles).max(axis=1)


def _margins(plants: Plants, law: LinearLaw) -> dict[str, Vector]:
    made, radius = loops_of(plants, law)
    found: dict[str, Vector] = {"stability.radius": radius}
    # S - T = 2 S - 1; radius of the balanced disk is 2 / max |S - T|.
    with np.errstate(divide="ignore"):
        gain = np.minimum(made.gain, 1.0 / made.gain_down)
    for i, axis in enumerate(plants.axes):
        found |= {
            f"{axis}.sensitivity": made.sensitivity[:, i], f"{axis}.complementary": made.complementary[:, i],
            f"{axis}.control_sensitivity": made.more[:, i], f"{axis}.disk_margin": 2.0 / made.difference[:, i],
            f"{axis}.gain_margin": gain[:, i], f"{axis}.phase_margin_deg": np.degrees(made.phase[:, i]),
            f"{axis}.delay_margin_ms": 1e3 * made.delay[:, i],
        }  # fmt: skip
    return {**found, "mimo.disk_margin": 1.0 / made.more[:, -1]}


def _scalars(M: np.ndarray) -> np.ndarray:
    """Return the structured singular value (...) of M (..., m, m) for m complex scalars, exact for m = 2.

    For other m it is the spectral radius of |M|, an upper bound (Safonov 1982), so margins are exact or too small.
    """
    if M.shape[-1] == 2:
        return two_scalars(M)
    return np.abs(np.linalg.eigvals(np.abs(M))).max(axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class ControllerUnderTest:
    """A controller with its linear form.

    `block`: its runtime. `robot`: of the controller. `laws`: the linear form under the name "", or none. `order`: of
    the loop. `extra`: samples that the order adds to the plant's delay. `why`: why there is no linear form, or "".
    """

    block: Block
    robot: Robot
    laws: Mapping[str, LinearLaw]
    order: str
    extra: int
    why: str


def controller_under_test(controller: Any, *, order: str | None, observer: bool) -> ControllerUnderTest:
    """Return a controller with its linear form; `order` None is that of its design.

    A linear controller has `ss()` or `to_lti()`, from references and outputs to the redefined inputs. Raises
    SettingsError: no controller, or a linear form with other channels.
    """
    if not hasattr(controller, "block"):
        raise SettingsError(f"a controller is needed, one with `block()`; got {type(controller).__name__}.")
    block = controller.block()
    if block.role != "controller":
        raise SettingsError(f"a controller is needed; {block.kind} is of role {block.role}.")
    designed = str(getattr(controller, "order", "sequential"))
    chosen = designed if order is None else order
    require_one_of("order", chosen, ORDERS)
    design = getattr(controller, "design", {}) or {}
    if chosen == "sequential":
        extra = 0
    elif chosen == designed and "extra_delay" in design:
        extra = int(design["extra_delay"])
    else:
        extra = 1 + int(observer)
    laws, why = _laws(controller)
    return ControllerUnderTest(block, robot_of(controller), laws, chosen, extra, why)


def _laws(controller: Any) -> tuple[dict[str, LinearLaw], str]:
    for name in ("ss", "to_lti"):
        if hasattr(controller, name):
            return {"": LinearLaw.of(getattr(controller, name)(), robot_of(controller))}, ""
    return {}, f"the controller {controller.block().kind} has no linear form (`ss()`)"


_POINT_COUNT, _POINTS_ABOVE = 2000, 400


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class AxisMargins:
    """Margins of one axis that hold for every response within the weight of the recordings, in their band.

    At each frequency the loop is any point of the disk `L = L0 (1 + W D)`, `|D| <= 1`; margins are those of its worst
    point, in closed form. Above the band the response is unknown: the gain margin keeps the crossover in the band, and
    a loop that crosses above has no margin. With a stated roll-off the size is known there and the phase is not.

    Attributes:
        source: name of the family.
        axis: its name.
        band: [rad/s].
        crossover: highest crossover of any response [rad/s]; inf above the band.
        margins: name -> value; empty if the crossover is above the band.
        mu: largest `|W T|`; below 1 all responses within the weight are stable.
        at: name -> frequency of that value [rad/s].
        unheard: recordings that move the axis without a response.
    """

    source: str
    axis: str
    band: tuple[float, float]
    crossover: float
    margins: Mapping[str, float]
    mu: float
    at: Mapping[str, float]
    unheard: tuple[str, ...] = ()

    def why(self) -> str:
        """Return why there are no margins and what to record, or ""."""
        if self.unheard:
            return (
                f"not supported by the data: {self.axis} does not respond in {self.unheard[0]} of {self.source} (slack "
                "tendons, friction?); record it at an operating point where it responds, or leave it out of the family"
            )
        if math.isfinite(self.crossover):
            return ""
        low, high = self.band
        band = f"{max(low, 0.3 * high):.2g},{3.0 * high:.2g}"
        return (
            f"not supported by the data: {self.source} excites {self.axis} from {low:.2g} to {high:.2g} rad/s, and the "
            f"loop may cross above; record `multisine --band {band}` and add it to the family"
        )


def axis_margins(
    measured: AxisMeasured, law: LinearLaw, axis: int, *, source: str, name: str, extra: int, rolloff: float
) -> AxisMargins:
    """Return the margins of one axis; `rolloff` of the plant above the band in dB/decade, negative: unknown."""
    Ts = law.sample_time
    w = np.geomspace(*measured.band, _POINT_COUNT)
    G0 = response_of(measured.model, w, Ts) * np.exp(-1j * w * Ts * extra)
    L = -law.feedback(w)[:, axis, axis] * G0
    # Add half the distance to the next frequency, so that the disks cover the whole curve.
    way = 0.5 * np.abs(np.diff(L)) / np.minimum(np.abs(L[1:]), np.abs(L[:-1]))
    W = measured.weight_at(w) + np.maximum(np.append(way, 0.0), np.append(0.0, way))
    loud = (1.0 + W) * np.abs(L)
    above = np.flatnonzero(loud >= 1.0)
    crossover = float(w[above[-1]]) if above.size else float(w[0])
    above_band = _largest_gain_above(measured.band[1], (1.0 + W[-1]) * np.abs(G0[-1]), law, axis, rolloff)
    if max(loud[-1], above_band) >= 1.0:
        crossover = math.inf
    mu = W * np.abs(L / (1.0 + L))
    values = _disk_margins(L, W, w)
    # A larger gain would cross above the band, where nothing is known.
    values["gain_margin"] = np.minimum(values["gain_margin"], 1.0 / max(loud[-1], above_band, 1e-12))
    peaks = ("sensitivity", "complementary")
    places = {key: int(np.argmax(item) if key in peaks else np.argmin(item)) for key, item in values.items()}
    margins = {key: float(values[key][k]) for key, k in places.items()}
    if above_band < 1.0:
        # Of any phase: |S| is at most 1/(1 - l), |T| l/(1 - l), |S - T| (1 + l)/(1 - l).
        margins["sensitivity"] = max(margins["sensitivity"], 1.0 / (1.0 - above_band))
        margins["complementary"] = max(margins["complementary"], above_band / (1.0 - above_band))
        margins["disk_margin"] = min(margins["disk_margin"], 2.0 * (1.0 - above_band) / (1.0 + above_band))
    if mu.max() >= 1.0:
        # The disk may contain -1: there is no margin.
        margins |= dict.fromkeys(peaks, math.inf)
        margins |= {"disk_margin": 0.0, "gain_margin": 1.0, "phase_margin_deg": 0.0, "delay_margin_ms": 0.0}
    return AxisMargins(
        source=source, axis=name, band=measured.band, crossover=crossover,
        margins=margins if math.isfinite(crossover) else {}, mu=float(mu.max()),
        at={**{key: float(w[k]) for key, k in places.items()}, "mu": float(w[int(np.argmax(mu))])},
    )  # fmt: skip


def _largest_gain_above(end: float, loudest: float, law: LinearLaw, axis: int, rolloff: float) -> float:
    """Return the largest loop gain between the band's end [rad/s] and Nyquist that the stated roll-off leaves, or 0."""
    if rolloff < 0.0 or end >= math.pi / law.sample_time:
        return 0.0
    w = np.geomspace(end, math.pi / law.sample_time, _POINTS_ABOVE)
    return float((np.abs(law.feedback(w)[:, axis, axis]) * loudest * (end / w) ** (rolloff / 20.0)).max())


def _disk_margins(L: np.ndarray, W: Vector, w: Vector) -> dict[str, Vector]:
    """Return name -> (m,) of the worst point of the disk of centre L and radius W |L| at each frequency."""
    r = W * np.abs(L)
    away = np.abs(1.0 + L) - r
    with np.errstate(divide="ignore", invalid="ignore"):
        S = np.where(away > 0.0, 1.0 / away, math.inf)
        T = np.where(away > 0.0, _largest_ratio(L, r, 0.0, 1.0), math.inf)
        difference = np.where(away > 0.0, _largest_ratio(L, r, 1.0, -1.0), math.inf)
        disk = 2.0 / difference
        gain = _gain_ratio(L, W)
        # `|1 + L exp(-j a)| = r` for the least a: on the circle of radius |L| that is a chord of the disk.
        size = np.abs(L)
        chord = (1.0 + size**2 - r**2) / (2.0 * size)
        half = np.arccos(np.clip(chord, -1.0, 1.0))
        angle = (np.angle(L) + math.pi) % (2.0 * math.pi)
        meets = np.abs(chord) <= 1.0
        late = np.where(meets, np.maximum(angle - half, 0.0), math.inf)
        phase = np.where(meets, np.minimum(late, np.maximum(2.0 * math.pi - angle - half, 0.0)), math.inf)
    return {
        "sensitivity": S, "complementary": T, "disk_margin": disk, "gain_margin": gain,
        "phase_margin_deg": np.degrees(phase), "delay_margin_ms": 1e3 * late / w,
    }  # fmt: skip


def _largest_ratio(L: np.ndarray, r: Vector, a: float, b: float) -> Vector:
    """Return the largest `|(a + b l)/(1 + l)|` over a disk `|l - L| <= r` without -1: its image is a disk."""
    c, square = 1.0 + L, np.abs(1.0 + L) ** 2 - r**2
    centre, radius = np.conj(c) / square, r / square
    return np.abs(b + (a - b) * centre) + abs(a - b) * radius


def _gain_ratio(L: np.ndarray, W: Vector) -> Vector:
    """Return the smallest factor, up or down, that moves the disk onto -1: `1 + 2 k Re L + k^2 q = 0`."""
    q, along = np.abs(L) ** 2 * (1.0 - W**2), np.real(L)
    root = np.sqrt(np.maximum(along**2 - q, 0.0))
    real = along**2 >= q
    ratios = []
    for sign in (-1.0, 1.0):
        k = (-along + sign * root) / np.where(q == 0.0, 1e-300, q)
        ratios.append(np.where(real & (k > 0.0), np.maximum(k, 1.0 / np.maximum(k, 1e-300)), math.inf))
    return np.minimum(*ratios)


def data_margins(
    families: Mapping[str, Any], law: LinearLaw, axes: tuple[str, ...], extra: int, rolloff: float
) -> list[AxisMargins]:
    """Return the margins over the data of every axis of every tested family."""
    return [
        replace(
            axis_margins(measured, law, axes.index(axis), source=name, name=axis, extra=extra, rolloff=rolloff),
            unheard=tuple(family.findings.get("tested", {}).get("unheard", {}).get(axis, ())),
        )
        for name, family in families.items()
        for axis, measured in getattr(family, "measured", {}).items()
        if axis in axes
    ]
