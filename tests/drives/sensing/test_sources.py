"""The inclinometer that a drives file names: each kind opens, each mistake is one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from softneck.core import SettingsError, SoftneckError
from softneck.drives import DrivesFile, load_drives, open_sensor
from softneck.drives.sensing._serial import SensorError

from ...data import ROOT

EXAMPLE = ROOT / "examples" / "drives" / "drives.toml"
MODULE = """from softneck.drives.master import Tilt


class Sensor:
    def __init__(self, offset):
        self.offset = offset

    def take(self, frames):
        pass

    def read(self, now, frames):
        return Tilt(self.offset, now)


def make(options):
    return Sensor(options["offset"])


def broken(options):
    raise OSError("no such sensor")


def nothing(options):
    return 3
"""


def file_with(folder: Path, lines: str) -> DrivesFile:
    text = EXAMPLE.read_text(encoding="utf-8").replace('kind = "can"  ', lines + "\n#")
    path = folder / "drives.toml"
    path.write_text(text, encoding="utf-8")
    return load_drives(path)


def test_a_sensor_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "my_sensor_for_test.py").write_text(MODULE, encoding="utf-8")
    lines = 'kind = "python"\npython = "my_sensor_for_test:make"\noptions = { offset = 0.25 }'
    file = file_with(tmp_path, lines)
    with open_sensor(file.sensor_kind, file.sensor_node, file.sensor_source) as sensor:
        assert sensor.read(2.0, ()).values == (0.25, 2.0)


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        ('kind = "serial"', SettingsError, r'\[sensor\] kind = "serial" needs `port`'),
        ('kind = "serial"\nport = 3', SettingsError, r"\[sensor\] port must be of type str; got 3"),
        ('kind = "serial"\nport = "/dev/ttyNONE"', SensorError, "inclinometer /dev/ttyNONE: cannot be opened"),
        ('kind = "serial"\nport = "x"\nbaud = 1', SettingsError, "`baud` must be"),
        ('kind = "python"\npython = "nowhere:make"', SettingsError, r"cannot be found .*package\.module:factory"),
        ('kind = "python"\npython = "bad_sensor_for_test:broken"', SensorError, "OSError: no such sensor"),
        ('kind = "python"\npython = "bad_sensor_for_test:nothing"', SettingsError, "a sensor without `take`"),
        ('kind = "simulated"', SettingsError, r'kind is "simulated"; on a bus it must be one of can, serial'),
        ('kind = "gx5"', SettingsError, r"`\[sensor\] kind` must be one of simulated, can, serial, python"),
    ],
)
def test_a_sensor_that_cannot_be_opened_is_one_line(
    tmp_path: Path, lines: str, error: type[SoftneckError], message: str
) -> None:
    (tmp_path / "bad_sensor_for_test.py").write_text(MODULE, encoding="utf-8")

    def try_it() -> None:
        file = file_with(tmp_path, lines)
        with open_sensor(file.sensor_kind, file.sensor_node, file.sensor_source):
            pass

    with pytest.raises(error, match=message):
        try_it()
