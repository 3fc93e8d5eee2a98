"""The pytest plugin: a `closed_loop` fixture for users' own tests; nothing heavy is imported until a test asks."""
