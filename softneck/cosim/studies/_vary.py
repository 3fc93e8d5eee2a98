"""What a study varies: ranges over dotted keys of a loop, and the points that are drawn from them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from softneck.core import Matrix, SettingsError

KINDS = ("grid", "uniform", "log_uniform", "normal", "choices", "seed")
# A run's seed fits what FMUs take as `noise_seed`.
_SEED_RANGE = 2**31 - 2
# Of a tenth of a second each on two cores: half a day and more.
_MOST_RUNS = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Vary:
    """How one key varies.

    Attributes:
        kind: "grid" (each value, all combinations with the other grids), "uniform" and "log_uniform" (between two
            bounds), "normal" (mean and standard deviation), "choices" (one of some values), "seed" (the run's own).
        values: the values of a grid or of choices; the two numbers of the others.
        labels: what tables call the values of a grid or of choices.
    """

    kind: str
    values: tuple[Any, ...] = ()
    labels: tuple[Any, ...] = ()

    @property
    def is_grid(self) -> bool:
        """Whether each value is taken, not drawn."""
        return self.kind == "grid"

    @property
    def is_drawn(self) -> bool:
        """Whether a value is drawn for each sample."""
        return self.kind not in ("grid", "seed")

    def pick(self, u: float) -> tuple[Any, Any]:
        """Return the value at quantile `u` (0 to 1) and what a table shows of it."""
        from scipy.stats import norm

        if self.kind == "choices":
            i = min(int(u * len(self.values)), len(self.values) - 1)
            return self.values[i], self.labels[i]
        low, high = self.values
        if self.kind == "normal":
            value = float(norm.ppf(u, low, high))
        elif self.kind == "log_uniform":
            value = math.exp(math.log(low) + u * (math.log(high) - math.log(low)))
        else:
            value = low + u * (high - low)
        return value, value


def make_vary(key: str, given: Any) -> Vary:
    """Return how `key` varies from a table such as {"uniform": [0.0, 0.3]}; a plain list is a grid.

    Raises:
        SettingsError: no such kind, an empty or contradictory range.
    """
    if isinstance(given, Vary):
        return given
    if isinstance(given, list | tuple):
        given = {"grid": given}
    if not isinstance(given, Mapping) or len(given) != 1 or next(iter(given)) not in KINDS:
        raise SettingsError(f"[vary] `{key}` needs exactly one of {', '.join(KINDS)}; got {given!r}.")
    kind, values = next(iter(given.items()))
    if kind == "seed":
        if values is not True:
            raise SettingsError(f"[vary] `{key}`: write seed = true for the run's own seed.")
        return Vary("seed")
    if kind in ("grid", "choices"):
        return _listed(key, kind, values)
    return _range(key, kind, values)


def flattened(tables: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield dotted key and range of [vary], whether the keys were quoted or nested tables."""
    for key, value in tables.items():
        if isinstance(value, Mapping) and value and not set(value) & set(KINDS):
            yield from ((f"{key}.{rest}", inner) for rest, inner in flattened(value))
        else:
            yield key, value


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """One run of a study.

    Attributes:
        run: number, from 0.
        sample: number of the random sample; runs of one sample differ only in their grid values.
        seed: of the sample.
        values: key -> what is put into the loop.
        labels: key -> what tables show.
    """

    run: int
    sample: int
    seed: int
    values: Mapping[str, Any]
    labels: Mapping[str, Any]


class StudyPoints:
    """The points of a study: every sample at every point of the grid, in that order; drawn ahead, by the seed alone."""

    def __init__(self, vary: Mapping[str, Vary], runs: int | None, seed: int) -> None:
        """Draw the samples.

        Raises:
            SettingsError: no runs, nothing that varies, or a number of runs that does not fit the grid.
        """
        if not vary:
            raise SettingsError("the study varies nothing: give [vary] at least one key.")
        self._vary = vary
        grids = [[(key, i) for i in range(len(item.values))] for key, item in vary.items() if item.is_grid]
        size = math.prod(map(len, grids))
        if size > _MOST_RUNS:
            raise SettingsError(f"the grid has {size} points; at most {_MOST_RUNS} fit. Make it smaller, or draw.")
        self._grid = list(product(*grids))
        drawn = [key for key, item in vary.items() if item.is_drawn]
        random = bool(drawn) or any(item.kind == "seed" for item in vary.values())
        self.runs = _number_of_runs(runs, len(self._grid), random=random)
        samples = -(-self.runs // len(self._grid))
        self._drawn = dict(zip(drawn, _quantiles(samples, len(drawn), seed).T, strict=True))
        states = np.random.SeedSequence(seed).generate_state(samples, np.uint64)
        self._seeds = (states % _SEED_RANGE).astype(np.int64)

    def __len__(self) -> int:
        """Return the number of runs."""
        return self.runs

    def __getitem__(self, run: int) -> Point:
        """Return one point."""
        sample, place = divmod(run, len(self._grid))
        seed = int(self._seeds[sample])
        chosen = dict(self._grid[place])
        values, labels = {}, {}
        for key, item in self._vary.items():
            if item.is_grid:
                values[key], labels[key] = item.values[chosen[key]], item.labels[chosen[key]]
            elif item.kind == "seed":
                values[key] = labels[key] = seed
            else:
                values[key], labels[key] = item.pick(float(self._drawn[key][sample]))
        return Point(run, sample, seed, values, labels)


def _number_of_runs(runs: int | None, grid: int, *, random: bool) -> int:
    if runs is None:
        if random:
            raise SettingsError("`runs` is missing: say how many; only a study of grids alone knows it by itself.")
        return grid
    if isinstance(runs, bool) or not isinstance(runs, int) or not 1 <= runs <= _MOST_RUNS:
        raise SettingsError(f"`runs` must be a whole number between 1 and {_MOST_RUNS}; got {runs!r}.")
    if not random and runs != grid:
        raise SettingsError(f"the grid has {grid} points and nothing is random, but `runs` is {runs}; leave it out.")
    if runs < grid:
        raise SettingsError(
            f"the grid has {grid} points; `runs` is {runs}: make it at least that, or the grid smaller."
        )
    return runs


def _quantiles(samples: int, keys: int, seed: int) -> Matrix:
    """Return a Latin hypercube (samples, keys) of 0 to 1, none of them exactly 0 or 1."""
    from scipy.stats import qmc

    if keys == 0:
        return np.zeros((samples, 0))
    drawn = qmc.LatinHypercube(keys, rng=np.random.default_rng(seed)).random(samples)
    return np.clip(drawn, 1e-12, 1.0 - 1e-12)


def _listed(key: str, kind: str, values: Any) -> Vary:
    if isinstance(values, Mapping):
        labels, chosen = tuple(map(str, values)), tuple(values.values())
    elif isinstance(values, list | tuple):
        chosen = tuple(values)
        labels = _labels(chosen)
    else:
        raise SettingsError(f"[vary] `{key}`: {kind} takes a list of values; got {values!r}.")
    if not chosen:
        raise SettingsError(f"[vary] `{key}`: the {kind} is empty; give it values.")
    if len(set(map(repr, labels))) < len(labels):
        raise SettingsError(f"[vary] `{key}`: the {kind} has a value twice: {', '.join(map(str, labels))}.")
    return Vary(kind, chosen, labels)


def _labels(values: Sequence[Any]) -> tuple[Any, ...]:
    """Return what tables show: the value itself, the file of a table, the kind of an object."""
    plain = [value if isinstance(value, bool | int | float | str) else _name(value) for value in values]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in plain):
        return tuple(plain)
    names = [str(value) for value in plain]
    return tuple(f"{name} {i + 1}" if names.count(name) > 1 else name for i, name in enumerate(names))


def _name(value: Any) -> str:
    if isinstance(value, Mapping):
        texts = [str(item) for item in value.values() if isinstance(item, str)]
        return texts[0] if texts else ", ".join(f"{key} = {item}" for key, item in value.items())
    return str(getattr(value, "kind", "") or type(value).__name__)


def _range(key: str, kind: str, values: Any) -> Vary:
    numbers = isinstance(values, list | tuple) and len(values) == 2 and all(
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) for value in values
    )  # fmt: skip
    if not numbers:
        raise SettingsError(f"[vary] `{key}`: {kind} takes two numbers; got {values!r}.")
    low, high = float(values[0]), float(values[1])
    if kind == "normal":
        if not high > 0.0:
            raise SettingsError(f"[vary] `{key}`: the standard deviation must be positive; got {high:g}.")
    elif not low < high:
        raise SettingsError(
            f"[vary] `{key}`: the {kind} range from {low:g} to {high:g} is empty; the lower bound first."
        )
    elif kind == "log_uniform" and low <= 0.0:
        raise SettingsError(f"[vary] `{key}`: log_uniform needs positive bounds; got {low:g}.")
    return Vary(kind, (low, high))
