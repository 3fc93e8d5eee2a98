"""One block of every kind, the variables that the public face names for it, and inputs to run it with."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import control
import numpy as np

from softneck.design import (
    AdaptiveSettings,
    CustomSettings,
    FopiSettings,
    HinfSettings,
    LqgSettings,
    NmpcSettings,
    PidSettings,
    PiSettings,
)
from softneck.design.predictive._settings import MpcNumbers
from softneck.estimation import KalmanSettings, LinearNeck
from softneck.fmu.describe._description import with_modelled_drives
from softneck.identification import (
    GreyBox,
    Model,
    Network,
    OutputError,
    Play,
    Rls,
    SetMembership,
)
from softneck.identification.uncertainty._guarded import Base, Guarded
from softneck.plant import NeckParameters, VirtualNeck
from softneck.runtime import Block, load_runtime
from softneck.signals import Recording, redefine, signal

TS = 0.02
ROWS = 400
MOTORS = [f"motor_setpoint_{j}" for j in (1, 2, 3)]
_MODEL = ("pitch_start", "roll_start", "use_measurement", "noise_std", "noise_seed")


@cache
def recording() -> Recording:
    """Eq. 22 through two slow poles with a ripple: something to identify."""
    P = signal("eq22").set_points[: 2 * ROWS]
    drive = redefine(P)
    y = np.zeros((2 * ROWS, 2))
    for k in range(2 * ROWS - 1):
        y[k + 1] = 0.9 * y[k] + 0.01 * drive[k, :2] + 1e-3 * math.sin(k)
    channels = {name: P[:, j] for j, name in enumerate(MOTORS)} | {"pitch": y[:, 0], "roll": y[:, 1]}
    return Recording(np.arange(2 * ROWS) * TS, TS, channels)


def _linear(stronger: float = 1.0) -> LinearNeck:
    pole = math.exp(-5.293 * TS)  # Eq. 31
    tf = control.TransferFunction([0.09 * stronger * (1.0 - pole)], [1.0, -pole, 0.0, 0.0], TS)
    return LinearNeck(pitch=tf, roll=tf)


def _rls() -> Block:
    return Rls().fit(recording()).block()


def _miso() -> Block:
    return Rls(structure="miso", nb=2, max_delay=0.1).fit(recording()).block()


def _oe() -> Block:
    return OutputError(max_delay=0.1).fit(recording()).block()


def _oe2() -> Block:
    return OutputError(nf=2, nb=2, max_delay=0.1).fit(recording()).block()


def _nlsm() -> Block:
    return SetMembership().fit(recording()).block()


def _residual() -> Block:
    return SetMembership(form="residual").fit(recording()).block()


def _play() -> Block:
    return Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording()).block()


def _greybox() -> Block:
    return GreyBox(evaluations=3, sensor_delay=2, body="all").fit(recording()).block()


@cache
def _loaded_greybox_model() -> Model:
    """Two payloads of which nothing follows: what they change is searched for all the same."""
    heavy = recording().with_channels(payload=np.full(len(recording()), 0.5))
    return GreyBox(evaluations=2, sensor_delay=2).fit([recording(), heavy])


def _loaded_greybox() -> Block:
    return _loaded_greybox_model().block()


def _guarded() -> Block:
    members = [Play(rate=rate, widths=(0.2,), degree=3, ridge=1e-4).fit(recording()) for rate in (10.0, 15.0)]
    base = Base(Rls().fit(recording()), np.full(2, 0.01), np.full(2, 90.0))
    return Guarded(of="play").around(base, members, recording()).block()


def _nn() -> Block:
    return Network(hidden=(5, 5), iterations=3).fit(recording()).block()


def _neck() -> Block:
    return VirtualNeck(NeckParameters.paper()).block(noise_seed=3)


def _kalman() -> Block:
    return KalmanSettings().design(_linear()).block()


def _kalman_gyro() -> Block:
    return KalmanSettings(form="gyro", sensor_delay=0.03).design(_linear()).block()


def _nonlinear() -> Block:
    return KalmanSettings().design(Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording())).block()


def _payload_observer() -> Block:
    return KalmanSettings().design(_loaded_greybox_model()).block()


def _pi() -> Block:
    return PiSettings().design(_linear()).block()


def _adaptive() -> Block:
    return AdaptiveSettings().design(_linear()).block()


def _hinf() -> Block:
    return HinfSettings(bandwidth=4.0).design(_linear()).block()


def _pid() -> Block:
    return PidSettings().design(_linear()).block()


def _fopi() -> Block:
    return FopiSettings(crossover=4.0).design(_linear()).block()


def _lqg() -> Block:
    return LqgSettings().design(_linear()).block()


def _custom() -> Block:
    K = control.TransferFunction([4.0, -3.5], [1.0, -1.0], TS)
    return CustomSettings(controller=K).design(_linear()).block()


def _mpc() -> Block:
    return MpcNumbers(bandwidth=6.0, moves=5, angle_limit=0.5).design(_linear()).block()


def _nmpc() -> Block:
    model = Play(rate=15.0, widths=(0.2,), degree=3, ridge=1e-4).fit(recording())
    return NmpcSettings(horizon=8, moves=3, angle_limit=0.5).design(model).block()


_REFERENCES = ["pitch_reference", "roll_reference", "cocontraction_reference", "pitch", "roll", "healthy", "enabled"]

# Kind -> its block, inputs, outputs and parameters that the public face names for it.
KINDS: dict[str, tuple[Callable[[], Block], list[str], list[str], tuple[str, ...]]] = {
    "rls": (_rls, MOTORS, ["pitch", "roll", "motor_position_1", "validity"], _MODEL),
    "miso": (_miso, MOTORS, ["pitch", "roll", "motor_position_2", "validity"], _MODEL),
    "oe": (_oe, MOTORS, ["pitch", "roll", "motor_position_1", "validity"], _MODEL),
    "oe2": (_oe2, MOTORS, ["pitch", "roll", "motor_position_2", "validity"], _MODEL),
    "nlsm": (
        _nlsm,
        MOTORS,
        ["pitch", "roll", "pitch_lower", "pitch_upper", "roll_lower", "roll_upper", "validity"],
        _MODEL,
    ),
    "residual": (_residual, MOTORS, ["pitch", "pitch_lower", "roll_upper", "motor_position_2", "validity"], _MODEL),
    "play": (_play, MOTORS, ["pitch", "roll", "motor_position_3", "validity"], _MODEL),
    "greybox": (_greybox, MOTORS, ["pitch", "roll", "motor_position_1", "validity"], _MODEL),
    "greybox_loaded": (
        _loaded_greybox,
        MOTORS,
        ["pitch", "roll", "motor_position_1", "validity"],
        (*_MODEL, "payload"),
    ),
    "guarded": (_guarded, MOTORS, ["pitch", "roll", "motor_position_1", "validity"], _MODEL),
    "nn": (_nn, MOTORS, ["pitch", "roll", "motor_position_3", "validity"], _MODEL),
    "neck": (
        _neck,
        [*MOTORS, "payload", "push_x", "push_y", "base_tilt_pitch", "base_tilt_roll"],
        ["pitch", "pitch_measured", "roll_rate_measured", "measurement_valid", "tension_2", "compression"],
        ("noise_seed",),
    ),
    "kalman": (
        _kalman,
        [*MOTORS, "pitch_measured", "roll_measured", "measurement_valid"],
        ["pitch", "roll", "pitch_rate", "roll_rate", "innovation", "healthy"],
        (),
    ),
    "kalman_gyro": (
        _kalman_gyro,
        [*MOTORS, "pitch_measured", "measurement_valid", "pitch_rate_measured", "roll_rate_measured"],
        ["pitch", "roll", "pitch_rate", "roll_rate", "innovation", "healthy"],
        ("measurement_noise_std", "gyro_noise_std", "bias_noise_std"),
    ),
    "nonlinear": (
        _nonlinear,
        [*MOTORS, "pitch_measured", "roll_measured", "measurement_valid"],
        ["pitch", "roll", "pitch_rate", "roll_rate", "innovation", "healthy"],
        ("measurement_noise_std", "rest_noise_std", "motion_noise_ratio"),
    ),
    "nonlinear_payload": (
        _payload_observer,
        [*MOTORS, "pitch_measured", "roll_measured", "measurement_valid"],
        ["pitch", "roll", "pitch_rate", "roll_rate", "innovation", "healthy", "payload"],
        ("measurement_noise_std", "rest_noise_std", "motion_noise_ratio"),
    ),
    "mpc": (
        _mpc,
        ["pitch_reference", "roll_reference", "cocontraction_reference", "pitch", "roll", "healthy", "enabled"],
        MOTORS,
        ("position_limit", "slew_limit", "lead_limit", "angle_limit"),
    ),
    "nmpc": (_nmpc, _REFERENCES, MOTORS, ("position_limit", "slew_limit", "lead_limit", "least_position")),
    "pi": (
        _pi,
        _REFERENCES,
        MOTORS,
        (),
    ),
    "adaptive": (_adaptive, _REFERENCES, MOTORS, ("lead_limit", "least_cocontraction", "adapt")),
    "hinf": (_hinf, _REFERENCES, MOTORS, ("slew_limit",)),
    "pid": (_pid, _REFERENCES, MOTORS, ("slew_limit",)),
    "fopi": (_fopi, _REFERENCES, MOTORS, ("slew_limit",)),
    "lqg": (_lqg, _REFERENCES, MOTORS, ("slew_limit",)),
    "custom": (_custom, _REFERENCES, MOTORS, ("slew_limit",)),
}


# Kinds that also run as C; nonlinear predictive control is not translated.
NATIVE = [kind for kind in KINDS if kind != "nmpc"]


# Those whose runtimes take longest to compile.
HEAVY = ("guarded", "nmpc")
# One of each sort, for tests that take long with every kind: models, one of them with bounds, an observer, a
# controller, the neck.
SHORT = ("rls", "nlsm", "kalman", "pi", "neck")
# One of each family of runtimes.
FAMILIES = (*SHORT, "miso", "nn", "play", "greybox", "mpc", "adaptive")


@cache
def block_of(kind: str) -> Block:
    return KINDS[kind][0]()


def as_block(block: Block) -> dict[str, float]:
    """Return the parameters with which the block's FMU does what the block does: positions as they come."""
    return {"use_motor_positions": 1.0} if block.role == "controller" else {}


