"""The necks on which nothing is ever chosen: no default, threshold, limit, nor anything that a script tries out.

They were picked before any of them had been run. Tables may show them beside the others once a choice is made;
`test_held_out.py` keeps their names out of what chooses.
"""

HELD_OUT = ("beam", "twisted")
