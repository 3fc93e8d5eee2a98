"""softneck identify --from: a model that follows a neck that changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from softneck.core import SettingsError, refuse_existing, require_positive
from softneck.robot._opened import opened

from .shared._console import percent, print_json
from .shared._options import apply_settings, target


@dataclass(frozen=True, slots=True)
class _Adaptation:
    """What `--set` takes beside `--from`; `window`: the latest seconds to look at."""

    window: float = 30.0


def adapt(
    kind: str, model: Path, recordings: tuple[Path, ...], output: Path | None, *, settings: Sequence[str],
    robot: str | None, force: bool, as_json: bool,
) -> None:  # fmt: skip
    """Refit MODEL to the latest data, starting from what it is; write the model, and say what became of it."""
    from softneck.signals.recording._files import opened_recording

    path, replace = target(output, f"models/{model.stem}_adapted.npz", force=force, ending=".npz")
    refuse_existing(path, force=replace)
    old = opened(model, "model", robot)
    if kind not in (old.kind, "auto"):
        raise SettingsError(f"{model}: is of kind {old.kind}, not {kind}; what is refitted stays what it is.")
    window = float(apply_settings(_Adaptation, settings).window)
    require_positive("window", window, "s")
    new = old.adapted(opened_recording(recordings, robot), window=window)
    new.save(path, force=replace)
    said = new.findings["adaptation"]
    if as_json:
        print_json({"model": str(path), "kind": new.kind, **said})
        return
    names = "/".join(new.robot.outputs.names)
    before, after = ("/".join(percent(fit) for fit in said[key]) for key in ("fit_before", "fit_after"))
    told = f"free run on {said['rows_held_out']} rows held out of {said['window_s']:.3g} s, fit [%] {names}:"
    if said["adapted"]:
        click.echo(f"{path}: adapted\n{told} {before} -> {after}")
    else:
        click.echo(f"{path}: the old model, kept: {said['why']}" + (f"\n{told} {before}" if before else ""))
