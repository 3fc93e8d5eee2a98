"""SSP archives of any tool: nested systems, lines, units, values and mappings mean what the standard says."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from softneck.cli._main import run
from softneck.core import FileFormatError, SettingsError, SoftneckError
from softneck.cosim import FmuPart, load_loop, load_ssp, simulate, study, write_ssp
from softneck.cosim.loops._loop_file import LoopSetup
from softneck.cosim.ssp._parse import Affine, Binding, Component, Connection, Structure, SystemNode, Value
from softneck.cosim.ssp._read import Flat, Line, Ports, flatten
from softneck.loop._loop import System
from softneck.runtime import Port

from ._foreign import build_foreign

SPACES = " ".join(
    f'xmlns:{short}="http://ssp-standard.org/SSP1/SystemStructure{name}"'
    for short, name in (
        ("ssd", "Description"), ("ssc", "Common"), ("ssv", "ParameterValues"), ("ssm", "ParameterMapping"),
    )
)  # fmt: skip
STEP, END = 0.1, 1.0
# Two of the same FMU, the second in a system of its own behind connectors in rad; `alpha` is in deg.
ELEMENTS = """
<ssd:Component name="first" source="resources/F.fmu">
  <ssd:ParameterBindings>
    <ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="own"><ssv:Parameters>
      <ssv:Parameter name="k"><ssv:Real value="4"/></ssv:Parameter>
      <ssv:Parameter name="u1"><ssv:Real value="1"/></ssv:Parameter>
      <ssv:Parameter name="u3"><ssv:Real value="0.3"/></ssv:Parameter>
      <ssv:Parameter name="nobody"><ssv:Real value="3"/></ssv:Parameter>
    </ssv:Parameters></ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding>
    <ssd:ParameterBinding source="resources/late.ssv">
      <ssd:ParameterMapping><ssm:ParameterMapping version="1.0">
        <ssm:MappingEntry source="lag" target="T"><ssc:LinearTransformation factor="2" offset="0.1"/></ssm:MappingEntry>
      </ssm:ParameterMapping></ssd:ParameterMapping>
    </ssd:ParameterBinding>
  </ssd:ParameterBindings>
</ssd:Component>
<ssd:System name="inner">
  <ssd:Connectors>
    <ssd:Connector name="turn" kind="input"><ssc:Real unit="rad"/></ssd:Connector>
    <ssd:Connector name="gain" kind="parameter"><ssc:Real/></ssd:Connector>
  </ssd:Connectors>
  <ssd:ParameterBindings>
    <ssd:ParameterBinding prefix="se.cond."><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="low">
      <ssv:Parameters><ssv:Parameter name="T"><ssv:Real value="9"/></ssv:Parameter></ssv:Parameters>
    </ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding>
  </ssd:ParameterBindings>
  <ssd:Elements><ssd:Component name="se.cond" source="resources/F.fmu"/></ssd:Elements>
  <ssd:Connections>
    <ssd:Connection startConnector="turn" endElement="se.cond" endConnector="u1">
      <ssc:LinearTransformation factor="3" offset="0.5"/></ssd:Connection>
    <ssd:Connection startConnector="gain" endElement="se.cond" endConnector="k"/>
  </ssd:Connections>
</ssd:System>
"""
CONNECTIONS = """
<ssd:Connection startElement="first" startConnector="alpha" endElement="inner" endConnector="turn"/>
<ssd:Connection startElement="first" startConnector="beta" endElement="first" endConnector="u2"
  suppressUnitConversion="true"/>
"""
# Values of the outermost system win over those below.
OUTER = """
<ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="outer"><ssv:Parameters>
  <ssv:Parameter name="inner.se.cond.T"><ssv:Real value="250" unit="ms"/></ssv:Parameter>
  <ssv:Parameter name="inner.gain"><ssv:Real value="7"/></ssv:Parameter>
