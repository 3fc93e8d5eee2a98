# %% [markdown]
# # A model as an FMU
#
# The FMU runs in any tool that knows FMI 2.0; its free run is that of the Python model.

# %%
import fmpy
import numpy as np

import softneck
from softneck.plant import NeckParameters
from softneck.signals import signal

neck = softneck.VirtualNeck(NeckParameters.paper())
recording = softneck.record(signal("eq22", duration=20.0), neck, seed=1)
model = softneck.identify("rls", recording)
path = softneck.build_fmu(model.block(), "Neck.fmu")
description = fmpy.read_model_description(str(path))
print(description.modelName, "FMI", description.fmiVersion, [v.name for v in description.modelVariables][:5])

# %% [markdown]
# Two runs from rest, over the same set-points.

# %%
inputs = np.zeros(len(recording), dtype=[("time", float), *((name, float) for name in recording.robot.set_points)])
inputs["time"] = recording.time
for column, name in enumerate(recording.robot.set_points):
    inputs[name] = recording.set_points[:, column]
ran = fmpy.simulate_fmu(
    str(path), input=inputs, output=["pitch"], output_interval=model.sample_time, stop_time=float(recording.time[-1])
)

# %%
state = model.initial_state(pitch_start=0.0, roll_start=0.0)
pitch = [0.0]
for row in recording.set_points[:-1]:
    state, outputs = model.step(state, row)
    pitch.append(outputs[0])
print(f"largest difference: {np.abs(ran['pitch'] - pitch).max():.1e} rad")
