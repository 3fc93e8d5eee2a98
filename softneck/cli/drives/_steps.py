"""Steps of a commissioning that are done alone: who is on the bus, where zero is, which way a motor tilts the neck."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from softneck.core import CheckFailedError

from ..shared._console import note, print_json, print_table, progress
from ._log import drives_of, opened_log, require_log
from ._target import SAMPLE_TIME, Asked, Target, leave_if_asked, look_of, open_link, sensor_of

if TYPE_CHECKING:
    from softneck.drives import CanLink
    from softneck.drives.bus._link import VirtualLink
    from softneck.drives.commissioning._jog import JogResult
    from softneck.drives.logs._run_log import RunLogger
    from softneck.drives.running._bus_loop import Session
    from softneck.drives.running._keyboard import Keyboard


def scan_step(asked: Asked, *, as_json: bool) -> None:
    """List the nodes on the bus; sends reads only. Fails if none answers, or several devices at one number."""
    from softneck.drives import default_drives, scan
    from softneck.drives.running._scan import several_devices

    nameless = asked.bus is not None and asked.drives is None
    chosen = Target(default_drives(), asked.bus, False, asked.arm) if nameless else asked.target()
    with open_link(chosen, moves=False) as link:
        found = scan(link, bit_rate=chosen.file.bit_rate)
    if as_json:
        print_json({"nodes": found})
    else:
        rows = [[str(item["node"]), str(item["name"] or "-"), str(item["firmware"] or "-"), _serials(item["serials"]),
                 str(item["state"] or "-")] for item in found]  # fmt: skip
        print_table(f"{len(found)} node(s)", ["node", "name", "firmware", "serial", "state"], rows)
    if not found:
        raise CheckFailedError(
            f"{asked.bus or 'the bus'}: no node answers. Are the drives on, is the bit rate right, is the line "
            "terminated (60 ohm between CAN_H and CAN_L)?"
        )
    shared = [(item["node"], several_devices(item["serials"])) for item in found]
    listed = "; ".join(f"node {node}: {told}" for node, told in shared if told)
    if listed:
        raise CheckFailedError(f"{listed}. Give each device a node number of its own.")


def _serials(serials: list[int | None]) -> str:
    return ", ".join(str(serial or "-") for serial in serials) or "-"


def zero_step(asked: Asked, *, force: bool, as_json: bool) -> None:
    """Tension each tendon gently, set the encoders' zero there, and verify with the inclinometer."""
    from softneck.drives import preflight, zero
    from softneck.drives.logs._run_log import run_facts
    from softneck.drives.running._keyboard import Keyboard

    chosen = asked.target()
    require_log(asked.log, force=force)
    with (
        open_link(chosen, moves=True) as link,
        opened_log(chosen, "zero", asked.log, force=force) as log,
    ):
        link.tap = None if log is None else log.frame
        look = look_of(link, chosen.file)
        report = preflight(link, chosen.file, override=asked.override)
        report.require()
        if log is not None:
            # It has no cycles: what was set up, and the frames.
            settings = chosen.file.master_settings(SAMPLE_TIME, guarding=report.guarding)
            log.describe(run_facts(settings, drives_of(chosen.path), simulated=chosen.simulated))
        with Keyboard() as keyboard:
            try:
                zeroed = zero(link, chosen.file, look, guarding=report.guarding, operator=keyboard)
            except CheckFailedError as error:
                if keyboard.interrupted or keyboard.terminated:
                    note(str(error))
                leave_if_asked(keyboard)
                raise
    if as_json:
        print_json(zeroed.table())
        return
    rows = [[f"node {node}", f"{pulled:.3f}"] for node, pulled in zip(zeroed.nodes, zeroed.pulled, strict=True)]
    print_table("Zeroed", ["motor", "pulled [rad]"], rows)


def jog_step(asked: Asked, motor: int, amplitude: float, *, force: bool, as_json: bool) -> None:
    """Pull a motor's tendon a little, let it out as much, and look where the neck goes; the drives must be zeroed.

    Fails if that is not where the tendon's angle says: nodes swapped, a sign reversed, a tendon that hangs.
    """
    from softneck.drives import jog
    from softneck.drives.running._keyboard import Keyboard
    from softneck.drives.running._virtual import physics_of

    require_log(asked.log, force=force)
    chosen = asked.target()
    if motor > len(chosen.file.nodes):
        raise click.BadParameter(f"{motor} is not in the range 1<=x<={len(chosen.file.nodes)}.", param_hint="'--motor'")
    # A neck's tendons stand where its own file says.
    physics = physics_of(chosen.file.moves, None) if chosen.is_neck else None
    angles = physics and (physics.tendon_angle_1, physics.tendon_angle_2, physics.tendon_angle_3)
    with (
        open_link(chosen, moves=True, homed=True) as link,
        opened_log(chosen, "jog", asked.log, force=force) as log,
    ):
        with progress("jog", quiet=as_json) as tell, Keyboard() as keyboard:
            found = jog(
                motor,
                session_of(asked, chosen, link, keyboard, log, drives_of(chosen.path)),
                tendon_angles=angles,
                amplitude=amplitude,
                report=lambda done: tell(done, f"motor {motor}"),
            )
        _print_jog(found, as_json=as_json)
        leave_if_asked(keyboard, terminated=found.ended.terminated)
        found.require()


def _print_jog(found: JogResult, *, as_json: bool) -> None:
    values = found.table()
    if as_json:
        print_json(values)
        return
    rows = []
    for name in values["expected"]:
        cells = [values[key][name] for key in ("expected", "seen")]
        rows.append([name, *("-" if cell is None or cell != cell else f"{cell:.2f}" for cell in cells)])
    print_table(f"Motor {found.motor} (node {found.node}): {found.verdict}", ["way up", "expected", "seen"], rows)


def session_of(
    asked: Asked, chosen: Target, link: CanLink | VirtualLink, keyboard: Keyboard, log: RunLogger | None,
    files: Mapping[str, str | Path],
) -> Session:  # fmt: skip
    """Return what a master needs to move the drives."""
    from softneck.drives.bus._link import VirtualLink
    from softneck.drives.running._bus_loop import Session

    sensor = None if isinstance(link, VirtualLink) else sensor_of(chosen.file)
    return Session(
        file=chosen.file, link=link, sensor=sensor, override=asked.override, pace=asked.pace, operator=keyboard,
        log=log, files=files,
    )  # fmt: skip
