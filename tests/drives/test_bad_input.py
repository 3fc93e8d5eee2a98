"""Bad input: one clear line each, before anything moves."""

from __future__ import annotations

import contextlib
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softneck.core import FileFormatError, SettingsError, SoftneckError
from softneck.drives import DrivesFile, default_drives, load_drives, open_bus, preflight, simulated_neck
from softneck.drives.bus._link import VirtualLink
from softneck.drives.bus._read import _GONE, drives_table
from softneck.drives.bus._sdo import NUMBERS, Objects, SdoError
from softneck.drives.master import Frame
from softneck.drives.running._stop import disarm, stop
from softneck.drives.simulated._profiles import PROFILES
from softneck.plant import NeckParameters

from ..data import ROOT

EXAMPLE = ROOT / "examples" / "drives" / "drives.toml"


def link_to(file: DrivesFile) -> VirtualLink:
    return VirtualLink(simulated_neck(file, NeckParameters.paper(), sample_time=0.02, homed=True))


def written(tmp_path: Path, change: Callable[[str], str]) -> Path:
    path = tmp_path / "drives.toml"
    path.write_text(change(EXAMPLE.read_text(encoding="utf-8")), encoding="utf-8")
    return path


# -- the drives file --------------------------------------------------------------------------------------------------


def test_the_example_states_the_defaults() -> None:
    file = load_drives(EXAMPLE)
    assert file.sensor_kind == "can"
    plain = default_drives()
    for name in ("cycle", "guarding", "limits", "zero", "ramps", "neck", "quick_stop", "following"):
        assert getattr(file, name) == getattr(plain, name), name
    assert [drive.node for drive in file.drives] == [1, 2, 3]
    # Angles stand there in rounded degrees, the gear and Eq. 31 with as many digits as one reads.
    assert file.sensor_angle == pytest.approx(plain.sensor_angle, rel=1e-3)
    assert file.watch.gain == pytest.approx(plain.watch.gain, rel=1e-3)
    assert file.drives[0].scale.gear == pytest.approx(plain.drives[0].scale.gear, rel=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("period_s", "periode_s", r"unknown key `periode_s` of \[bus\]; it takes period_s, bit_rate"),
        ("[limits]", "[limit]", "unknown key `limit` of the file"),
        ("node = 2", "node = 1", "three drives need three node numbers; got 1, 1, 3"),
        ("node = 2", "node = 200", r"\[\[drive\]\] 2: `node` must be a whole number between 1 and 126"),
        ("node = 3\npeak_current_A = 10.0", "node = 3", r"\[\[drive\]\] 3: `peak_current_A` is missing"),
        ("current_limit_A = 0.0299", "current_limit_A = 29.9", "beyond the drive's peak current 10 A"),
        ("current_limit_A = 0.0299", "current_limit_A = 0.00001", "less than one unit"),
        ("position_rad = 6.0", 'position_rad = "6"', r"\[limits\] position_rad must be a number"),
        ("time_s = 0.1 ", "time_s = 0.5 ", r"\[guarding\]: `time_s` must be between 0.02 and 0.1; got 0.5"),
        ("reversed = false", "reversed = 1", r"\[\[drive\]\] 1 reversed must be true or false"),
        ('profile = "ipos2015"', 'profile = "epos"', "`profile` must be one of ipos2015, ds402"),
        ("angle_deg = 68.75", "angle_deg = 100.0", r"`angle` must be between 0\.1 and 1\.6"),
        (
            "angle_deg = 68.75",
            "dropout_s = 0.3",
            r"\[sensor\] dropout_s is no setting any more, but always 0\.08; leave",
        ),
        ("[bus]", "[bus", "is not valid TOML"),
    ],
)
def test_a_drives_file_with_a_typo(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, lambda text: text.replace(old, new))
    with pytest.raises((SettingsError, FileFormatError), match=message) as error:
        load_drives(path)
    assert str(error.value).startswith(str(path))


def test_a_file_with_what_is_no_setting_any_more_says_what_holds_and_is_read_where_it_says_the_same(
    tmp_path: Path,
) -> None:
    for table, keys in _GONE.items():
        for key, constant in keys.items():
            for value, reads in ((constant, True), (2.0 * constant, False), ("x", False)):
                said = repr(value).replace("'", '"')
                path = written(tmp_path, lambda text, said=said, table=table, key=key: text.replace(
                    f"[{table}]\n", f"[{table}]\n{key} = {said}\n"))  # fmt: skip
                if reads:
                    assert drives_table(load_drives(path)) == drives_table(load_drives(EXAMPLE))
                    continue
                with pytest.raises(SettingsError, match=rf"\[{table}\] {key} is no setting any more"):
                    load_drives(path)


def test_two_drives_are_not_enough(tmp_path: Path) -> None:
    path = written(tmp_path, lambda text: text.replace("[[drive]]                       # motor 3\n", "").replace(
        "node = 3\npeak_current_A = 10.0\n", ""))  # fmt: skip
    with pytest.raises(SettingsError, match=r"three \[\[drive\]\] tables are needed.*there are 2"):
        load_drives(path)


# -- objects ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("profile", list(PROFILES))
def test_the_simulated_drives_have_what_a_run_uses(profile: str) -> None:
    items = PROFILES[profile]().items
    others = {(0x207E, 0), (0x207F, 0)} if profile == "ds402" else {(0x1016, 1), (0x6073, 0), (0x6078, 0)}
    assert set(NUMBERS) - set(items) == others
    for key, code in NUMBERS.items():
        if key in items:
            assert (struct.calcsize(code), code.islower()) == (items[key].size, items[key].signed), key


