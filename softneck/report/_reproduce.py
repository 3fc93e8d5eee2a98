"""The paper again, on virtual necks: its three models, its tests, and the same on other plants for comparison."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from softneck.core import require_whole
from softneck.identification import Model, Network, Rls, SetMembership
from softneck.plant import NeckParameters

from ._packaging import Experiments, Tell, ValidationPair, judge, record_experiments

# The paper's norm (Eq. 16) has no weights, and its logs have motors in radians and angles in degrees: taken as they
# are, an angle weighs 180/pi times a motor.
AS_LOGGED = 180.0 / np.pi
# The preset that a line follows no better than the paper's neck.
ROUGH = "rough"
_DURATION = 200.0
_SPREAD_SEED = 0

Verdicts = Mapping[tuple[str, str], ValidationPair]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReproduceSettings:
    """How the paper is run again: training, length of the experiment, other necks.

    Attributes:
        iterations: of the network's training, for each axis.
        seed: of the network's start.
        other_necks: how many other plants say what is the plant's: the presets `rough` and `lab`, then necks
            drawn around `paper` (20 % spread).
        duration: of Eq. 22 [s]; the paper's is 200.
    """

    iterations: int = 30
    seed: int = 0
    other_necks: int = 3
    duration: float = _DURATION

    def __post_init__(self) -> None:
        require_whole("iterations", self.iterations, 1, 1000)
        require_whole("other_necks", self.other_necks, 0, 50)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Reproduction:
    """The paper's experiments, models and scores on our necks.

    Attributes:
        experiments: recordings on the `paper` preset.
        models: nlsm, nn and rls of those.
        judged: (model, data) -> scores on the `paper` preset.
        others: name of another neck -> its scores.
        seconds: it all took.
    """

    settings: ReproduceSettings
    experiments: Experiments
    models: Mapping[str, Model]
    judged: Verdicts
    others: Mapping[str, Verdicts]
    seconds: float


def reproduce(settings: ReproduceSettings, *, tell: Tell) -> Reproduction:
    """Run the paper's sections 3 to 7 on the virtual neck, and its identification on other necks.

    Args:
        settings: what to run.
        tell: announces a stage and returns its progress callback.
    """
    begin = time.monotonic()
    experiments = record_experiments(NeckParameters.paper(), duration=settings.duration, tell=tell)
    models = _models(experiments, settings, tell)
    others: dict[str, Verdicts] = {}
    for name, neck in _other_necks(settings.other_necks).items():
        recorded = record_experiments(neck, duration=settings.duration, tell=lambda text, n=name: tell(f"{n}: {text}"))
        others[name] = judge(
            _models(recorded, settings, lambda text, n=name: tell(f"{n}: {text}")),
            recorded,
            tell=lambda text, n=name: tell(f"{n}: {text}"),
        )
    return Reproduction(
        settings=settings,
        experiments=experiments,
        models=models,
        judged=judge(models, experiments, tell=tell),
        others=others,
        seconds=time.monotonic() - begin,
    )


def _models(experiments: Experiments, settings: ReproduceSettings, tell: Tell) -> dict[str, Model]:
    estimators = {
        "nlsm": SetMembership(output_weight=AS_LOGGED),
        "nn": Network(iterations=settings.iterations, seed=settings.seed),
        "rls": Rls(),
    }
    data = experiments.identification
    return {kind: estimator.fit(data, progress=tell(f"identify {kind}")) for kind, estimator in estimators.items()}


def _other_necks(count: int) -> dict[str, NeckParameters]:
    rng = np.random.default_rng(_SPREAD_SEED)
    drawn = {f"neck {number + 1}": NeckParameters.paper().sample(rng) for number in range(max(count - 2, 0))}
    return dict(list({ROUGH: NeckParameters.rough(), "lab": NeckParameters.lab(), **drawn}.items())[:count])
