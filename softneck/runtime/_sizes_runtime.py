"""Numbers of motors and outputs that a text is generated for; the neck's unless its name has others (`_unrolled`)."""

MOTORS = 3
OUTPUTS = 2