def test_no_file_is_opened_once_a_drive_may_have_power() -> None:
    """Neither by pre-flight, stop and the end of guarding: files may be gone by then."""
    file = default_drives()
    link = link_to(file)
    preflight(link, file).require()  # imports are done
    opened: list[str] = []
    listening = [True]
    sys.addaudithook(lambda event, args: opened.append(str(args[0])) if event == "open" and listening[0] else None)
    preflight(link, file).require()
    stop(link, file)
    disarm(link, file, "life", ())
    listening[0] = False
    assert opened == []


# -- what is on the bus -----------------------------------------------------------------------------------------------


def _row(link: VirtualLink, file: DrivesFile, name: str) -> str:
    report = preflight(link, file)
    assert not report.holds
    bad = [row for row in report.rows if not row.holds]
    assert bad[0].name == name
    # Nothing moved: no drive ever had power.
    assert all(drive.axis.state == 0x40 or drive.axis.state == 0x08 for drive in link.neck.drives)
    return f"{bad[0].found} | {bad[0].advice}"


def test_a_node_that_is_missing() -> None:
    file = default_drives()
    link = link_to(file)
    link.neck.drives[1].alive = False
    assert _row(link, file, "present").startswith("no answer | Is it on")


def test_a_node_with_another_identity(tmp_path: Path) -> None:
    file = load_drives(written(tmp_path, lambda text: text.replace("# serial = 1001", "serial = 4711")))
    assert "serial 1001 instead of 4711" in _row(link_to(file), file, "identity")
    assert preflight(link_to(file), file, override=["identity"]).holds


def test_another_firmware(tmp_path: Path) -> None:
    file = load_drives(written(tmp_path, lambda text: text.replace('# firmware = "F514I"', 'firmware = "F515K"')))
    assert "F514I" in _row(link_to(file), file, "firmware")


def test_a_drive_in_another_factor_group() -> None:
    file = default_drives()
    link = link_to(file)
    link.neck.drives[2].axis.values[(0x6093, 1)] = 1000
    assert "6093h is 1000/1 | Set the factor group to 1/1" in _row(link, file, "factor group")


def test_limits_beyond_the_drives() -> None:
    file = default_drives()
    link = link_to(file)
    axis = link.neck.drives[0].axis
    keep = axis._is_allowed
    axis._is_allowed = lambda key, value: keep(key, value) and not (key == (0x6085, 0) and value > 1000)
    text = _row(link, file, "limits")
    assert "node 1 refuses the value" in text
    assert "beyond what the drive takes" in text


def test_a_value_that_does_not_stay() -> None:
    file = default_drives()
    link = link_to(file)
    axis = link.neck.drives[1].axis
    axis.getters[(0x6007, 0)] = lambda: 0
    assert "6007h:0 reads 0 after 1 was written" in _row(link, file, "options")


def test_a_drive_in_fault() -> None:
    file = default_drives()
    link = link_to(file)
    link.neck.drives[0].axis.trip(0x2310)
    assert "softneck drives reset" in _row(link, file, "state")


def test_a_second_master_within_a_second() -> None:
    file = default_drives()
    link = link_to(file)
    link.inject.append(Frame(0x080))
    assert "a SYNC" in _row(link, file, "second master")
    assert link.now <= 1.0
    link.inject.append(Frame(0x203, b"\x0f\0\0\0\0\0"))
    assert "set-points to node 3" in _row(link, file, "second master")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("can0", "--bus takes INTERFACE:CHANNEL"),
        ("nothing:can0", "python-can has no interface `nothing`"),
        ("socketcan:can_that_is_not", "bus socketcan:can_that_is_not cannot be opened"),
    ],
)
def test_a_bus_that_cannot_be_opened(text: str, message: str) -> None:
    with pytest.raises(SoftneckError, match=message), open_bus(text):
        pass


# -- SDO --------------------------------------------------------------------------------------------------------------


class Liar:
    """A link whose node answers whatever it likes."""

    def __init__(self, answers: list[bytes]) -> None:
        self.answers, self.now, self.problem = answers, 0.0, ""

    def send(self, frames: object) -> None:
        del frames

    def receive(self, timeout: float) -> list[Frame]:
        self.now += max(timeout, 1e-3)
        return [Frame(0x581, self.answers.pop(0))] if timeout and self.answers else []


@settings(max_examples=200, deadline=None)
@given(
    answers=st.lists(st.binary(min_size=0, max_size=8) | st.binary(min_size=8, max_size=8), max_size=6),
    index=st.sampled_from([0x1000, 0x1008, 0x6064, 0x607D]),
)
def test_any_answer_is_a_value_or_one_clear_error(answers: list[bytes], index: int) -> None:
    objects = Objects(Liar(answers), 1)
    with contextlib.suppress(SdoError):
        if index == 0x1008:
            objects.read_text(index)
        else:
            objects.read(index, 1 if index == 0x607D else 0)


def test_a_value_is_what_the_node_sent() -> None:
    answer = struct.pack("<BHBi", 0x43, 0x6064, 0, -12345)
    assert Objects(Liar([answer]), 1).read(0x6064) == -12345
