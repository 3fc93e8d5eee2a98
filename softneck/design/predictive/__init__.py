"""Model predictive control: linear over transfer functions, nonlinear over networks and their like.

The QP is written once in CasADi; a runtime solves it in loops and FMUs.
May import `design.linear` and `design.plants`.
"""
