"""Change detection beside a loop: is this still the neck that the model was identified from?

A kind of observer with file and FMU; its numbers come from undisturbed motion.
May import the rest of `estimation` and below.
"""
