"""From the paper's experiment on the virtual neck to an FMU, in ten lines."""

from softneck.fmu import build_fmu, fmu_info
from softneck.identification import Rls, validate
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.signals import signal

recording = record(signal("eq22"), VirtualNeck(NeckParameters.paper()), seed=1)
train, rest = recording.split(0.7)
model = Rls().fit(train)
print(model.summary())
print(validate(model, rest).fits)  # one step, 5 and 25 steps ahead, and the free run
build_fmu(model.block(), "build/Neck.fmu", info=fmu_info(model), force=True)
