"""The uncertain plant of a design: nominal, samples, the test that every design is held to.

Plants only; nothing here knows a controller's kind.
May import `estimation` and below.
"""
