"""Adaptive control: gains that follow recursive least squares in the loop.

Each keeps the checks of the linear design it is made of.
May import `design.linear` and `design.plants`.
"""
