"""The pytest plugin: a `closed_loop` fixture for users' own tests.

Heavy modules are imported when a test uses the fixture.
May import `cosim` and below.
"""
