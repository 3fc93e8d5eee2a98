"""Honest validation: simulation beside persistence and the best linear model, on rows not trained on.

Residual tests, noise ceiling, confidence of scores.
May import the kinds; no kind imports it.
"""
