"""Motors and outputs that a text is written for: a neck's, where its name says no others (see `_unrolled`)."""

MOTORS = 3
OUTPUTS = 2