</ssv:Parameters></ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding>
"""
LATE = f"""<ssv:ParameterSet {SPACES} version="1.0" name="late"><ssv:Parameters>
<ssv:Parameter name="lag"><ssv:Real value="0.2"/></ssv:Parameter>
<ssv:Parameter name="k"><ssv:Real value="99"/></ssv:Parameter></ssv:Parameters></ssv:ParameterSet>"""


def ssd(elements: str = ELEMENTS, connections: str = CONNECTIONS, outer: str = OUTER, *, version: str = "1.0") -> str:
    """Return the text of a structure."""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription {SPACES} version="{version}" name="Nested">
<ssd:System name="root"><ssd:ParameterBindings>{outer}</ssd:ParameterBindings>
<ssd:Elements>{elements}</ssd:Elements><ssd:Connections>{connections}</ssd:Connections>
<ssd:Annotations><ssc:Annotation type="softneck"><Master order="jacobi" stepSize="{STEP}"/></ssc:Annotation>
</ssd:Annotations></ssd:System>
<ssd:DefaultExperiment startTime="0" stopTime="{END}"/></ssd:SystemStructureDescription>"""


@pytest.fixture(scope="module", params=[2, 3], ids=["FMI 2", "FMI 3"])
def foreign(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_foreign(tmp_path_factory.mktemp("foreign"), request.param)


def archive(folder: Path, fmu: Path | None, text: str, more: Mapping[str, bytes] | None = None) -> Path:
    path = folder / "Nested.ssp"
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("SystemStructure.ssd", text)
        file.writestr("resources/late.ssv", LATE)
        if fmu is not None:
            file.write(fmu, "resources/F.fmu")
        for name, data in (more or {}).items():
            file.writestr(name, data)
    return path


def by_hand(fmu: Path) -> np.ndarray:
    """Return (rows, 4) alpha and beta of both FMUs: all inputs set, then all stepped."""
    first, second = (FmuPart(fmu, role="plant", sample_time=STEP) for _ in range(2))
    with first, second:
        one = first.start(0.0, {"k": 4.0, "T": 2 * 0.2 + 0.1})
        two = second.start(0.0, {"k": 7.0, "T": 0.25})
        rows = []
        for i in range(round(END / STEP)):
            rows.append([*one[:2], *two[:2]])
            u, v = np.array([1.0, one[1], 0.3]), np.array([3.0 * np.deg2rad(one[0]) + 0.5, 0.0, 0.0])
            one, two = first.advance(i * STEP, u), second.advance(i * STEP, v)
        return np.array(rows)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_nested_systems_lines_units_and_values(foreign: Path, version: str, tmp_path: Path) -> None:
    system = load_ssp(archive(tmp_path, foreign, ssd(version=version)))
    assert isinstance(system, System)
    result = simulate(system)
    names = [f"{part}.{axis}" for part in ("first", "inner_se_cond") for axis in ("alpha", "beta")]
    shown = np.rad2deg(np.column_stack([result[name] for name in names]))
    # Five numbers of one line come together in another order: rounding, on values of up to ten degrees.
    np.testing.assert_allclose(shown, by_hand(foreign), rtol=0, atol=1e-13)
    assert np.abs(shown[-1, :3]).min() > 1e-3, "nothing moves: the test shows nothing"


def test_a_step_is_given_where_nothing_states_one(foreign: Path, tmp_path: Path) -> None:
    stated = ssd()
    silent = re.sub("<ssd:Annotations>.*</ssd:Annotations>", "", stated, flags=re.DOTALL)
    assert silent != stated
    with pytest.raises(SettingsError, match="has a step size; give one in s, for instance `--step"):
        load_ssp(archive(tmp_path, foreign, silent))
    expected = simulate(load_ssp(archive(tmp_path, foreign, stated)))
    given = simulate(load_ssp(archive(tmp_path, foreign, silent), step=STEP))
    finer = simulate(load_ssp(archive(tmp_path, foreign, stated), step=STEP / 2))
    for name, values in expected.signals.signals.items():
        np.testing.assert_array_equal(given[name], values)
    assert len(finer.signals.time) == 2 * len(expected.signals.time)
    with pytest.raises(SettingsError, match="`step` must be a finite number"):
        load_ssp(archive(tmp_path, foreign, stated), step=float("nan"))


def test_what_was_read_is_written_again(foreign: Path, tmp_path: Path) -> None:
    first = load_ssp(archive(tmp_path, foreign, ssd()))
    again = load_ssp(write_ssp(first, tmp_path / "again.ssp"))
    a, b = simulate(first), simulate(again)
    assert list(a.signals.signals) == list(b.signals.signals)
    for name in a.signals.signals:
        np.testing.assert_array_equal(a[name], b[name])


def test_a_loop_of_ours_comes_back(loop_file: Path, tmp_path: Path) -> None:
    loop_file.write_text('order = "jacobi"\n' + loop_file.read_text())
    setup = load_loop(loop_file)
    path = write_ssp(setup, tmp_path / "Loop.ssp", compiled=False)
    back = load_ssp(path)
    assert isinstance(back, LoopSetup)
    assert set(back.files) == {"ssp"}
    ours, theirs = simulate(setup), simulate(back)
    assert ours.signals.signals.keys() == theirs.signals.signals.keys()
    for name in ours.signals.signals:
        np.testing.assert_array_equal(ours[name], theirs[name])
    assert theirs.metrics == ours.metrics
    twice = load_ssp(write_ssp(back, tmp_path / "Twice.ssp", compiled=False))
    np.testing.assert_array_equal(simulate(twice)["pitch"], ours["pitch"])
    with zipfile.ZipFile(path) as a, zipfile.ZipFile(tmp_path / "Twice.ssp") as b:
        assert a.namelist() == b.namelist()


def test_a_loop_file_takes_lines_on_connections(loop_file: Path) -> None:
    line = '[connections]\n"controller.pitch_reference" = { from = "reference.pitch_reference", factor = 0.5 }\n'
    half = loop_file.with_name("half.toml")
    half.write_text(loop_file.read_text() + line)
    small = loop_file.with_name("small.toml")
    small.write_text(loop_file.read_text().replace("pitch_deg = 15.0", "pitch_deg = 7.5"))
    # Half of the same number of radians.
    np.testing.assert_allclose(simulate(half)["pitch"], simulate(small)["pitch"], rtol=0, atol=1e-15)


def test_the_commands(loop_file: Path, foreign: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = archive(tmp_path, foreign, ssd())
    assert run(["simulate", str(path), "-o", str(tmp_path / "out.csv")]) == 0
    head = (tmp_path / "out.csv").read_text().splitlines()[0]
    assert head == "time [s],first.alpha [deg],first.beta [deg],inner_se_cond.alpha [deg],inner_se_cond.beta [deg]"
    assert run(["fmu", str(path), "-o", str(tmp_path / "b.ssp")]) == 0
    # The loop's own order is sequential, in which its overshoot holds the limit; an archive has neither.
    loop = write_ssp(load_loop(loop_file), tmp_path / "Loop.ssp", compiled=False)
    assert run(["simulate", str(loop), "-o", str(tmp_path / "loop.csv"), "--json"]) == 0
    assert '"overshoot_pct"' in capsys.readouterr().out


CONNECTORS = "".join(
    f'<ssd:Connector name="{name}" kind="{kind}"><ssc:Real unit="{unit}"/></ssd:Connector>'
    for name, kind, unit in (("u1", "input", "rad"), ("u2", "input", "rad"), ("alpha", "output", "deg"))
)
# What pyssp_standard 0.9.1 writes: types and no implementations, the set and its mapping in files, folders as members.
THEIRS = f"""<?xml version='1.0' encoding='utf-8'?>
<ssd:SystemStructureDescription {SPACES} version="1.0" name="Two" generationTool="pyssp_standard">
<ssd:System name="root"><ssd:ParameterBindings><ssd:ParameterBinding source="resources/values.ssv">
<ssd:ParameterMapping source="resources/map.ssm"/></ssd:ParameterBinding></ssd:ParameterBindings><ssd:Elements>
<ssd:Component name="first" type="application/x-fmu-sharedlibrary" source="resources/F.fmu">
<ssd:Connectors>{CONNECTORS}</ssd:Connectors></ssd:Component>
<ssd:Component name="second" type="application/x-fmu-sharedlibrary" source="resources/F.fmu">
<ssd:Connectors>{CONNECTORS}</ssd:Connectors></ssd:Component></ssd:Elements>
<ssd:Connections><ssd:Connection startElement="first" startConnector="alpha" endElement="second" endConnector="u1"/>
</ssd:Connections>{{}}</ssd:System><ssd:DefaultExperiment startTime="0.0" stopTime="{END}"/>
</ssd:SystemStructureDescription>"""
VALUES = f"""<ssv:ParameterSet {SPACES} version="1.0" name="values"><ssv:Parameters>
<ssv:Parameter name="gain"><ssv:Real value="4.0" unit=""/></ssv:Parameter>
<ssv:Parameter name="lag"><ssv:Real value="250.0" unit="ms"/></ssv:Parameter>
<ssv:Parameter name="one"><ssv:Real value="1.0" unit=""/></ssv:Parameter></ssv:Parameters></ssv:ParameterSet>"""
MAPPING = f"""<ssm:ParameterMapping {SPACES} version="1.0"><ssm:MappingEntry target="first.k" source="gain"/>
<ssm:MappingEntry target="second.T" source="lag"/><ssm:MappingEntry target="first.u1" source="one"/>
</ssm:ParameterMapping>"""
MASTER = f'''<ssd:Annotations><ssc:Annotation type="softneck">
<Master order="jacobi" stepSize="{STEP}"/></ssc:Annotation>
</ssd:Annotations>'''


def test_an_archive_of_another_writer(foreign: Path, tmp_path: Path) -> None:
    more = {"resources/": b"", "resources/values.ssv": VALUES.encode(), "resources/map.ssm": MAPPING.encode()}
    with pytest.raises(SettingsError, match="has a step size; give one in s, for instance `--step"):
        load_ssp(archive(tmp_path, foreign, THEIRS.format(""), more))
    result = simulate(load_ssp(archive(tmp_path, foreign, THEIRS.format(MASTER), more)))
    alpha, beta = 0.0, 0.0
    for k, (first, second) in enumerate(zip(result["first.alpha"], result["second.alpha"], strict=True)):
        # dx/dt = (k u - x) / T by forward Euler, in deg; the second is driven by the first's angle in rad.
        assert (np.rad2deg(first), np.rad2deg(second)) == pytest.approx((alpha, beta), abs=1e-12), k
        alpha, beta = alpha + STEP / 0.5 * (4.0 - alpha), beta + STEP / 0.25 * (10.0 * np.deg2rad(alpha) - beta)


COMPONENT = '<ssd:Component name="a" source="resources/F.fmu">{}</ssd:Component>'
LINK = '<ssd:Connection startElement="a" startConnector="{}" endElement="a" endConnector="{}"/>'
STRING = """<ssd:ParameterBindings><ssd:ParameterBinding><ssd:ParameterValues><ssv:ParameterSet><ssv:Parameters>
<ssv:Parameter name="k"><ssv:Enumeration value="x"/></ssv:Parameter></ssv:Parameters></ssv:ParameterSet>
</ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"""
UNIT = '<ssd:Connectors><ssd:Connector name="u1" kind="input"><ssc:Real unit="{}"/></ssd:Connector></ssd:Connectors>'
DEEP, FLAT = '<ssd:System name="x"><ssd:Elements>', "</ssd:Elements></ssd:System>"
BASE = '<ssd:Units><ssc:Unit name="q"><ssc:BaseUnit m="{}" factor="{}"/></ssc:Unit></ssd:Units>'
# A system that passes on what it is given, fed by itself: no FMU is in the circle.
PASSES = """<ssd:System name="x"><ssd:Connectors><ssd:Connector name="a" kind="input"><ssc:Real/></ssd:Connector>
<ssd:Connector name="b" kind="output"><ssc:Real/></ssd:Connector></ssd:Connectors>
<ssd:Connections><ssd:Connection startConnector="a" endConnector="b"/></ssd:Connections></ssd:System>"""
TURNED = PASSES.replace('startConnector="a" endConnector="b"', 'startConnector="b" endConnector="a"')
CIRCLE = """<ssd:Connection startElement="x" startConnector="b" endElement="x" endConnector="a"/>
<ssd:Connection startElement="x" startConnector="b" endElement="a" endConnector="u1"/>"""
BOMB = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]><x>&b;</x>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (BOMB, "DOCTYPE"),
        ("<x/>", "no SSP 1.0 or 2.0"),
        (ssd(version="3.0"), "no SSP 1.0 or 2.0"),
        ("not xml", "no valid XML"),
        (ssd("<ssd:SignalDictionaryReference name='d'/>", ""), "SignalDictionaryReference `d`"),
        (ssd(COMPONENT.replace("F.fmu", "../../etc.fmu").format(""), ""), "outside the archive"),
        (ssd(COMPONENT.replace("F.fmu", "G.fmu").format(""), ""), "no member `resources/G.fmu`"),
        (ssd('<ssd:Component name="a" source="x.ssd" type="application/x-ssp-definition"/>', ""), "component `a`"),
        (ssd(COMPONENT.format(""), LINK.format("alpha", "u9")), "`a.u9`, which is not there"),
        (ssd(COMPONENT.format(""), LINK.format("alpha", "u1") * 2), "`a.u1` has two writers"),
        (ssd(COMPONENT.format(""), LINK.format("u2", "u1")), "`a.u2` to `a.u1`"),
        (ssd(COMPONENT.format(""), LINK.format("u1", "alpha")), "`a.u1` to `a.alpha` against direction"),
        (
            ssd(COMPONENT.format("") + PASSES.replace('"a" end', '"b" end').replace('r="b"/', 'r="a"/'), ""),
            "against dir",
        ),
        (ssd(COMPONENT.format("") + PASSES, CIRCLE), "connects `x.b` to itself"),
        (ssd(COMPONENT.format(UNIT.format("parsec")), LINK.format("alpha", "u1")), "unknown unit `parsec`"),
        (ssd(COMPONENT.format(UNIT.format("kg")), LINK.format("alpha", "u1")), "these units do not fit"),
        (ssd(COMPONENT.format(STRING), ""), "Enumeration `x`"),
        (ssd("", ""), "no components"),
        (ssd(COMPONENT.format(""), "").replace('stepSize="0.1"', 'stepSize="soon"'), "stepSize = `soon`"),
        (ssd(COMPONENT.format(""), "").replace('stepSize="0.1"', 'stepSize="nan"'), "no finite number"),
        (ssd(COMPONENT.format(""), "").replace('stepSize="0.1"', 'stepSize="0"'), "must be positive"),
        (ssd(COMPONENT.format(""), "").replace('stopTime="1.0"', 'stopTime="inf"'), "stopTime = `inf`"),
        (ssd(COMPONENT.format(""), "").replace('stopTime="1.0"', 'stopTime="0"'), "begins at 0 s"),
        (ssd(COMPONENT.format(""), "").replace('startTime="0"', 'startTime="0.5"'), "softneck's runs begin at 0 s"),
        (ssd().replace('factor="3"', 'factor="nan"'), "factor = `nan`"),
        (ssd().replace('value="4"', 'value="inf"'), "k = `inf`"),
        (ssd(COMPONENT.format("") * 2, ""), "two elements `a`"),
        (ssd(COMPONENT.replace('name="a"', "").format(""), ""), "a nameless element"),
        (ssd(DEEP * 3000 + FLAT * 3000, ""), "more than 50"),
        (ssd(COMPONENT.replace("F.fmu", "a" * 5000).format(""), ""), "has no member"),
        (ssd(COMPONENT.format(""), "").replace("<ssd:Def", f"{BASE.format('inf', '1')}<ssd:Def"), "m = `inf`"),
        (ssd(COMPONENT.format(""), "").replace("<ssd:Def", f"{BASE.format('1', '0')}<ssd:Def"), "`q` of factor 0"),
    ],
)
def test_what_cannot_be_run_is_named(text: str, words: str, foreign: Path, tmp_path: Path) -> None:
    path = archive(tmp_path, foreign, text)
    with pytest.raises(SoftneckError) as error:
        load_ssp(path)
    assert words in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


