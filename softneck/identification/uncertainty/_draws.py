"""Draws of a robot: nonlinear models that explain its recordings, and the disturbance that they leave over."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from typing import Any, Protocol

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    Progress,
    ReprMixin,
    SettingsError,
    Vector,
    one_blas_thread,
    require_whole,
    side_by_side,
    silent,
)
from softneck.signals import Recording, concatenate, conditions, merge_conditions

from ..linear._oe_draws import OutputErrorDraws
from ..models._arrays import check_arrays
from ..models._fitting import ScaledData, sensor_noise
from ..models._model import WARM_UP, Model, embed_model, embedded_model
from ..models._scores import no_worse
from ..structured._greybox_draws import GreyBoxDraws
from ..structured._play_draws import PlayDraws

#: Draws of one certificate: none of 59 failing means that 95 % of such plants hold, with 95 % confidence.
DRAWS = 59
#: Draws that a search may see, as many as those of a certificate, and certificates that a family has draws for.
SEARCH_DRAWS, ATTEMPTS = 59, 5
#: Share of held-out samples that the band must cover.
LEVEL = 0.95
# Last part of each run, held out from the fit; rows of each run that are used at most [s of a neck's time]: all of
# `mixed`, whose parts are different motions.
_HELD_OUT, _MOST_S = 0.25, 150.0
# Warm-up: rows before those held out, from which they are simulated [s of a neck's time].
_WARM_UP_S = 20.0
# Segments of held-out motions: usual, shortest (10, 2.5 time constants) [s of a neck's time], least rows of one.
_SEGMENT_S, _LEAST_SEGMENT_S, _LEAST_ROWS = 2.0, 0.5, 20
# Factors on the deviations of the fit, of which the sharpest that explain the held-out motions are taken.
_FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
_CALIBRATION_DRAWS = 40
# Factors on the disturbance, until the band covers the held-out samples.
_MORE = tuple(1.1**k for k in range(25))
# Deviations of disturbance and noise in the band: 95 % of a normal distribution.
_DEVIATIONS = 1.96
# Times in which a disturbance is forgotten, of which the likeliest is taken [s of a neck's time].
_MEMORIES_S = np.geomspace(0.01, 10.0, 31)
# Share of what is left over that is disturbance at least, where the sensor's noise explains all of it.
_LEAST_DISTURBANCE = 0.05
# Width of the band, as a share of large motions, beyond which hardly a loop can hold for all draws.
_WIDE = 0.25
# Classes of amplitude, by the share of the largest motion of the segments.
_CLASSES = (("small", 0.0, 0.25), ("middle", 0.25, 0.6), ("large", 0.6, math.inf))


class Source(Protocol):
    """What draws come from: `GreyBoxDraws`, `PlayDraws` or `OutputErrorDraws`."""

    @property
    def model(self) -> Model: ...
    def draw(self, rng: np.random.Generator) -> Vector: ...
    def arrays(self, draw: Vector, factor: float) -> dict[str, Matrix]: ...
    def smoother(self) -> Sequence[Source]: ...


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Draws(ReprMixin):
    """Nonlinear models of a robot, drawn independently of each other.

    Attributes:
        model: fitted; each draw replaces some of its arrays.
        arrays: name -> (n, ...) of all draws: `SEARCH_DRAWS` for a search, then `count` for each certificate.
        count: of one certificate.
        seed: of the draws.
        factor: on the deviations of the fit.
        share: (outputs,) of the disturbance that a motion makes: `d[k+1] = keep d[k] + share dy[k] n[k]`, n normal.
        keep: of the disturbance, its colour.
        noise: (outputs,) standard deviation of the sensor's noise in the held-out motions [SI].
        level: share of held-out samples that were to be covered.
        coverage: of each class of amplitude: "class", "motion", "covered", "width" and "segments", outputs in SI.
        conditions: payload and co-contraction of the recordings, and "motion", the largest of the outputs [SI].
    """

    model: Model
    arrays: Mapping[str, np.ndarray]
    count: int
    seed: int
    factor: float
    share: Vector
    keep: float
    noise: Vector
    level: float
    coverage: list[dict[str, Any]]
    conditions: Mapping[str, list[float]]

    @property
    def attempts(self) -> int:
        """Certificates that there are draws for."""
        return (len(next(iter(self.arrays.values()))) - SEARCH_DRAWS) // self.count

    def for_search(self, count: int = SEARCH_DRAWS) -> list[Model]:
        """Return the first draws of those that a search may see."""
        return [self._draw(k) for k in range(min(count, SEARCH_DRAWS))]

    def for_certificate(self, attempt: int = 1) -> list[Model]:
        """Return the draws of a certificate, which no search and no other attempt has seen.

        Raises:
            SettingsError: more attempts than there are draws for.
        """
        require_whole("attempt", attempt, 1, 10_000)
        if attempt > self.attempts:
            raise SettingsError(
                f"the family has draws for {self.attempts} certificates and this is attempt {attempt}; make it again "
                "with another seed (`softneck family --seed`), better from more recordings."
            )
        first = SEARCH_DRAWS + (attempt - 1) * self.count
        return [self._draw(k) for k in range(first, first + self.count)]

    def _draw(self, number: int) -> Model:
        own = {name: values[number] for name, values in self.arrays.items()}
        return replace(self.model, arrays={**self.model.arrays, **own})

    @property
    def doubt(self) -> str:
        """What of the draws is too little to decide by; empty where they cover the held-out motions and are close."""
        low = next((row for row in self.coverage if row["covered"] < self.level), None)
        if low is not None:
            covered, wanted = 100.0 * low["covered"], 100.0 * self.level
            return f"they cover {covered:.3g} % of {low['class']} motions, not {wanted:.3g} %"
        if not self.coverage:
            return "no held-out motion tells what they cover"
        large = self.coverage[-1]
        wide = large["width"] / max(large["motion"], 1e-300)
        return f"they differ by +-{100.0 * wide:.0f} % of {large['class']} motions" if wide > _WIDE else ""

    @staticmethod
    def band_of(row: Mapping[str, Any]) -> str:
        """Return how wide the band of a row of `coverage` is, in % of its motion."""
        share = 100.0 * row["width"] / max(row["motion"], 1e-300)
        return f"{share:.0f} %" if share >= 1.0 else f"{share:.1g} %"

    def summary(self, shown: float, unit: str) -> list[str]:
        """Return lines on the draws; `shown` converts outputs from SI to `unit`."""
        lines = [
            f"draws: {self.count} of kind {self.model.kind} for each of {self.attempts} certificates, "
            f"seed {self.seed}; deviations of the fit times {self.factor:g}, and a disturbance of "
            f"{100.0 * float(self.share.max()):.2g} % of each sample's motion"
        ]
        for row in self.coverage:
            lines.append(
                f"  {row['class']} motions (held out, to {shown * row['motion']:.3g} {unit}): "
                f"{100.0 * row['covered']:.0f} % within +-{shown * row['width']:.2g} {unit}, "
                f"{self.band_of(row)} of the motion"
            )
        return [*lines, f"caution: draws decide little, as {self.doubt}; record more"] if self.doubt else lines

    def to_archive(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Return header and arrays."""
        header, arrays = embed_model(self.model)
        own = {f"drawn_{name}": values for name, values in self.arrays.items()}
        facts = {
            "model": header, "names": list(self.arrays), "count": self.count, "seed": self.seed, "factor": self.factor,
            "keep": self.keep, "level": self.level, "coverage": self.coverage, "conditions": dict(self.conditions),
        }  # fmt: skip
        return facts, {**arrays, **own, "share": self.share, "noise": self.noise}

    @classmethod
    def from_archive(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Draws:
        """Return the draws that `to_archive` described; raise FileFormatError for arrays that do not fit."""
        model = embedded_model(header["model"], dict(arrays))
        drawn = {str(name): arrays[f"drawn_{name}"] for name in header["names"]}
        count, size = int(header["count"]), {len(values) for values in drawn.values()}
        if len(size) != 1 or count < 1 or min(size) < SEARCH_DRAWS + count:
            raise FileFormatError("its draws are fewer than one certificate needs, or not as many of each array.")
        for name, values in drawn.items():
            whole = name in model.arrays and values.shape[1:] == model.arrays[name].shape
            if not whole or values.dtype != np.float64 or not np.isfinite(values).all():
                raise FileFormatError(f"the draws of its array `{name}` do not fit its model.")
        share, noise, one_each = arrays["share"], arrays["noise"], (len(model.robot.outputs.names),)
        if not all(own.shape == one_each and (np.isfinite(own) & (own >= 0.0)).all() for own in (share, noise)):
            raise FileFormatError("its draws must have one share of the disturbance and one noise for each output.")
        if not 0.0 <= float(header["keep"]) < 1.0:
            raise FileFormatError("the disturbance of its draws must have a colour below 1.")
        found = cls(
            model=model, arrays=drawn, count=count, seed=int(header["seed"]), factor=float(header["factor"]),
            share=share, keep=float(header["keep"]), noise=noise, level=float(header["level"]),
            coverage=list(header["coverage"]), conditions=dict(header["conditions"]),
        )  # fmt: skip
        for number in range(*size):
            check_arrays(model.kind, found._draw(number).arrays)
        return found


@one_blas_thread
def make_draws(
    recordings: Recording | Sequence[Recording], *, count: int = DRAWS, seed: int = 0, progress: Progress = silent
) -> Draws:
    """Return draws of a robot from its recordings.

    Models are fitted to the first three quarters of each run: for robots that tendons bend the grey box without and
    with its optional parts, else kind `play` or, of a robot of second order, `oe`. What the nearest draw leaves over
    of the last quarters, less the sensor's noise, is a disturbance. The model is the one that, with disturbance and
    noise, predicts them best, by the continuous ranked probability score (Gneiting and Raftery 2007, J. Am. Stat.
    Assoc. 102:359); of `play` the ridge is the largest and of each the factor on the deviations of its numbers the
    smallest within one standard error of the best (Breiman et al. 1984, sec. 3.4): plays that hardly a motion tells
    apart would swing. Then the disturbance is raised until the band covers `LEVEL` of the samples at every amplitude.
    Simulations begin 20 s of a neck's time before the last quarters.

    Args:
        recordings: of one robot and sample time, the payload as a channel.
        count: draws of one certificate.
        seed: of the draws.
        progress: called with the part done and a word.

    Raises:
        DataError: too little data to fit, or to hold a part of it out.
    """
    require_whole("count", count, 2, 10_000)
    require_whole("seed", seed, 0, 2**31 - 2)
    recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
    whole = concatenate(recordings)
    second = ScaledData.of(whole).scaling.second
    train, held, warm_ups = _split(whole, second)
    sources = _sources(train, lambda done, text: progress(0.4 * done, f"draws: {text}"))
    motions = _Motions.of(held, sources[0].model, second, warm_ups)
    memory = second / held.sample_time

    @cache
    def judged(source: Source, factor: float) -> tuple[Vector, np.ndarray]:
        rng = np.random.default_rng([seed, 0])
        trial = [source.draw(rng) for _ in range(_CALIBRATION_DRAWS)]
        Y = replace(motions, model=source.model).simulate(_arrays(source, factor, trial))
        loops = motions.disturbed(Y, *motions.disturbance(Y, memory), np.random.default_rng([seed, 2]))
        return motions.scores(loops), Y

    tried = list[tuple[Vector, Source]]()
    for number, (source, factor) in enumerate(product(sources, _FACTORS)):
        progress(0.4 + 0.35 * number / (len(sources) * len(_FACTORS)), f"draws: deviations times {factor:g}")
        tried.append((judged(source, factor)[0], source))
    best, winner = min(tried, key=lambda item: float(item[0].mean()))
    if not math.isfinite(float(best.mean())):
        raise DataError("no draw has a finite simulation on the held-out motions; record longer.")
    options = product(winner.smoother(), _FACTORS)
    source, factor = next(option for option in options if no_worse(judged(*option)[0], best))
    Y = judged(source, factor)[1]
    share, keep = motions.disturbance(Y, memory)
    more = next((more for more in _MORE if motions.covers(Y, more * share, keep)), _MORE[-1])
    rows, rng, sizes = list[dict[str, Matrix]](), np.random.default_rng([seed, 1]), [SEARCH_DRAWS, *[count] * ATTEMPTS]
    for number, size in enumerate(sizes):
        progress(0.75 + 0.25 * number / len(sizes), "draws")
        rows += _arrays(source, factor, [source.draw(rng) for _ in range(size)])
    made = merge_conditions([conditions(part) for part in recordings])
    return Draws(
        model=source.model, arrays={name: np.array([row[name] for row in rows]) for name in rows[0]}, count=count,
        seed=seed, factor=factor, share=more * share, keep=keep, noise=motions.noise, level=LEVEL,
        coverage=motions.coverage(Y, more * share, keep),
        conditions={**made, "motion": _motion(whole)},
    )  # fmt: skip


def _arrays(source: Source, factor: float, draws: Sequence[Vector]) -> list[dict[str, Matrix]]:
    return side_by_side([partial(source.arrays, draw, factor) for draw in draws])


def _motion(recording: Recording) -> list[float]:
    """Return the largest motion of each output from its middle [SI]."""
    middle = np.nanmedian(recording.outputs, axis=0)
    return np.nanmax(np.abs(recording.outputs - middle), axis=0).tolist()


def _sources(train: Recording, progress: Progress) -> list[Source]:
    """Return what draws may come from: grey boxes without and with optional parts; of other robots `play`.

    Where two poles are better than one, they come from `oe`: no draw of `play` would overshoot as such a robot does.
    """
    try:
        return [GreyBoxDraws.fit(train, body=body, progress=progress) for body in ("rigid", "all")]
    except SettingsError:  # a robot that no tendons on winches bend
        with suppress(DataError):  # one pole does for it
            return [OutputErrorDraws.fit(train, progress=progress)]
        return [PlayDraws.fit(train, progress=progress)]


def _split(recording: Recording, second: float) -> tuple[Recording, Recording, list[int]]:
    """Return the rows to fit and to hold out of each run, and how many of those held out are a warm-up.

    These are simulated and not judged: before them nothing is known of a robot's hysteresis.
    """
    most, warm_up = (round(length * second / recording.sample_time) for length in (_MOST_S, _WARM_UP_S))
    train, held, warm_ups = [], [], []
    for run in recording.runs():
        rows = min(len(run), max(most, 8 * WARM_UP))
        edge = round((1.0 - _HELD_OUT) * rows)
        if edge > 2 * WARM_UP and rows - edge > WARM_UP + _LEAST_ROWS:
            train.append(run.rows(0, edge))
            warm_ups.append(min(edge, max(warm_up, WARM_UP)))
            held.append(run.rows(edge - warm_ups[-1], rows))
    if not train:
        raise DataError(
            f"no run has {8 * WARM_UP} rows, of which the last quarter could be held out from the draws; record longer."
        )
    return concatenate(train), concatenate(held), warm_ups


@dataclass(frozen=True, slots=True, eq=False)
class _Motions:
    """Held-out motions in segments.

    recording, model: to simulate; outputs: (rows, outputs) measured; groups: (rows,) segment, -1 in the warm-up;
    motion: (segments,) largest motion of an output [SI]; classes: (segments,) of amplitude; noise: (outputs,) standard
    deviation of the sensor [SI], which loops add to every draw: it is no disturbance.
    """

    recording: Recording
    model: Model
    outputs: Matrix
    groups: np.ndarray
    motion: Vector
    classes: np.ndarray
    noise: Vector

    @classmethod
    def of(cls, held: Recording, model: Model, second: float, warm_ups: Sequence[int]) -> _Motions:
        usual, least = (round(length * second / held.sample_time) for length in (_SEGMENT_S, _LEAST_SEGMENT_S))
        runs, groups, first = held.runs(), [], 0
        # One run that is shorter than a segment has two halves.
        rows = len(held) - sum(warm_ups)
        length = max(_LEAST_ROWS, usual if rows > usual else max(least, (rows + 1) // 2))
        for run, warm_up in zip(runs, warm_ups, strict=True):
            number = first + (np.arange(len(run)) - warm_up) // length
            number[:warm_up] = -1
            first = int(number.max(initial=first)) + 1
            groups.append(number)
        group, y = np.concatenate(groups), held.outputs
        group[~np.isfinite(y).all(axis=1)] = -1
        _, group[group >= 0] = np.unique(group[group >= 0], return_inverse=True)
        if group.max() < 1:
            raise DataError("the held-out rows have no two segments with outputs; record longer.")
        motion = np.array([0.5 * np.ptp(y[group == k], axis=0).max() for k in range(group.max() + 1)])
        part = motion / motion.max()
        classes = np.searchsorted([low for _, low, _ in _CLASSES], part, side="right") - 1
        return cls(held, model, y, group, motion, classes, np.array(sensor_noise(held)))

    def simulate(self, draws: Sequence[Mapping[str, Matrix]]) -> np.ndarray:
        """Return the simulations (draws, rows, outputs)."""
        outputs = self.outputs.shape[1]

        def simulate(own: Mapping[str, Matrix]) -> Matrix:
            model = replace(self.model, arrays={**self.model.arrays, **own})
            with np.errstate(all="ignore"):
                return np.asarray(model.simulate(self.recording))[:, :outputs]

        return np.array(side_by_side([partial(simulate, own) for own in draws]))

    def scores(self, Y: np.ndarray) -> Vector:
        """Return the continuous ranked probability score of the draws in each segment, relative to its motion.

        It is unbiased for any number of draws (Ferro 2014, Q. J. R. Meteorol. Soc. 140:1917).
        """
        weight = 1.0 / np.maximum(self.motion, 0.05 * self.motion.max())[self.groups][:, None]
        n = len(Y)
        ranks = 2.0 * np.arange(n) + 1.0 - n  # of sorted draws: their sum is that of all distances between two
        with np.errstate(all="ignore"):
            apart = np.tensordot(ranks, np.sort(Y, axis=0), 1) / (n * (n - 1))
            each = (np.abs(Y - self.outputs).mean(axis=0) - apart) * weight
        found = np.array([each[self.groups == k].mean() for k in range(len(self.motion))])
        return np.where(np.isfinite(found), found, math.inf)

    def disturbance(self, Y: np.ndarray, second: float) -> tuple[Vector, float]:
        """Return share (outputs,) and colour of what the nearest draw of each segment leaves over.

        The share explains its variance. The colour is the likeliest: of pairs of neighbours (Varin, Reid and Firth
        2011, Stat. Sinica 21:5), normal with the variances and the covariance that disturbance and noise have there.
        `second`: samples in one of a neck.
        """
        near, there = self._nearest(Y), self.groups >= 0
        pairs = there[1:] & (self.groups[1:] == self.groups[:-1])
        e = self.outputs - np.take_along_axis(Y, near[None, :, None], axis=0)[0]
        left = (e[there] ** 2).mean(axis=0)
        left = np.maximum(left - self.noise**2, _LEAST_DISTURBANCE * left)
        moves, tried = np.diff(Y, axis=1, prepend=Y[:, :1]), []
        for memory in _MEMORIES_S:
            keep = math.exp(-1.0 / (memory * second))
            variance = np.empty_like(e)
            for number in np.unique(near[there]):
                variance[near == number] = _filtered(moves[number], keep)[near == number]
            square = left / np.maximum(variance[there].mean(axis=0), 1e-300)
            cost = _pair_cost(e[:-1][pairs], e[1:][pairs], square * variance[:-1][pairs], square * variance[1:][pairs],
                              keep, np.maximum(self.noise**2, 1e-9 * left + 1e-100))  # fmt: skip
            tried.append((cost, np.sqrt(square), keep))
        _, share, keep = min(tried, key=lambda item: item[0])
        return share, keep

    def disturbed(self, Y: np.ndarray, share: Vector, keep: float, rng: np.random.Generator) -> np.ndarray:
        """Return simulations (draws, rows, outputs) with their disturbance and the sensor's noise, as in loops."""
        from scipy.signal import lfilter

        moves = share * np.diff(Y, axis=1, prepend=Y[:, :1]) * rng.standard_normal(Y.shape)
        with np.errstate(all="ignore"):
            away = np.asarray(lfilter([1.0], [1.0, -keep], moves, axis=1))
        return Y + away + self.noise * rng.standard_normal(Y.shape)

    def _nearest(self, Y: np.ndarray) -> np.ndarray:
        """Return the number (rows,) of the draw with the least squared error in the segment of each row."""
        found = np.zeros(len(self.groups), dtype=int)
        for k in range(len(self.motion)):
            at = self.groups == k
            found[at] = np.argmin(np.nan_to_num(((self.outputs[at] - Y[:, at]) ** 2).sum(axis=(1, 2)), nan=np.inf))
        return found

    def band(self, Y: np.ndarray, share: Vector, keep: float) -> tuple[Matrix, Matrix]:
        """Return the lowest and highest outputs (rows, outputs) of the draws with their disturbance."""
        middle = np.median(Y, axis=0)
        variance = share**2 * _filtered(np.diff(middle, axis=0, prepend=middle[:1]), keep)
        away = _DEVIATIONS * np.sqrt(variance + self.noise**2)
        return Y.min(axis=0) - away, Y.max(axis=0) + away

    def coverage(self, Y: np.ndarray, share: Vector, keep: float) -> list[dict[str, Any]]:
        """Return the covered share of samples and the width of the band for each class of amplitude."""
        low, high = self.band(Y, share, keep)
        inside, rows = (self.outputs >= low) & (self.outputs <= high), []
        for number, (name, _, _) in enumerate(_CLASSES):
            chosen = np.flatnonzero(self.classes == number)
            at = np.isin(self.groups, chosen)
            if self.motion[chosen].max(initial=0.0) > 0.0:  # steps of few levels rest in all of the smallest
                rows.append({
                    "class": name, "motion": float(self.motion[chosen].max()), "covered": float(inside[at].mean()),
                    "width": float(0.5 * (high - low)[at].mean()), "segments": int(chosen.size),
                })  # fmt: skip
        return rows

    def covers(self, Y: np.ndarray, share: Vector, keep: float) -> bool:
        """Return whether the band covers the level at every amplitude."""
        return all(row["covered"] >= LEVEL for row in self.coverage(Y, share, keep))


def _pair_cost(e: Matrix, then: Matrix, before: Matrix, after: Matrix, keep: float, noise: Vector) -> float:
    """Return minus twice the log-likelihood of neighbours e, `then` with variances `before`, `after` and a noise."""
    a, b, c = before + noise, after + noise, keep * before
    determinant = a * b - c**2
    return float((np.log(determinant) + (b * e**2 - 2.0 * c * e * then + a * then**2) / determinant).sum())


def _filtered(moves: Matrix, keep: float) -> Matrix:
    """Return the variance (rows, outputs) of a disturbance of share 1 that `moves` (rows, outputs) make."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], [1.0, -(keep**2)], moves**2, axis=0))
