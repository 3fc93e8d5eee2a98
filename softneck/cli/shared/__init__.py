"""Code shared by subcommands: options, tables, progress, recordings and necks by name.

Prints; computes nothing.
May import `core`, `signals` and `plant`.
"""
