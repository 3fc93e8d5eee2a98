"""What is wrong with a recording's channels, and what its inputs can teach a model.

Numbers first, then findings in the user's words.
May import `signals.recording`.
"""
