"""softneck import: a foreign log becomes a recording."""

from __future__ import annotations

from pathlib import Path

import click

from softneck.signals import import_log, read_layout, write_recording

from ._console import note, print_json
from ._options import force_option, json_option, output_option, target


@click.command(
    "import",
    epilog="Example: softneck import log.csv --layout examples/layouts/neck_openloop.toml -o neck.csv",
)
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--layout", "layout_file", type=click.Path(path_type=Path), required=True, help="How to read the log.")
@output_option("recording", "REC")
@force_option
@json_option
def command(log: Path, layout_file: Path, output: Path | None, force: bool, as_json: bool) -> None:
    """Turn any logger's table LOG into a recording, by a layout file."""
    imported = import_log(log, read_layout(layout_file))
    recording = imported.recording
    path, replace = target(output, f"recordings/{log.stem}.csv", force=force)
    write_recording(path, recording, force=replace)
    missed = int((recording.outputs != recording.outputs).any(axis=1).sum())
    facts = {
        "recording": str(path),
        "rows": len(recording),
        "runs": len(recording.runs()),
        "sample_time_s": recording.sample_time,
        "missed_samples": missed,
        "notes": list(imported.notes),
    }
    if as_json:
        print_json(facts)
        return
    for remark in imported.notes:
        note(remark)
    click.echo(
        f"{path}: {len(recording)} rows in {facts['runs']} run(s) at {1e3 * recording.sample_time:g} ms, "
        f"{missed} with a missed sample"
    )
