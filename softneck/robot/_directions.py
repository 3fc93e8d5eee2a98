"""Directions: which outputs a robot's motors move, and how the motors share the work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from softneck.core import Matrix, SettingsError, require_one_of

KINDS = ("tendons", "identified", "matrix")
# Below this two tendons nearly coincide, and moving along the axis would need huge motor angles.
_MIN_SINGULAR_VALUE = 1e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class Directions:
    """Directions in which motors move outputs: each output follows a weighted sum of the motors.

    Attributes:
        kind: "tendons" (by their angles around the axis), "matrix" (as given), "identified" (learned from data).
        angles_deg: (motors,) angles of the tendons [deg]; 0 bends the first output, 90 the second.
        matrix: (outputs, motors) weights.
        names: of the redefined inputs, one for each output and one for co-contraction; `{output}_input` if not given.
    """

    kind: str
    angles_deg: tuple[float, ...] = ()
    matrix: tuple[tuple[float, ...], ...] = ()
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_one_of("directions.kind", self.kind, KINDS)
        for key, needed in (("angles_deg", "tendons"), ("matrix", "matrix")):
            given = bool(getattr(self, key))
            if given != (self.kind == needed):
                rule = "needs" if self.kind == needed else "takes no"
                raise SettingsError(f'`directions` of kind = "{self.kind}" {rule} `{key}`.')

    def weights(self) -> Matrix | None:
        """Return the weights (outputs, motors), up to two rows for tendons; None where they are to be identified.

        Tendons: cos and sin of their angles, the paper's theta_i and phi_i (Eq. 4, 5).
        """
        if self.kind == "identified":
            return None
        if self.kind == "matrix":
            return np.array(self.matrix, dtype=np.float64)
        gamma = np.radians(self.angles_deg)
        rows = np.array([np.cos(gamma), np.sin(gamma)])
        rows[np.abs(rows) < 1e-15] = 0.0
        return rows

    def check(self, motors: int, outputs: int) -> None:
        """Raise SettingsError unless the directions have these numbers of motors and outputs, and span the outputs."""
        self._check_weights(motors, outputs)
        if self.names and len(self.names) != outputs + 1:
            raise SettingsError(
                f"`directions.names` must name {outputs} redefined input(s) and co-contraction; got {len(self.names)}."
            )

    def _check_weights(self, motors: int, outputs: int) -> None:
        if self.kind == "identified":
            return
        if self.kind == "tendons":
            self._check_angles(motors, outputs)
        elif len(self.matrix) != outputs or any(len(row) != motors for row in self.matrix):
            got = f"{len(self.matrix)} x {'/'.join(str(n) for n in sorted({len(row) for row in self.matrix}))}"
            raise SettingsError(f"`directions.matrix` must be outputs x motors, {outputs} x {motors}; got {got}.")
        weights = self.weights()
        if weights is None:
            return
        if (
            np.linalg.svd(weights[:outputs], compute_uv=False)[min(outputs, motors) - 1] < _MIN_SINGULAR_VALUE
            or motors < outputs
        ):
            what = f"tendons at {', '.join(f'{a:g}' for a in self.angles_deg)} deg" if self.angles_deg else "the matrix"
            raise SettingsError(
                f'`directions`: {what} cannot span {outputs} output(s); fix them, or write kind = "identified".'
            )

    def _check_angles(self, motors: int, outputs: int) -> None:
        if len(self.angles_deg) != motors:
            raise SettingsError(f"`directions.angles_deg` holds {len(self.angles_deg)} angles for {motors} motor(s).")
        if outputs > 2:
            raise SettingsError(
                f'`directions`: tendons bend 2 outputs at most, and there are {outputs}; use "identified" or "matrix".'
            )
