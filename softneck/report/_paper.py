"""The paper's own figures (Tables 3 and 4, section 7.4), for comparison like with like."""

from __future__ import annotations

Pair = tuple[float, float]

# One step ahead, measured outputs in the regressor: Tables 3 and 4, pitch and roll [%].
ONE_STEP: dict[tuple[str, str], Pair] = {
    ("nlsm", "validation"): (93.9794, 96.8854),
    ("nlsm", "steps"): (87.6260, 79.3195),
    ("nlsm", "sine"): (93.0012, 93.8389),
    ("nlsm", "rotation"): (90.2614, 96.7512),
    ("nn", "validation"): (99.0162, 99.2027),
    ("nn", "steps"): (97.9574, 98.5654),
    ("nn", "sine"): (98.1058, 98.3087),
    ("nn", "rotation"): (98.5191, 99.1767),
}
# Free runs: RLS in Tables 3 and 4 (section 7.4.1: no feedback in its regressor), from the set-points.
FREE_RUN: dict[tuple[str, str], Pair] = {
    ("rls", "validation"): (78.0448, 82.7217),
    ("rls", "steps"): (79.9230, 76.0284),
    ("rls", "sine"): (78.4813, 48.5090),
    ("rls", "rotation"): (63.1412, 83.2230),
}
# Section 7.4: free runs with measured motor positions.
FREE_RUN_MEASURED: dict[tuple[str, str], Pair] = {
    ("nlsm", "sine"): (60.0, 37.0),
    ("nlsm", "rotation"): (77.0, 86.5),
    ("nn", "sine"): (13.5, 60.0),
    ("nn", "rotation"): (58.0, 87.5),
}
# Eq. 31: K [deg/(rad s)], pole [1/s], dead time [s].
LINEAR: dict[str, tuple[float, float, float]] = {"pitch": (27.691, 5.293, 0.08), "roll": (25.424, 4.938, 0.08)}
