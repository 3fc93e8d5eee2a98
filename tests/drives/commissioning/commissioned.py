"""Drives that are not set up as their file says, commissioned in virtual time; and how far the neck truly tilted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from softneck.drives import DrivesFile, neck_drives
from softneck.drives.bus._link import VirtualLink
from softneck.drives.commissioning._identify import Expected, Identified, apply_findings, identify
from softneck.drives.commissioning._measure import expected_of, measure
from softneck.drives.commissioning._moves import Guards, Moves
from softneck.drives.running._bus_loop import Session
from softneck.plant import NeckParameters

from .planted import Planted, plant, planted_link


class Truth:
    """A watch that keeps the largest true tilt, absolute and from where the neck stood [deg]."""

    def __init__(self, link: VirtualLink) -> None:
        self._link, self._first = link, None
        self.largest = self.moved = 0.0

    def __call__(self, *_: Any) -> None:
        told = self._link.neck.truth()
        now = np.degrees([told[name] for name in ("pitch", "roll") if name in told])
        self._first = now if self._first is None else self._first
        self.largest = max(self.largest, float(np.linalg.norm(now)))
        self.moved = max(self.moved, float(np.linalg.norm(now - self._first)))


@dataclass(frozen=True)
class Run:
    planted: Planted
    moves: Moves
    found: Identified
    right: DrivesFile
    truth: Truth

    @property
    def names(self) -> set[str]:
        return {one.name for one in self.found.findings}


@cache
def believed(preset: str) -> tuple[DrivesFile, Guards, Expected | None]:
    """The file of a neck as its owner has it, and what its own virtual plant lets expect: once for all tests."""
    neck = NeckParameters.preset(preset)
    file = neck_drives(neck)
    guards = Guards.of(file.watch.gain)
    return file, guards, expected_of(file, guards, neck)


def commissioned(mistakes: Sequence[str], preset: str = "paper", *, seed: int = 0) -> Run:
    """Without the drives' types: what they would tell before, the moves have to tell here."""
    file, guards, expected = believed(preset)
    planted = plant(file, mistakes)
    link = planted_link(file, planted, NeckParameters.preset(preset), sample_time=0.02, seed=seed)
    truth = Truth(link)
    moves, _ = measure(Session(file=file, link=link, watches=(truth,)), guards, motors=(1, 2, 3))
    assert all(drive.axis.state != 0x27 for drive in link.neck.drives)
    found = identify(moves, file, expected)
    return Run(planted, moves, found, apply_findings(file, found), truth)


def agrees(run: Run) -> bool:
    """Whether what is proposed is how the drives are: itself, or what no move can tell from it."""
    wanted = run.planted.file
    if (run.right.drives, run.right.sensor_axes) == (wanted.drives, wanted.sensor_axes):
        return True
    # A reversed roll is an exchange of tendons 2 and 3, seen in a mirror: node by node the drives are the same then.
    by_node = [sorted(file.drives, key=lambda entry: entry.node) for file in (run.right, wanted)]
    return by_node[0] == by_node[1] and any(one.instead for one in run.found.findings)
