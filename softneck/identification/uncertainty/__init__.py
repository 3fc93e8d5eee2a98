"""What a model does not know: families over payload and inclination, ensembles, bounds on what is left over.

Uncertain linear plants for robust design come from here.
May import all kinds, but no validation.
"""
