"""`softneck identify --search`: values to try, and the table of what came of them."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from softneck.core import SettingsError, atomic_write

from .shared._console import percent, print_table, progress
from .shared._options import in_radians, value_of

if TYPE_CHECKING:
    from softneck.identification import Search
    from softneck.signals import Recording


# A longer table is read in the model or the JSON, not on a screen.
_MOST_ROWS = 40

search_option = click.option(
    "--search",
    "searches",
    multiple=True,
    metavar="KEY=V1,V2,...",
    help="Values of a setting to try; all combinations. Lists as [1],[1,2]. Needs --hold-out.",
)
hold_out_option = click.option(
    "--hold-out",
    type=click.Path(path_type=Path),
    metavar="REC",
    help="Recording of another excitation, on whose free run --search decides.",
)
strategy_option = click.option(
    "--strategy",
    type=click.Choice(("grid", "coordinate")),
    default="grid",
    show_default=True,
    help="All combinations, or one setting after the other.",
)
plot_option = click.option(
    "--plot", type=click.Path(path_type=Path), metavar="PNG", help="Draw the cost curves of --search."
)


@dataclasses.dataclass(frozen=True, slots=True)
class SearchOptions:
    """What the options of a search said."""

    searches: tuple[str, ...]
    hold_out: Path | None
    strategy: str
    plot: Path | None

    def __post_init__(self) -> None:
        if self.searches and self.hold_out is None:
            raise SettingsError("--search needs --hold-out REC: a recording of another excitation to decide on.")
        if not self.searches and (self.hold_out is not None or self.plot is not None):
            raise SettingsError("--hold-out and --plot belong to --search; name what to search, as --search na=1,2,3.")


def run_search(estimator: Any, train: Recording, options: SearchOptions, *, quiet: bool) -> Search | None:
    """Return the search that the options ask for, or None where they ask for none."""
    from softneck.identification import search
    from softneck.signals import read_recording

    if options.hold_out is None:
        return None
    vary = values_to_try(estimator, options.searches)
    hold_out = read_recording(options.hold_out)
    with progress("search", quiet=quiet) as report:
        return search(estimator, vary, train, hold_out, strategy=options.strategy, progress=report)


def values_to_try(estimator: Any, searches: Sequence[str]) -> dict[str, list[Any]]:
    """Return setting -> values of `KEY=V1,V2,...`, each checked against the estimator.

    Raises:
        SettingsError: no `=`, an unknown key, one given twice, or a value that does not fit.
    """
    fields = {field.name for field in dataclasses.fields(estimator)}
    vary: dict[str, list[Any]] = {}
    for text in searches:
        key, separator, listed = text.partition("=")
        if not separator or not listed.strip():
            raise SettingsError(f"--search takes KEY=V1,V2,...; got `{text}`.")
        pairs = [in_radians(key.strip(), value, fields) for value in _values(listed)]
        name = pairs[0][0]
        if name not in fields:
            raise SettingsError(f"there is no setting `{name}` to search; this kind has {', '.join(sorted(fields))}.")
        if name in vary:
            raise SettingsError(f"--search names `{name}` twice; give all its values at once.")
        vary[name] = [value for _, value in pairs]
        for value in vary[name]:
            try:
                dataclasses.replace(estimator, **{name: value})
            except TypeError as error:
                raise SettingsError(f"`{value}` is not a value of `{name}` ({error}).") from error
    return vary


def print_search(found: Search) -> None:
    """Print the table of trials, the best first, the chosen one marked."""
    trials = sorted(found.trials, key=lambda trial: -trial.score)
    rows = [
        [
            ", ".join(f"{name}={value}" for name, value in trial.settings.items())
            + (" <- chosen" if trial is found.chosen else ""),
            "/".join(percent(fit) for fit in trial.free_run.values()),
            "/".join(percent(fit) for fit in trial.one_step.values()),
            str(trial.size),
            f"{trial.seconds:.2f}",
            trial.reason,
        ]
        for trial in trials
        if trial in trials[:_MOST_ROWS] or trial is found.chosen
    ]
    head = ["settings", "free run", "one step", "size", "time [s]", "no fit because"]
    print_table(
        f"{len(trials)} settings on the hold-out, fit [%] {'/'.join(found.train.robot.outputs.names)}", head, rows
    )
    if len(rows) < len(trials):
        click.echo(f"the {len(trials) - len(rows)} worst are left out here; the model's findings hold all")


def write_plot(found: Search, path: Path, *, force: bool) -> None:
    """Write the cost curves as PNG."""
    from softneck.plots import search_figure

    figure = search_figure(found.curves, "Settings tried, judged by free run on the hold-out", best=found.best,
                           names=found.train.robot.outputs.names)  # fmt: skip
    with atomic_write(path, force=force) as temporary:
        figure.savefig(temporary, format="png", dpi=120)


def _values(text: str) -> list[Any]:
    """Read `1,2`, `[1],[1,2]` or `a,b` as a list, by TOML where it is that."""
    try:
        return tomllib.loads(f"values = [{text}]")["values"]
    except tomllib.TOMLDecodeError:
        return [value_of(part.strip()) for part in text.split(",")]
