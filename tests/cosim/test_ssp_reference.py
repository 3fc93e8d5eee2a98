"""An SSP of the Modelica Reference FMUs, FMI 2.0 and 3.0 side by side.

They are in no registry: SOFTNECK_REFERENCE_FMUS names a folder with their sources' `2.0/*.fmu` and `3.0/*.fmu`.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from softneck.cosim import load_ssp, simulate, write_ssp

from .test_ssp_in import SPACES

FOLDER = Path(os.environ.get("SOFTNECK_REFERENCE_FMUS", "absent"))
STEP, END, K = 0.1, 2.0, 0.5
# The decay of one passes through the other, behind a line.
STRUCTURE = f"""<ssd:SystemStructureDescription {SPACES} version="1.0" name="Decay"><ssd:System name="root">
<ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="p">
  <ssv:Parameters><ssv:Parameter name="decay.k"><ssv:Real value="{K}"/></ssv:Parameter></ssv:Parameters>
</ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>
<ssd:Elements><ssd:Component name="decay" source="resources/Dahlquist.fmu"/>
<ssd:Component name="pass" source="resources/Feedthrough.fmu"/></ssd:Elements>
<ssd:Connections>
 <ssd:Connection startElement="decay" startConnector="x" endElement="pass" endConnector="Float64_continuous_input">
  <ssc:LinearTransformation factor="2" offset="-0.25"/></ssd:Connection></ssd:Connections>
<ssd:Annotations><ssc:Annotation type="softneck"><Master order="jacobi" stepSize="{STEP}"/></ssc:Annotation>
</ssd:Annotations></ssd:System><ssd:DefaultExperiment startTime="0" stopTime="{END}"/>
</ssd:SystemStructureDescription>"""


@pytest.mark.skipif(not FOLDER.is_dir(), reason="SOFTNECK_REFERENCE_FMUS names no folder")
@pytest.mark.parametrize(("one", "other"), [("2.0", "2.0"), ("2.0", "3.0"), ("3.0", "2.0"), ("3.0", "3.0")])
def test_reference_fmus_in_a_system(one: str, other: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "Decay.ssp", "w") as file:
        file.writestr("SystemStructure.ssd", STRUCTURE)
        file.write(FOLDER / one / "Dahlquist.fmu", "resources/Dahlquist.fmu")
        file.write(FOLDER / other / "Feedthrough.fmu", "resources/Feedthrough.fmu")
    write_ssp(load_ssp(tmp_path / "Decay.ssp"), tmp_path / "Again.ssp")
    for name in ("Decay", "Again"):
        result = simulate(load_ssp(tmp_path / f"{name}.ssp"))
        # Forward Euler over the FMU's own step of 0.1 s; what passes through arrives a step later.
        x = (1.0 - STEP * K) ** np.arange(result["decay.x"].size)
        np.testing.assert_allclose(result["decay.x"], x, rtol=1e-12)
        np.testing.assert_allclose(result["pass.Float64_continuous_output"][1:], 2.0 * x[:-1] - 0.25, rtol=1e-12)
