"""Derivatives of the kinds' steps, by which nonlinear predictive control linearises.

One runtime a kind: `tangent` beside the kind's own `step`.
May import runtimes only.
"""
