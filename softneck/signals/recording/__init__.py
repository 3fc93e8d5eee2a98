"""The recording: named channels over time, its files, resampling, scaling, trends, and Eq. 9-11.

The data type of every other subpackage.
May import `robot` and below.
"""
