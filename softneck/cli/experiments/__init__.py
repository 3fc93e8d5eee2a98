"""Experiments: what to record next, and recordings of the virtual robot.

Methods live in the rooms below; here are options and tables.
May import `cli.shared`, `drives`, `identification`, `plant` and below.
"""
