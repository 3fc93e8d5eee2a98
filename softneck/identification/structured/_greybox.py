"""Kind `greybox`: the equations of a tendon-driven neck with unknown numbers, fitted by the error of its simulation.

Rates and dead times are in the time of a neck. Several payloads tell how stiffness and pretension go with them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from softneck.core import (
    DataError,
    FileFormatError,
    Matrix,
    Progress,
    Vector,
    one_blas_thread,
    require_whole,
    silent,
)
from softneck.plant import require_tendons
from softneck.signals import Recording

from ..models._arrays import MOST_PAYLOAD, memory_array, within
from ..models._drive import fit_noise_model
from ..models._fitting import ScaledData, training_recording
from ..models._linear_systems import history_array
from ..models._model import Model
from ._neck_equations_runtime import NECK_SENSOR_RATE
from ._output_error import SETTLING_S, FitProblem, Found, SearchProgress, intervals
from ._parameters import BODY_PARAMETERS, NO_EFFECT, PARAMETERS, PARTS, PAYLOAD_CURVE, PAYLOAD_PARAMETERS, RIGID
from ._parts import choose_parts, describe_parts, differing, extend, parts_of

# A held input is forgotten after so long [s of a neck's time].
_MEMORY_S = 3.0
_NOISE_ORDER = 8
# A displaced tendon's, over that of tendon 1: the largest of its search, and what rounding adds.
_LONGEST_ARM = 2.01
# The sensor's delay and lag are found up to so much too short or too long [s of a neck's time]: of 18 sensors of 10 to
# 110 ms on six necks 12 were in between, the others at most 7 ms outside.
_FOUND_TOO_SHORT_S, _FOUND_TOO_LONG_S = 0.005, 0.025
INTERRUPTED = "the fit was interrupted; these are the best numbers until then"


@dataclass(frozen=True, slots=True, kw_only=True)
class GreyBox:
    """Tendon kinematics, slack, hysteresis, stalling drives, lag and dead time; 16 numbers, by output error.

    The equations are in `_neck_equations_runtime`; findings hold each number with its unit and 95 % confidence. Where
    the recordings' channel `payload` has several values, two more say what it changes.

    Attributes:
        evaluations: at most so many steps of Levenberg-Marquardt for each dead time.
        sensor_delay: dead time of the inclinometer in samples; None tries 1 to 4, of a slower robot as
            many more.
        body: what it has beside these numbers: nothing ("rigid"), some of anisotropy, stop (of compression),
            softening, creep, tendons (their angles and arms), homing (where they are stretched alike), arc (how a bend
            gives them way) and speed (of the drives) joined by "+", "all", or ("auto") all, or those that are needed,
            if they predict motions left out of a training better.
    """

    evaluations: int = 40
    sensor_delay: int | None = None
    body: str = "auto"

    def __post_init__(self) -> None:
        require_whole("evaluations", self.evaluations, 1, 10_000)
        if self.sensor_delay is not None:
            require_whole("sensor_delay", self.sensor_delay, 0, 100)
        parts_of(self.body)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify the numbers; Ctrl-C keeps the best so far.

        Args:
            recordings: one or several of one sample time; their runs are never joined.
            progress: called with the part done and the error.

        Raises:
            DataError: too short or constant, or a payload that changes within a run or that no neck bears.
            SettingsError: a robot that no tendons on winches bend.
        """
        recording = training_recording(recordings)
        require_tendons(recording.robot, "kind `greybox`")
        scaled = ScaledData.of(recording, amplitudes=False)  # the equations are in rad
        problem = FitProblem.of(scaled)
        tell = SearchProgress(progress, 4 * self.evaluations * (len(problem.numbers) + 1))
        found = Found(problem, np.zeros(0), self.sensor_delay or 0, np.inf)
        told, said = tuple(NO_EFFECT), dict[str, object]()
        try:
            found = problem.delayed(self.sensor_delay, self.evaluations, tell)
            parts = parts_of(self.body)
            if parts is None:
                found, told, said = choose_parts(found, scaled, self.evaluations, tell)
            else:
                found = extend(found, parts, self.evaluations, tell)
        except KeyboardInterrupt:
            said["interrupted"] = INTERRUPTED
            if not found.x.size and tell.best is not None:
                cost, x, delay = tell.best
                found = Found(problem, x, round(delay), cost)
        if not np.isfinite(found.cost):
            raise DataError("no numbers of the grey box give a finite error; look for wild values in the recording.")
        model = _model(self, found.problem, scaled, found.delay, found.x, told)
        progress(1.0, "done")
        return replace(model, findings={**model.findings, **said})


def as_found(settings: GreyBox, model: Model) -> GreyBox:
    """Return the settings for other rows of the robot that `model` is of: with its dead time and confirmed parts."""
    confirmed = model.findings.get("confirmed")
    body = str(model.settings["body"]) if confirmed is None else "+".join(confirmed) or "rigid"
    return replace(settings, sensor_delay=int(model.findings["sensor_delay"]), body=body)


