"""Permission to run on drives: certificates of `verify` and `simulate`, and a repeated simulation that agrees."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from softneck.core import Certificate, CheckFailedError, certificate_path, check_certificate, read_certificate
from softneck.cosim import LoopSetup
from softneck.loop import Loop, LoopResult, LoopRun
from softneck.robot import Robot
from softneck.signals import NECK
from softneck.verification import Requirement, Scale, read_requirements

# What `softneck verify` must have shown before a controller gets to drives, each at least as strictly as its defaults
# ask. What arming asks for later is a line here.
ARMING = {
    "stability.radius": "the loop is stable with every plant",
    "axes.disk_margin": "disk margin",
    "axes.gain_margin": "gain margin",
    "axes.delay_margin_ms": "delay margin",
    "step.overshoot_pct": "overshoot of a step",
    "step.load_rms_deg": "error under a load",
    "sim.slack_s": "tendons stay taut",
}
# What shows the same where loops over the draws of a family decided: every draw came to rest and kept the margins, of
# each axis and of all at once, with payloads and at three amplitudes. Gain and delay margin, which are asked for
# anyway, stand for the disk margin together.
BY_DRAWS = {
    "stability.radius": "axes.gain_margin",
    "axes.disk_margin": "axes.gain_margin",
    "step.overshoot_pct": "sim.overshoot_pct",
    "step.load_rms_deg": "sim.load_rms_deg",
}
# Share of plants that draws must speak for, with 95 % confidence: 59 draws do at each of the attempts of a family.
LEAST_CONTENT = 0.9
# Two machines round differently, which a stable loop keeps at 1e-9 rad and less; a drive cannot tell 1e-4 rad apart:
# its encoder has 1.3e-4 rad of the winch to a count.
SAME = 1e-4
# A run again takes no longer than this [s], beside loading and compiling; what it has reached by then is compared.
_REPLAY_TIME = 1.8
# Rows between two looks at the clock; of the slowest controllers they take 0.2 s.
_REPLAY_ROWS = 10
_OVERRIDE_WAY = "or let it pass by name with --override certificate."


def require_certified(
    setup: LoopSetup,
    controller: Path,
    certificates: Sequence[Path] = (),
    override: Collection[str] = (),
    *,
    drives: Path | None = None,
    robot: Robot | None = None,
) -> tuple[Certificate, Certificate] | None:
    """Return the certificates of `verify` and of `simulate` that let a run begin; None where they are overridden.

    Args:
        setup: the loop, as its file describes it.
        controller: the file that is to run.
        certificates: that were given; one that is not is looked for beside the controller, or beside the loop file.
        override: "certificate" in it lets everything pass.
        drives: the drives file, where one is used.
        robot: what the drives move; None: the neck.

    Raises:
        FileFormatError: no certificate, damaged or edited.
        CheckFailedError: one is missing, does not hold, asks for too little, is of another robot, or a file is not
            covered by it.
    """
    if "certificate" in override:
        return None
    loop = Path(setup.files["loop"][0]) if "loop" in setup.files else controller
    if drives is not None and "drives" not in setup.files:
        raise CheckFailedError(
            f'{loop}: names no drives file; write `drives = "{drives.name}"` into it, so that its certificate covers '
            f"{drives}, simulate it again, {_OVERRIDE_WAY}"
        )
    verified = _covering("verify", certificates, controller, [controller])
    _require_minimum(verified, robot or NECK)
    # All but the plant, which is hardware now.
    others = [Path(path) for role, (path, _) in setup.files.items() if role not in ("plant", "controller")]
    acting = [controller, *others, *([] if drives is None else [drives])]
    simulated = _covering("simulate", certificates, loop, acting)
    for found in (verified, simulated):
        _require_robot(found, robot or NECK)
    covered = float(simulated.contents.get("duration_s") or 0.0)
    # Half a sample: a duration is a whole number of them.
    if not covered >= setup.loop.duration - 0.5 * setup.loop.controller.sample_time:
        raise CheckFailedError(
            f"{simulated.path}: is for {covered:g} s, the run takes {setup.loop.duration:g} s; simulate it again."
        )
    return verified, simulated


def _covering(kind: str, given: Sequence[Path], item: Path, files: Sequence[Path]) -> Certificate:
    """Return the one certificate of this kind that covers all `files`: of those given, else the one beside `item`."""
    found = [path for path in given if read_certificate(path).kind == kind]
    beside = certificate_path(item)
    if not found and beside.is_file() and read_certificate(beside).kind == kind:
        found = [beside]
    if not found:
        command = "verify CONTROLLER MODEL -o FILE" if kind == "verify" else "simulate LOOP.toml --certificate FILE"
        raise CheckFailedError(
            f"{item}: has no certificate of `softneck {kind}`; `softneck {command}` writes one. Give it with "
            f"--certificate, {_OVERRIDE_WAY}"
        )
    refused: CheckFailedError | None = None
    for path in found:
        try:
            return check_certificate(path, files, kind=kind)
        except CheckFailedError as error:
            refused = refused or error
    raise CheckFailedError(str(refused))


def _require_robot(found: Certificate, robot: Robot) -> None:
    """Raise CheckFailedError unless a certificate is of `robot`: by the hash in it, or of a neck without one."""
    whose = found.contents.get("robot")
    said = str(whose.get("hash")) if isinstance(whose, dict) else NECK.hash
    if said != robot.hash:
        raise CheckFailedError(
            f"{found.path}: is of the robot with the hash {said[:8]}, the drives move {robot.label()}; certify the "
            f"controller for that one, {_OVERRIDE_WAY}"
        )


def _require_minimum(found: Certificate, robot: Robot) -> None:
    """Raise CheckFailedError unless the certificate holds all of `ARMING`, at least as strictly as the defaults.

    Of another robot the defaults are those that `verify` stretched to it, by what stands in the certificate.
    """
    said = found.contents.get("scale") or {}
    scale = Scale(robot=robot, time=float(said.get("time", 1.0)), size=float(said.get("size", 1.0)))
    defaults = {item.metric: item for item in read_requirements(scale=scale).bounds}
    load, simulated = (scale.name_of(name) for name in ("step.load_rms_deg", "sim.load_rms_deg"))
    defaults.setdefault(simulated, defaults[load])
    by_draws = BY_DRAWS if found.contents.get("draws") else {}
    if by_draws and not _content(found) >= LEAST_CONTENT:
        raise CheckFailedError(
            f"{found.path}: its draws stand for {100.0 * _content(found):.1f} % of such plants, at least "
            f"{100.0 * LEAST_CONTENT:g} % are needed; make the family with --draws 59 and verify again, {_OVERRIDE_WAY}"
        )
    for neck_metric, what in ARMING.items():
        metric = scale.name_of(neck_metric)
        if metric not in defaults:  # without tendons none must stay taut
            continue
        why = _why_not_shown(found, metric, defaults)
        if why and neck_metric in by_draws:
            metric = scale.name_of(by_draws[neck_metric])
            why = _why_not_shown(found, metric, defaults)
        if why:
            raise CheckFailedError(
                f"{found.path}: does not show `{metric}` ({what}): {why}. Verify again, {_OVERRIDE_WAY}"
            )


def _why_not_shown(found: Certificate, metric: str, defaults: Mapping[str, Requirement]) -> str:
    """Return why a certificate does not show a metric as strictly as its default; "" if it does."""
    least, rows = defaults[metric], [row for row in found.rows if row.get("metric") == metric]
    if not rows:
        return "it was not asked for"
    if all(row.get("holds") is not True for row in rows):
        return str(rows[0].get("note") or "it does not hold")
    if not any(_as_strict(row, least.bound, least.limit) for row in rows):
        return f"it asks for {float(rows[0].get('limit') or 0.0):g}, the default is {least.limit:g}"
    return ""


def _content(found: Certificate) -> float:
    """Return the least share of plants that the draws of a certificate stand for; 0 if one of them fails."""
    said = found.contents["draws"]
    try:
        return float(np.min([0.0 if part["failed"] else float(part["content"]) for part in said]))
    except (KeyError, TypeError, ValueError):
        return 0.0


def _as_strict(row: dict, bound: str, limit: float) -> bool:
    found = row.get("limit")
    if row.get("holds") is not True or not isinstance(found, int | float):
        return False
    if bound == "min":
        return row.get("bound") == "min" and found >= limit
    return row.get("bound") in ("max", "below") and found <= limit


def require_same_again(loop: Loop, certificate: Certificate) -> float:
    """Run `loop` on its own plant and compare it with its certificate; return how much of it was compared [s].

    Raises CheckFailedError: set-points or angles part by more than 1e-4 rad, or the certificate keeps none.
    """
    trace = certificate.contents.get("trace")
    if not isinstance(trace, dict) or not trace.get("row"):
        raise CheckFailedError(f"{certificate.path}: is of an earlier softneck and keeps no rows; simulate it again.")
    again = _run_for(loop, _REPLAY_TIME)
    for said, certified in trace.items():
        if said == "row":
            continue
        name = loop.robot.own(said)
        values = again.angle(name) if name in loop.robot.outputs.names else again[name]
        for row, value in zip(trace["row"], certified, strict=True):
            if row < len(values) and not _same(float(values[row]), value):
                expected = math.nan if value is None else value
                raise CheckFailedError(
                    f"{certificate.path}: the loop does not do again what was certified: `{name}` is {values[row]:.6g} "
                    f"instead of {expected:.6g} rad at t = {again.time[row]:.2f} s. Simulate it again, {_OVERRIDE_WAY}"
                )
    return float(again.time[-1] + again.sample_time)


def _same(value: float, certified: float | None) -> bool:
    """Return whether a value is the certified one; None there is a sample that was missing."""
    return math.isnan(value) if certified is None else abs(value - certified) <= SAME


def _run_for(loop: Loop, seconds: float) -> LoopResult:
    """Return the rows of `loop` that `seconds` of this machine's time are enough for, from its begin."""
    with LoopRun(loop) as run:
        ended = run.advance(1)
        until = time.perf_counter() + seconds
        while not ended and time.perf_counter() < until:
            ended = run.advance(_REPLAY_ROWS)
        return run.result()
