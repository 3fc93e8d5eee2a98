"""softneck reproduce-paper: the paper's tables and figures, ours beside its own."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.core import refuse_existing

from .shared._console import Stages, note, print_json, print_table
from .shared._options import common_options


@click.command("reproduce-paper", epilog="Example: softneck reproduce-paper --html build/paper.html")
@click.option("--html", type=click.Path(path_type=Path), help="Write a page with the tables and Figures 4 to 23.")
@click.option("--seed", default=0, show_default=True, help="Seed of the network's start.")
@click.option(
    "--necks",
    default=3,
    show_default=True,
    help="Number of other necks to identify on, to tell which differences come from the plant.",
)
@common_options("force")
def command(html: Path | None, seed: int, necks: int, force: bool, as_json: bool) -> None:
    """Reproduce the paper on the virtual neck: Tables 3 and 4, section 7.4 and Figures 4 to 23.

    Records Eq. 22 and the three tests, identifies set membership, network and RLS, and prints our figures
    beside the paper's, like with like. Takes about a minute.
    """
    from softneck.plots import write_page
    from softneck.report import ReproduceSettings, paper_page, reproduce
    from softneck.report._paper_page import LINEAR_HEAD, grouped, linear_facts, linear_rows
    from softneck.report._reproduce import PAPER_HEAD, PAPER_NOTE, paper_entries

    if html is not None:
        refuse_existing(html, force=force)
    with Stages(quiet=as_json) as stages:
        found = reproduce(ReproduceSettings(seed=seed, other_necks=necks), tell=stages.begin)
        if html is not None:
            stages.begin("draw the figures")
            write_page(html, paper_page(found), force=force)
    rows = paper_entries(found)
    if as_json:
        print_json(
            {
                "entries": [row.as_dict() for row in rows],
                "linear": linear_facts(found),
                "other_necks": list(found.others),
                "seconds": found.seconds,
                "html": None if html is None else str(html),
            }
        )
        return
    for title, part in grouped(rows).items():
        print_table(title, PAPER_HEAD, [row.row() for row in part])
    print_table("Eq. 31, in deg", LINEAR_HEAD, linear_rows(found))
    click.echo(PAPER_NOTE)
    note(f"{found.seconds:.0f} s" + ("" if html is None else f"; the figures are in {html}"))
