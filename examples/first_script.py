"""From the paper's experiment on the virtual neck to a controller and an FMU, in ten lines."""

import softneck
from softneck.plant import NeckParameters
from softneck.signals import signal

recording = softneck.record(signal("eq22"), softneck.VirtualNeck(NeckParameters.paper()), seed=1)
train, rest = recording.split(0.7)
model = softneck.identify("rls", train)
print(model.summary())
print(softneck.validate(model, rest).fits)  # one step, 5 and 25 steps ahead, and the free run
controller = softneck.design_controller("pi", model)
print(controller.summary())
softneck.build_fmu(model.block(), "build/Neck.fmu", force=True)
