"""The recording: named channels over time, its files, resampling, scaling, trends, and Eq. 9-11.

What every other room means by data.
May import `robot` and below.
"""
