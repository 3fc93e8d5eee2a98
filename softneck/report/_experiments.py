"""Step 1 to 3 of the demo: record on the virtual neck, identify, judge."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from softneck.core import Progress
from softneck.identification import INFINITE, Model, Network, Rls, SetMembership, Validation, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import Recording, signal

TESTS = ("steps", "sine", "rotation")
# Section 5: 7,000 of 10,000 samples identify, the rest validates.
TRAIN = 0.7
# Noise differs between experiments, and between any two runs of the demo it does not.
_SEEDS = {"eq22": 1, "steps": 2, "sine": 3, "rotation": 4}

Tell = Callable[[str], Progress]


@dataclass(frozen=True, slots=True, eq=False)
class Experiments:
    """What was recorded: Eq. 22 split into its two parts, and the three tests."""

    identification: Recording
    validation: Recording
    tests: Mapping[str, Recording]

    @property
    def judged(self) -> dict[str, Recording]:
        """All recordings that no model was trained on, by the paper's names."""
        return {"validation": self.validation, **self.tests}


@dataclass(frozen=True, slots=True, eq=False)
class ValidationPair:
    """One model on one recording: from set-points alone, and with measured motors (paper, section 7.4)."""

    free: Validation
    measured: Validation


def record_experiments(neck: NeckParameters, *, duration: float, tell: Tell) -> Experiments:
    """Record Eq. 22 for `duration` [s] and the three tests on a virtual neck."""
    report = tell("record on the virtual neck")
    recordings: dict[str, Recording] = {}
    for number, name in enumerate(("eq22", *TESTS)):
        report(number / 4, name)
        length = duration if name == "eq22" else None
        recordings[name] = record(signal(name, duration=length), VirtualNeck(neck), seed=_SEEDS[name])
    head, tail = recordings.pop("eq22").split(TRAIN)
    return Experiments(head, tail, recordings)


def identify(recording: Recording, *, iterations: int, seed: int, tell: Tell) -> dict[str, Model]:
    """Identify the paper's three models from one recording, and set membership's feed-forward form beside its own."""
    estimators = {
        "rls": Rls(),
        "nlsm": SetMembership(form="paper_eq21"),
        "nlsm_residual": SetMembership(form="residual"),
        "nn": Network(iterations=iterations, seed=seed),
    }
    return {name: estimator.fit(recording, progress=tell(f"identify {name}")) for name, estimator in estimators.items()}


def on_rough(*, duration: float, tell: Tell) -> dict[tuple[str, str], Validation]:
    """Identify rls and the feed-forward set membership anew on the preset `rough`, which a line follows no better than
    the paper's neck, and validate their free runs there."""
    experiments = record_experiments(
        NeckParameters.rough(), duration=duration, tell=lambda text: tell(f"{text}, preset rough")
    )
    estimators = {"rls": Rls(), "nlsm_residual": SetMembership(form="residual")}
    models = {
        name: estimator.fit(experiments.identification, progress=tell(f"identify {name}, preset rough"))
        for name, estimator in estimators.items()
    }
    return {
        (name, data): validate(model, recording, names=(name, data), horizons=(INFINITE,))
        for name, model in models.items()
        for data, recording in experiments.judged.items()
    }


def judge(
    models: Mapping[str, Model], experiments: Experiments, *, tell: Tell
) -> dict[tuple[str, str], ValidationPair]:
    """Validate every model on every recording it has not seen."""
    report = tell("validate")
    judged: dict[tuple[str, str], ValidationPair] = {}
    pairs = [(model, data) for model in models for data in experiments.judged]
    for number, (name, data) in enumerate(pairs):
        report(number / len(pairs), f"{name} on {data}")
        recording = experiments.judged[data]
        free = validate(models[name], recording, names=(name, data), horizons=(1, INFINITE))
        measured = validate(models[name], recording, names=(name, data), horizons=(INFINITE,), motors="measured")
        judged[name, data] = ValidationPair(free, measured)
    return judged
