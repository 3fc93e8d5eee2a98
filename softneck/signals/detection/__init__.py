"""Change detection without I/O: whitening of residuals, cumulative sums, thresholds from undisturbed motion.

For drives, loops and models that adapt; nothing in it knows what the residuals are of.
May import `core`.
"""
