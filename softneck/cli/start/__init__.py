"""softneck start: from a log to a verdict in one run, each step a plain command.

`_plan` lists the commands, `_project_run` runs them and skips finished ones, `_start` asks and sums up.
May import what other subcommands import.
"""
