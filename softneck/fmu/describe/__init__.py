"""Model description, documentation and terminals of an FMU.

The same for both backends.
May import the subpackages that make blocks, but no backend.
"""
