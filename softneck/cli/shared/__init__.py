"""What several subcommands share: options, tables, progress, recordings and necks by name.

Prints; computes nothing.
May import `core`, `signals` and `plant`.
"""