def plain_run(block: Block, rows: np.ndarray, **parameters: float) -> np.ndarray:
    """Return the outputs (time, n_out) of the plain text, where compiling would take a minute, as FMUs hold it."""
    whole = with_modelled_drives(block)
    runtime = load_runtime(whole.runtime, compiled=False)
    values = np.array([parameters.get(port.name, port.start) for port in whole.parameters])
    state, outputs = np.zeros(runtime.state_size(whole.arrays)), np.zeros((len(rows), len(whole.outputs)))
    runtime.initialise(whole.arrays, values, state, np.zeros(len(whole.outputs)))
    runtime.run_steps(whole.arrays, values, state, rows, outputs)
    return outputs


def inputs_of(block: Block, rows: int, *, missing: bool = True) -> np.ndarray:
    """Return small random inputs (rows, n_in); Booleans mostly true, some measurements missing."""
    rng = np.random.default_rng(11)
    u = 0.2 * rng.standard_normal((rows, len(block.inputs)))
    for i, port in enumerate(block.inputs):
        if port.name.startswith("motor_setpoint"):
            u[:, i] = 5.0 * u[:, i].cumsum() / math.sqrt(rows)
        if port.boolean:
            u[:, i] = rng.random(rows) > 0.05
        elif port.missing and missing:
            u[rng.random(rows) > 0.8, i] = np.nan
        if port.minimum is not None and port.maximum is not None:
            u[:, i] = np.clip(u[:, i], port.minimum, port.maximum)
    return u
