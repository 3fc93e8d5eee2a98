"""softneck start: from a log to a verdict in one sitting, each step a plain command.

`_plan` says which commands, `_sitting` runs them and knows which are done, `_start` asks and sums up.
May import what other subcommands import.
"""
