"""Model uncertainty: families over payload and inclination, frequency responses, guarded models.

Uncertain linear plants for robust design come from here.
May import all kinds, but no validation.
"""