def _model(
    settings: GreyBox, problem: FitProblem, scaled: ScaledData, delay: int, x: Vector, told: Collection[str]
) -> Model:
    numbers, load, outputs = problem.decode(x), problem.load(x), scaled.data.outputs.shape[1]
    skip = round(SETTLING_S / problem.sample_time)
    errors = [y - Y for (_, Y), (_, _, _, y) in zip(problem.simulate(x, delay), problem.runs, strict=True)]
    for error in errors:
        error[:skip] = np.nan
    echo = np.array([fit_noise_model([error[:, axis] for error in errors], _NOISE_ORDER) for axis in range(outputs)])
    pole = np.exp(-numbers[0] * problem.sample_time)
    drive = np.column_stack([np.full(len(problem.drive_delays), pole), problem.drive_delays])
    arrays = {
        "history": history_array(int(max(_NOISE_ORDER, drive[:, 1].max())), outputs),
        "drive": drive,
        "neck": numbers,
        **({"body": problem.body(x)} if (problem.body(x)[1:] != RIGID[1:]).any() else {}),
        "sensor": np.array([float(delay), problem.sample_time]),
        "echo": echo,
        "memory": memory_array(_MEMORY_S, problem.sample_time),
        **({"payload": load} if load.size else {}),
    }
    chosen = replace(settings, body="+".join(problem.parts) or "rigid")
    table = intervals(problem, x, delay)
    shown = differing(table, told)
    text = describe_parts(problem.reach, table, shown, scaled.scaling.second)
    for number, row in zip(problem.numbers, table, strict=True):
        if number.is_rate:
            row |= {key: scaled.scaling.second**-1 * row[key] for key in ("value", "low", "high")}
    findings = {"sensor_delay": delay, "numbers": table}
    lag = next(row for row in table if row["name"] == "sensor_rate")
    # Without logged motors the data show only the sum of the drives' delay and the sensor's.
    if problem.logged and settings.sensor_delay is None and not lag["at_bound"]:
        found = delay * problem.sample_time + 1.0 / numbers[NECK_SENSOR_RATE]
        least, most = (float(scaled.scaling.second * (found + off)) for off in (-_FOUND_TOO_LONG_S, _FOUND_TOO_SHORT_S))
        findings["sensor_delay_s"] = [max(least, 0.0), most if delay < max(problem.delays()) else None]
    if text:
        findings["found"] = text
    if problem.parts and settings.body == "auto":  # parts that were asked for need no confirmation
        findings["confirmed"] = [part for part in problem.parts if shown & {number.name for number in PARTS[part]}]
    return scaled.model("greybox", chosen, lambda arrays, _: dict(arrays), arrays=arrays, findings=findings)


def check_greybox(arrays: Mapping[str, Matrix], sizes: Mapping[str, int]) -> None:
    within(np.array([sizes["p"]]), 1, sizes["H"], "the length of the echo")
    within(arrays["drive"][:, 1], 1, sizes["H"], "a drive's delay")
    within(arrays["sensor"][:1], 0, 1000, "the sensor's dead time")
    if "payload" in arrays:
        _check_payload(arrays["payload"])
    numbers, tendons = np.split(arrays["neck"], [len(PARAMETERS)])
    neck = (sizes["motors"], sizes["outputs"]) == (3, 2) and not tendons.size
    if not neck and tendons.size != 1 + 2 * sizes["motors"]:
        raise FileFormatError(f"its array `neck` has {arrays['neck'].size} numbers, which do not fit its tendons.")
    if np.abs(tendons).max(initial=0.0) > _LONGEST_ARM or not (tendons[:1] > 0.0).all():
        raise FileFormatError("the directions of its tendons in its array `neck` are not of length 1.")
    _check_body(arrays["body"])
    for number, value in zip(PARAMETERS, numbers, strict=True):
        # A thousandth for the rounding of logarithms.
        margin = 1e-3 * max(abs(number.low), abs(number.high))
        if not number.low - min(margin, 0.1 * abs(number.low)) <= value <= number.high + margin:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")


def _check_body(body: Matrix) -> None:
    low = [1e-6, *(number.low for number in BODY_PARAMETERS)]
    high = [np.pi, *(number.high for number in BODY_PARAMETERS)]
    # A thousandth for the rounding of logarithms.
    if (body < np.array(low) - 1e-3 * np.abs(low)).any() or (body > 1.001 * np.array(high)).any():
        raise FileFormatError("its array `body` holds a reach or a number of an optional part that is out of range.")


def _check_payload(load: Matrix) -> None:
    numbers = (*PAYLOAD_PARAMETERS, PAYLOAD_CURVE)[: load.size - 2]
    if load.size not in (4, 5):
        raise FileFormatError(f"its array `payload` has {load.size} numbers; 4 or 5 are needed.")
    least, most = load[:2]
    if not 0.0 <= least <= most <= MOST_PAYLOAD:
        raise FileFormatError(f"its payloads from {least:g} to {most:g} kg are not between 0 and {MOST_PAYLOAD:g}.")
    for number, value in zip(numbers, load[2:], strict=True):
        if not number.low <= value <= number.high:
            raise FileFormatError(f"its {number.name} of {value:g} {number.unit} is out of range.")
