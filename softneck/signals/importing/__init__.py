"""Foreign logs become recordings: formats, layouts, and layouts guessed from names and data.

A guess is always written down with its reason.
May import `signals.recording`.
"""
