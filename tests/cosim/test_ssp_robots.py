"""The system description of a robot's parts: connectors by its channels, pressures in SI base units."""

from __future__ import annotations

from xml.etree import ElementTree

from softneck.cosim.ssp._description import Component, system_description
from softneck.runtime import Port

SSD = "{http://ssp-standard.org/SSP1/SystemStructureDescription}"
SSC = "{http://ssp-standard.org/SSP1/SystemStructureCommon}"


def test_pressures_and_lengths_are_connectors_with_units() -> None:
    inputs = tuple(Port(name=f"motor_setpoint_{j}", unit="Pa") for j in (1, 2))
    plant = Component("plant", "resources/plant.fmu", inputs, (Port(name="level", unit="m"),), ())
    root = ElementTree.fromstring(system_description("tank", [plant], [], step=0.02, duration=1.0))
    names = [item.get("name") for item in root.iter(f"{SSD}Connector")]
    assert names == ["motor_setpoint_1", "motor_setpoint_2", "level"]
    units = {unit.get("name"): unit[0].attrib for unit in root.iter(f"{SSC}Unit")}
    assert units == {"Pa": {"kg": "1", "m": "-1", "s": "-2"}, "m": {"m": "1"}}
