"""Kind `guarded`: several models of one kind, and a base that takes over where they part or know nothing."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from softneck.core import (
    DataError,
    Matrix,
    Progress,
    SettingsError,
    find_kind,
    require_one_of,
    require_positive,
    require_whole,
    silent,
)
from softneck.core._blas_threads import one_blas_thread
from softneck.signals import Recording

from ..models._arrays import COMPOSED, memory_of, prefixed_arrays
from ..models._fitting import row_hashes, training_recording
from ..models._jobs import Job, done
from ..models._model import Model
from ..models._ports import trained_set_points
from ..models._validity import grounded
from ..networks._network import Network
from ..networks._state_space_network import NeuralStateSpace
from ..set_membership._set_membership import SetMembership
from ..structured._play import Play
from ._guarded_base import BASES, Base, base_or_reason, fitted_base
from ._left_out import left_out

OF = ("nn", "nss", "play", "nlsm")
# Those that take long enough for processes of their own to be worth starting.
_LONG = ("nn", "nss")
# Weight decays of `nn`, one after the other over the members, as over the starts of one network.
_DECAYS = (0.03, 0.1, 0.01)
# Motor positions that stand for all that were seen.
_SEEN = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Guarded:
    """Members of one learned kind that fade to a base where they part, or where the motors leave what was seen.

    Each member starts differently, with one start of its own, and leaves out another block of the recordings, on which
    it is chosen. The base is trained on all rows, and its error judged on blocks left out. All run free by themselves;
    their outputs are blended by weights of inverse variance that move at a limited rate.

    Attributes:
        of: kind of the members: "nn", "nss", "play" or "nlsm" (in its form `residual`, which can run free).
        members: how many.
        base: kind to fall back to; None takes `greybox` or `oe`, whichever misses less on blocks left out.
        agreement: weight of the squared spread of the members beside the base's squared error.
        unseen: how fast the members' error is taken to grow beyond what was seen, in spreads of the output a spread of
            the motors.
        fade: time in which the weight can go from members to base [s].
        seed: of the first member; the next have the next seeds.
        workers: processes to train `nn` and `nss` in; None takes all cores, 1 none. It changes no result.
    """

    of: str = "nn"
    members: int = 5
    base: str | None = None
    agreement: float = 0.25
    unseen: float = 0.1
    fade: float = 0.3
    seed: int = 0
    workers: int | None = None

    def __post_init__(self) -> None:
        require_one_of("of", self.of, OF)
        require_whole("members", self.members, 2, 20)
        if self.base is not None:
            find_kind(self.base, "model")
            if self.base in (*COMPOSED, "nlsm"):
                raise SettingsError(f"a model of kind `{self.base}` cannot be a base; take {' or '.join(BASES)}.")
        require_positive("agreement", self.agreement)
        require_positive("unseen", self.unseen)
        require_positive("fade", self.fade, "s")
        require_whole("seed", self.seed, 0, 2**62)
        if self.workers is not None:
            require_whole("workers", self.workers, 1, 1000)

    @one_blas_thread
    def fit(self, recordings: Recording | list[Recording], *, progress: Progress = silent) -> Model:
        """Identify base and members; Ctrl-C ends it without a model.

        Raises:
            DataError: what a member raises, or no base that fits.
        """
        recording = training_recording(recordings, any_robot=True)
        jobs = [Job("base", base_or_reason, (kind, recording)) for kind in BASES]
        if self.base is not None:
            jobs = [Job("base", fitted_base, (self.base, recording))]
        wanted = len(jobs)
        for number, (rest, part) in enumerate(left_out(recording, self.members)):
            jobs.append(Job(f"member {number + 1}", _member, (self.of, self.seed + number, rest, part)))
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        workers = 1 if self.of not in _LONG else min(self.workers or cores, len(jobs))
        found = done(jobs, workers, progress)
        model = self.around(_least_missing(found[:wanted]), found[wanted:], recording)
        progress(1.0, "done")
        return model

    def around(self, base: Base, members: list[Model], recording: Recording) -> Model:
        """Return the guarded model of a base and members that are there already."""
        robot, Ts = recording.robot, recording.sample_time
        outputs, motors = len(robot.outputs.names), len(robot.motors.names)
        M = base.model.simulate(recording)[:, outputs : outputs + motors]
        seen, reach = covering(M, _SEEN)
        parts = [base.model, *members]
        arrays = {
            "history": np.array([1.0] if robot.is_neck else [1.0, outputs, motors]),
            "memory": np.array([float(max(memory_of(part.arrays) for part in parts))]),
            "sigma": base.error,
            "slope": self.unseen * np.nanstd(recording.outputs, axis=0) / np.sqrt(np.mean(M.var(axis=0))),
            "fading": np.array([self.agreement, Ts / self.fade]),
            "seen": seen,
            "reach": np.array([reach]),
            **prefixed_arrays([(part.kind, part.arrays) for part in parts]),
        }
        findings: dict[str, Any] = {
            "members": f"{len(members)} of {members[0].kind}",
            "base": base.model.kind,
            "base_fit_left_out": base.fit.tolist(),
            **({"remark": base.remark} if base.remark else {}),
            **trained_set_points(recording),
        }
        model = Model(
            kind="guarded",
            sample_time=Ts,
            arrays=arrays,
            settings=asdict(replace(self, base=base.model.kind, workers=None)),
            findings=findings,
            training_rows=row_hashes(recording),
            robot=robot,
        )
        return grounded(model, recording)


def _member(kind: str, seed: int, rest: Recording, part: Recording) -> Model:
    """Return one member; `part` is what it is chosen on, or left out."""
    if kind == "nn":
        # The members are each other's starts: one of its own costs each a third of what a network alone takes.
        # No prior: where nothing was recorded they are to part.
        settings = Network(seed=seed, starts=1, iterations=20, decay=_DECAYS[seed % len(_DECAYS)], prior=0.0)
        return settings.fit(rest, hold_out=part)
    if kind == "nss":
        return NeuralStateSpace(seed=seed, starts=1).fit(rest, hold_out=part)
    return (Play() if kind == "play" else SetMembership(form="residual")).fit(rest)


def _least_missing(found: list[Base | str]) -> Base:
    """Return the base of the least error on rows left out."""
    bases = [base for base in found if isinstance(base, Base) and np.isfinite(base.error).all()]
    if not bases:
        reasons = "; ".join(base if isinstance(base, str) else f"{base.model.kind} diverges" for base in found)
        raise DataError(f"there is no base to fall back to: {reasons}. Record with more excitation, or set `base`.")
    return max(bases, key=lambda base: float(base.fit.mean()))


def covering(points: Matrix, most: int) -> tuple[Matrix, float]:
    """Return at most so many of the points (rows, n), and how far any is from the nearest of them.

    Each is the one farthest from those before (Gonzalez 1985), so that no part is left out for being rare.
    """
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most and distance.max() > 0.0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.ascontiguousarray(points[chosen]), float(distance.max())
