"""A trajectory of the motors, planned before anything moves, over a grey box of the virtual neck.

The neck is to nod and turn; motors have 6 rad/s, and no tendon may hang. Run it with
`python examples/planned_trajectory.py`.
"""

import math

import numpy as np

import softneck
from softneck.design.predictive import PlanSettings, plan
from softneck.identification import GreyBox
from softneck.loop import SineReference
from softneck.plant import NeckParameters
from softneck.signals import signal

recording = softneck.record(signal("eq22"), softneck.VirtualNeck(NeckParameters.paper()), seed=1)
model = GreyBox(evaluations=8).fit(recording.rows(0, 1500))

nod = SineReference(pitch=math.radians(12.0), roll=math.radians(6.0), frequency=0.3)
planned = plan(model, nod, duration=3.0, settings=PlanSettings(slew_limit=6.0, minimum_tautness=-0.2))

wanted = np.array([nod(float(t))[:2] for t in planned.time])
error = np.degrees(np.sqrt(np.mean((planned.angles - wanted) ** 2)))
furthest = np.abs(planned.set_points).max()
fastest = np.abs(np.diff(planned.set_points, axis=0)).max() / model.sample_time
print(f"{planned.status}: {error:.2f} deg rms from what was wanted, from rest on")
print(f"motors within {furthest:.2f} rad and {fastest:.2f} rad/s, tautness {planned.tautness:.2f} rad")

# What the neck can follow is the better reference of a loop.
reference = planned.reference()
print(f"after 1 s: pitch {math.degrees(reference(1.0)[0]):.1f} deg, co-contraction {reference(1.0)[2]:.2f} rad")