LISTED = {  # u3 becomes an item of a list
    "0": (
        "<ModelVariables>",
        '<TypeDefinitions><SimpleType name="Mode"><Enumeration><Item name="off" value="0"/><Item name="on" value="1"/>'
        "</Enumeration></SimpleType></TypeDefinitions><ModelVariables>",
        '<TypeDefinitions><EnumerationType name="Mode"><Item name="off" value="0"/><Item name="on" value="1"/>'
        "</EnumerationType></TypeDefinitions><ModelVariables>",
    ),
    "2": (
        '<ScalarVariable name="u3" valueReference="2" causality="input"><Real start="0"/>',
        '<ScalarVariable name="u3" valueReference="2" causality="input"><Enumeration declaredType="Mode" start="0"/>',
    ),
    "3": (
        '<Float64 name="u3" valueReference="2" causality="input" start="0"/>',
        '<Enumeration name="u3" valueReference="2" causality="input" declaredType="Mode" start="0"/>',
    ),
}


def _with_list(foreign: Path, folder: Path) -> Path:
    """Return the FMU with an enumeration for `u3`: the same binary."""
    path = folder / "Listed.fmu"
    version = foreign.stem[-1]
    before, *after = LISTED["0"]
    with zipfile.ZipFile(foreign) as old, zipfile.ZipFile(path, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            if name == "modelDescription.xml":
                text = data.decode().replace(before, after[int(version) - 2]).replace(*LISTED[version])
                assert text.count("numeration") >= 3
                data = text.encode()
            new.writestr(name, data)
    return path


@pytest.mark.parametrize("said", ["", '<ssd:Connector name="u3" kind="input"><ssc:Integer/></ssd:Connector>'])
def test_an_enumeration_of_an_fmu_is_connected_to_nothing(said: str, foreign: Path, tmp_path: Path) -> None:
    # Whatever the structure calls it: the FMU knows.
    said = f"<ssd:Connectors>{said}</ssd:Connectors>" if said else ""
    fmu = _with_list(foreign, tmp_path)
    path = archive(tmp_path, fmu, ssd(COMPONENT.format(said), LINK.format("alpha", "u3"), ""))
    with pytest.raises(SettingsError, match=r"`a\.u3`, which is of type Enumeration; softneck connects numbers"):
        load_ssp(path)
    # Left alone it stands in nobody's way, here and in what is written of it.
    path = archive(tmp_path, fmu, ssd(COMPONENT.format(said), LINK.format("alpha", "u1"), ""))
    again = write_ssp(load_ssp(path), tmp_path / "Again.ssp")
    np.testing.assert_array_equal(simulate(load_ssp(path))["a.alpha"], simulate(load_ssp(again))["a.alpha"])


TYPES = {
    "real": Port(name="real"),
    "whole": Port(name="whole", integer=True),
    "yes": Port(name="yes", boolean=True),
}
PLAIN = Affine()


def _flat(start: str, end: str, line: Affine = PLAIN, given: float | None = None) -> Flat:
    """Return a's output `start` at b's input `end`, and a value of that input instead."""
    value = {} if given is None else {f"b.{end}": Value(given, "", "Real")}
    root = SystemNode(
        bindings=(Binding(value, None, {}),),
        elements={"a": Component("a.fmu", {}, ()), "b": Component("b.fmu", {}, ())},
        connections=() if value else (Connection(("a", start), ("b", end), line),),
    )
    ports = {"a.fmu": Ports({}, TYPES, {}, frozenset()), "b.fmu": Ports(TYPES, {}, {}, frozenset())}
    return flatten(Structure("s", root, {}, None, None, None), ports, Path("X.ssp"))


@pytest.mark.parametrize(
    ("start", "end", "line"),
    [
        ("whole", "real", Affine(0.5)), ("yes", "real", Affine()), ("yes", "whole", Affine(2.0, 1.0)),
        ("whole", "whole", Affine(-1.0)), ("yes", "yes", Affine()),
    ],
)  # fmt: skip
def test_whole_numbers_and_booleans_count_as_numbers(start: str, end: str, line: Affine) -> None:
    links = _flat(start, end, line).links
    assert links[("b",), end] == ((("a",), start), Line(line.factor, line.offset))


@pytest.mark.parametrize(
    ("start", "end", "line", "words"),
    [
        ("real", "whole", Affine(), "which is a whole number; softneck does not round"),
        ("whole", "whole", Affine(0.5), "which is a whole number"),
        ("real", "yes", Affine(), "which is a Boolean"),
        ("whole", "yes", Affine(), "which is a Boolean"),
        ("yes", "yes", Affine(-1.0, 1.0), "which is a Boolean"),
    ],
)
def test_nothing_is_rounded_on_the_way(start: str, end: str, line: Affine, words: str) -> None:
    with pytest.raises(SettingsError, match=f"connects `a.{start}` to `b.{end}`, {words}"):
        _flat(start, end, line)


def test_values_of_whole_numbers_and_booleans_are_such() -> None:
    assert _flat("real", "whole", given=3.0).values[("b",)] == {"whole": 3.0}
    for end, given in (("whole", 2.5), ("yes", 2.0)):
        with pytest.raises(SettingsError, match=rf"sets `b.{end}`, which is a .*, to {given:g}"):
            _flat("real", end, given=given)


def test_an_archive_that_reaches_out_of_itself(foreign: Path, tmp_path: Path) -> None:
    path = archive(tmp_path, foreign, ssd(), {"../../out.txt": b"x"})
    with pytest.raises(FileFormatError, match="would be outside the folder"):
        load_ssp(path)
    assert not (tmp_path.parent / "out.txt").exists()
    with pytest.raises(FileFormatError, match="is not an SSP archive"):
        load_ssp(foreign)


def test_an_fmu_that_reaches_out_of_itself_is_named_by_its_archive(foreign: Path, tmp_path: Path) -> None:
    fmu = tmp_path / "Out.fmu"
    fmu.write_bytes(foreign.read_bytes())
    with zipfile.ZipFile(fmu, "a") as file:
        file.writestr("../../../out.txt", b"x")
    path = archive(tmp_path, fmu, ssd())
    with pytest.raises(
        FileFormatError, match=rf"^{re.escape(str(path))}:resources/F.fmu: .* would be outside the folder"
    ):
        load_ssp(path)


def test_only_loops_are_loops(foreign: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="is no closed loop"):
        load_loop(archive(tmp_path, foreign, ssd()))


FAULT = '[[fault]]\nkind = "sensor_freeze"\nstart_s = 1.5\nduration_s = 0.5\n'


def test_faults_and_limits_over_an_archive(loop_file: Path, tmp_path: Path) -> None:
    plain = write_ssp(load_loop(loop_file), tmp_path / "Loop.ssp", compiled=False)
    beside = tmp_path / "faulty.toml"
    beside.write_text(f'ssp = "Loop.ssp"\n[limits]\n"pitch.overshoot_pct" = 1e-6\n{FAULT}')
    # As if the fault stood in the loop's own file; archives are Jacobi.
    loop_file.write_text(f'order = "jacobi"\n{loop_file.read_text()}\n{FAULT}')
    setup = load_loop(beside)
    assert set(setup.files) == {"loop", "ssp"}
    np.testing.assert_array_equal(simulate(setup)["pitch"], simulate(load_loop(loop_file))["pitch"])
    assert np.abs(simulate(setup)["pitch"] - simulate(plain)["pitch"]).max() > 1e-6, "the fault shows nowhere"
    assert run(["simulate", str(beside), "-o", str(tmp_path / "out.csv")]) == 1
    runs = study(beside, vary={"plant.parameters.payload": [0.0, 1.0]}, workers=1)
    assert runs["holds"].tolist() == [False, False]
    beside.write_text('ssp = "Loop.ssp"\n[plant]\nmodel = "nn.npz"\n')
    with pytest.raises(SettingsError, match=r"unknown key `plant`.*ssp"):
        load_loop(beside)


def test_a_study_of_an_archive(loop_file: Path, tmp_path: Path) -> None:
    path = write_ssp(load_loop(loop_file), tmp_path / "Loop.ssp", compiled=False)
    runs = study(path, vary={"plant.parameters.payload": [0.0, 1.0]}, workers=1)
    assert len(set(runs["pitch.rms_error_deg"].tolist())) == 2
