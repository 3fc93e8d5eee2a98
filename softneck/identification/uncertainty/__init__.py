"""What a model does not know: families over payload and inclination, guarded models.

Uncertain linear plants for robust design come from here.
May import all kinds, but no validation.
"""
