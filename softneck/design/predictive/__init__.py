"""Model predictive control, linear and nonlinear.

The QP is written once in CasADi; a runtime solves it in loops and FMUs.
May import `design.linear` and `design.plants`.
"""
