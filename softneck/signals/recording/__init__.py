"""Recordings: named channels over time, their files, resampling and scaling.

The data type of every other subpackage.
May import `robot` and below.
"""
