"""The identified plant: one class for all kinds, its ports, drives, regressors and files.

What every kind shares, among it the runtimes of histories and drives.
May import `signals` and below; knows no single kind.
"""
