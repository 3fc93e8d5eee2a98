"""Experiments: what to record next, recordings of the virtual robot, and models that follow new ones.

Methods live in the rooms below; here are options and tables.
May import `cli.shared`, `drives`, `identification`, `plant` and below.
"""
