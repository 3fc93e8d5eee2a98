"""The pytest plugin: a `closed_loop` fixture for users' own tests.

Nothing heavy is imported until a test asks.
May import `cosim` and below.
"""
