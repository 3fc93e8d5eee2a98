"""Motors, measured positions and outputs of any robot's log, by the words, units and motion of its columns."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from softneck import import_log
from softneck.core import DataError, SettingsError, Vector
from softneck.signals import columns_line, guess_layout, is_of_another_robot, read_recording, write_recording
from softneck.signals.importing._robot_guess import NamedColumns, RobotGuess, guess_robot, layout_for

ROWS = 400


def steps(seed: int, low: float, high: float) -> Vector:
    """Return levels of 20 samples."""
    return np.repeat(np.random.default_rng(seed).uniform(low, high, ROWS // 20), 20)


def lagged(u: Vector, pole: float) -> Vector:
    x = np.zeros(ROWS)
    for k in range(1, ROWS):
        x[k] = pole * x[k - 1] + (1.0 - pole) * u[k - 1]
    return x


A, B, C = steps(0, 0.0, 90.0), steps(1, 0.0, 90.0), steps(2, 0.0, 90.0)
NOISE = np.random.default_rng(9).standard_normal((4, ROWS))
BENT = lagged(A - 0.4 * B, 0.9) + 0.05 * NOISE[0]
TURNED = lagged(0.3 * A + B, 0.92) + 0.05 * NOISE[1]
ONE = lagged(A, 0.93) + 0.05 * NOISE[0]
REACHED_A, REACHED_B = lagged(A, 0.6) + 0.3 * NOISE[2], lagged(B, 0.6) + 0.3 * NOISE[3]
WARM = 22.0 + np.round(np.cumsum(0.02 * NOISE[2]), 1)
SAGGING = 12.6 - 0.001 * np.arange(ROWS) + 0.01 * NOISE[3]
TIME = 0.02 * np.arange(ROWS)

# name -> (columns, motors, positions, outputs, unit of motors, unit of outputs); what is in no list is left out.
ROBOTS: dict[str, tuple[dict[str, Vector], list[str], list[str], list[str], str, str]] = {
    "a pneumatic finger": (
        {"clk ms": 1e3 * TIME, "Pcmd_kPa": A, "P_meas_kPa": REACHED_A, "flexion(deg)": ONE, "T_amb": WARM},
        ["Pcmd_kPa"], ["P_meas_kPa"], ["flexion(deg)"], "kPa", "deg"),
    "bellows in bar, in German": (
        {"Zeit [s]": TIME, "Solldruck 1 [bar]": A, "Solldruck 2 [bar]": B, "Istdruck 1 [bar]": REACHED_A,
         "Istdruck 2 [bar]": REACHED_B, "Biegewinkel [deg]": BENT, "Umgebungstemperatur": WARM},
        ["Solldruck 1 [bar]", "Solldruck 2 [bar]"], ["Istdruck 1 [bar]", "Istdruck 2 [bar]"], ["Biegewinkel [deg]"],
        "bar", "deg"),
    "a hydraulic cylinder with a valve and a reference of its own": (
        {"t": TIME, "valve_cmd [V]": A, "pos_ref [mm]": np.roll(B, 3), "pos_meas [mm]": ONE, "pA [bar]": REACHED_A,
         "oil temp [°C]": WARM},
        ["valve_cmd [V]"], [], ["pos_meas [mm]"], "V", "mm"),
    "a servo by its pulses": (
        {"millis": 1e3 * TIME, "servo_us": 1000.0 + A, "horn angle (deg)": ONE, "vbat": SAGGING},
        ["servo_us"], [], ["horn angle (deg)"], "us", "deg"),
    "two servos in angles": (
        {"time": TIME, "q1_des [deg]": A, "q2_des [deg]": B, "q1_meas [deg]": REACHED_A, "q2_meas [deg]": REACHED_B,
         "i1 [A]": 0.01 * REACHED_A + NOISE[0], "i2 [A]": 0.01 * REACHED_B + NOISE[1], "tip_x [mm]": BENT,
         "tip_y [mm]": TURNED},
        ["q1_des [deg]", "q2_des [deg]"], ["q1_meas [deg]", "q2_meas [deg]"], ["tip_x [mm]", "tip_y [mm]"],
        "deg", "mm"),
    "cables, in Spanish": (
        {"tiempo (s)": TIME, "consigna cable 1 (mm)": A, "consigna cable 2 (mm)": B, "medida cable 1 (mm)": REACHED_A,
         "medida cable 2 (mm)": REACHED_B, "flexion (deg)": BENT, "bateria (V)": SAGGING},
        ["consigna cable 1 (mm)", "consigna cable 2 (mm)"], ["medida cable 1 (mm)", "medida cable 2 (mm)"],
        ["flexion (deg)"], "mm", "deg"),
    "wires of a shape memory alloy": (
        {"time [s]": TIME, "I_cmd [mA]": A, "I_meas [mA]": REACHED_A, "T_wire [degC]": 20.0 + ONE,
         "bend [rad]": 0.01 * ONE, "supply [V]": SAGGING},
        ["I_cmd [mA]"], ["I_meas [mA]"], ["bend [rad]"], "mA", "rad"),
    "wires heated by a duty cycle": (
        {"time [s]": TIME, "duty [%]": A, "current [A]": 0.02 * REACHED_A, "temperature": 20.0 + ONE,
         "stroke [mm]": ONE},
        ["duty [%]"], [], ["stroke [mm]"], "%", "mm"),
    "chambers in psi, in French": (
        {"temps (s)": TIME, "pression consigne 1 (psi)": A, "pression consigne 2 (psi)": B,
         "pression mesuree 1 (psi)": REACHED_A, "pression mesuree 2 (psi)": REACHED_B, "fleche (mm)": BENT},
        ["pression consigne 1 (psi)", "pression consigne 2 (psi)"],
        ["pression mesuree 1 (psi)", "pression mesuree 2 (psi)"], ["fleche (mm)"], "psi", "mm"),
    "a pump, in Italian": (
        {"tempo [s]": TIME, "pompa comando [V]": A, "pressione misurata [bar]": REACHED_A, "angolo [deg]": ONE,
         "corrente [A]": 0.1 * REACHED_A},
        ["pompa comando [V]"], [], ["angolo [deg]"], "V", "deg"),
    "pressures without a word for command or measurement": (
        {"t_s": TIME, "a [kPa]": A, "b [kPa]": B, "am [kPa]": REACHED_A, "bm [kPa]": REACHED_B, "bend (deg)": BENT},
        ["a [kPa]", "b [kPa]"], ["am [kPa]", "bm [kPa]"], ["bend (deg)"], "kPa", "deg"),
    "inputs and outputs of a textbook": (
        {"t": TIME, "u1": A, "u2": B, "y1": BENT, "y2": TURNED},
        ["u1", "u2"], [], ["y1", "y2"], "1", "1"),
    "a joint whose measured angle is all there is": (
        {"time": TIME, "joint_target [deg]": A, "joint_encoder [deg]": ONE},
        ["joint_target [deg]"], [], ["joint_encoder [deg]"], "deg", "deg"),
    "four tendons, the angles as outputs": (
        {"time": TIME, **{f"motor_cmd_{j} [rad]": one for j, one in enumerate((A, B, C, A[::-1]), start=1)},
         "pitch [deg]": BENT, "roll [deg]": TURNED, "pitch_ref [deg]": C},
        [f"motor_cmd_{j} [rad]" for j in range(1, 5)], [], ["pitch [deg]", "roll [deg]"], "rad", "deg"),
    "a plate that is only heated": (
        {"time_s": TIME, "heater_current_A": A, "plate_temp_degC": 20.0 + ONE, "ambient_degC": WARM},
        ["heater_current_A"], [], ["plate_temp_degC"], "A", "degC"),
    "a plate whose heater's power is logged": (
        {"time [s]": TIME, "power [W]": A, "temperature [degC]": 20.0 + ONE},
        ["power [W]"], [], ["temperature [degC]"], "W", "degC"),
    "a drive's power beside its command": (
        {"time [s]": TIME, "motor_cmd [V]": A, "motor_power [W]": A**2, "angle [deg]": ONE},
        ["motor_cmd [V]"], [], ["angle [deg]"], "V", "deg"),
    "pressures by words alone, a tip": (
        {"time": TIME, "pressure_1": A, "pressure_2": B, "x": BENT, "y": TURNED, "vx": np.gradient(BENT)},
        ["pressure_1", "pressure_2"], [], ["x", "y"], "1", "1"),
}  # fmt: skip


def write(path: Path, columns: dict[str, Vector]) -> Path:
    rows = np.column_stack(list(columns.values()))
    path.write_text(";".join(columns) + "\n" + "\n".join(";".join(f"{v:.6g}" for v in row) for row in rows) + "\n")
    return path


def taken(guess: RobotGuess) -> tuple[list[str], list[str], list[str]]:
    """Return the columns of set-points, positions and outputs."""
    robot, channels = guess.robot, guess.layout.channels
    groups = (robot.set_points, robot.motor_positions, robot.outputs.names)
    motors, positions, outputs = (
        [str(channels[name].terms[0].column) for name in names if name in channels] for names in groups
    )
    return motors, positions, outputs


@pytest.mark.parametrize("name", ROBOTS)
def test_columns_of_any_robot_get_their_roles(tmp_path: Path, name: str) -> None:
    columns, motors, positions, outputs, unit, shown = ROBOTS[name]
    path = write(tmp_path / "log.csv", columns)
    guess = guess_robot(path)
    assert taken(guess) == (motors, positions, outputs), guess.lines
    assert (guess.robot.motors.unit, guess.robot.outputs.display_unit) == (unit, shown)
    assert is_of_another_robot(path)
    # Every other column is named with a reason.
    clock = next(iter(columns))
    for title in set(columns) - {clock, *motors, *positions, *outputs}:
        assert any(line.startswith(f"left out: {title}: ") for line in guess.lines), (title, guess.lines)
    recording = import_log(path, guess.layout).recording
    assert recording.sample_time == pytest.approx(0.02, rel=1e-6)  # six digits are written


def test_the_order_of_columns_changes_no_role(tmp_path: Path) -> None:
    for name, (columns, motors, positions, outputs, *_) in ROBOTS.items():
        turned = dict(sorted(columns.items(), key=lambda one: one[0][::-1]))
        found = taken(guess_robot(write(tmp_path / "log.csv", turned)))
        assert [sorted(one) for one in found] == [sorted(one) for one in (motors, positions, outputs)], name


def test_copies_sums_rates_and_constants_are_named_and_left_out(tmp_path: Path) -> None:
    columns = {
        "time": TIME, "valve_1 [V]": A, "valve_2 [V]": B, "valve_3 [V]": np.full(ROWS, 4.0), "tip_x": BENT,
        "tip_y": TURNED, "pose_x": BENT, "tip_diff": TURNED - BENT, "valve_sum [V]": A + B,
    }  # fmt: skip
    guess = guess_robot(write(tmp_path / "log.csv", columns))
    assert taken(guess)[2] == ["tip_x", "tip_y"]
    for line in (
        "left out: valve_3 [V]: constant at 4 (a command that moves nothing)",
        "left out: pose_x: a copy of tip_x",
        "left out: tip_diff: exactly tip_y minus tip_x",
        "valve_sum [V]: exactly valve_1 [V] plus valve_2 [V]",
    ):
        assert line in guess.lines, guess.lines


def test_what_moves_by_itself_is_no_output(tmp_path: Path) -> None:
    columns = {"time": TIME, "valve [V]": A, "x": ONE, "z": NOISE[2]}
    guess = guess_robot(write(tmp_path / "log.csv", columns))
    assert taken(guess)[2] == ["x"]
    assert "left out: z: does not follow the motors" in guess.lines


def test_references_and_angles_alone_are_no_robot(tmp_path: Path) -> None:
    columns = {"time": TIME, "target_inclination": A, "sensor_inclination": ONE, "error": BENT}
    path = write(tmp_path / "log.csv", columns)
    assert not is_of_another_robot(path)
    with pytest.raises(DataError, match=r"no column was recognised as motor\. Name them: `softneck import"):
        guess_robot(path)


def test_a_log_with_too_few_columns_for_a_neck_names_those_it_has(tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", {"time": TIME, "supply valve": A, "y": ONE})
    assert is_of_another_robot(path)
    with pytest.raises(DataError, match=r"Name them: .*--output 'supply valve' --output y"):
        guess_robot(path)


def test_named_columns_are_the_layout_and_the_rest_is_recognised(tmp_path: Path) -> None:
    columns, motors, positions, outputs, *_ = ROBOTS["a pneumatic finger"]
    path = write(tmp_path / "log.csv", columns)
    by_name = import_log(path, motors=motors, positions=positions, outputs=outputs).recording
    by_guess = import_log(path, guess_robot(path).layout).recording
    np.testing.assert_array_equal(by_name.outputs, by_guess.outputs)
    np.testing.assert_array_equal(by_name.motor_positions, by_guess.motor_positions)
    half = import_log(path, motors=motors)
    np.testing.assert_array_equal(half.recording.outputs, by_guess.outputs)
    assert any(note.startswith("left out: T_amb") for note in half.notes)
    with pytest.raises(SettingsError, match=r"either a layout .* or columns"):
        import_log(path)
    with pytest.raises(DataError, match=r"no column `Pcmd`.*did you mean"):
        import_log(path, motors=["Pcmd"])


def test_a_log_without_titles_offers_the_line_that_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    smooth = lagged(BENT, 0.9)
    values = np.column_stack([A, B, 0.01 * smooth, 0.01 * TURNED, np.gradient(smooth)])
    path.write_text("\n".join(",".join(f"{v:.6g}" for v in row) for row in values) + "\n")
    assert columns_line(path).startswith(
        f"`softneck import {path} --motor 0-1 --output 2-3 --sample-time S -o rec.csv`"
    )
    guess = guess_robot(path, NamedColumns(motors=("0-1",)), sample_time=0.02)
    assert [term.column for source in guess.layout.channels.values() for term in source.terms] == [0, 1, 2, 3]
    assert "left out: 4: the rate of 2" in guess.lines


@pytest.mark.parametrize(
    ("motor", "output", "taken_units", "doubted"),
    [("Nm", "mm", ("Nm", "mm"), []), ("%", "mm", ("%", "mm"), ["unit `%`"]),
     ("V", "grad", ("V", "deg"), ["unit `grad`"]), ("nm", "gon", ("Nm", "gon"), ["unit `nm`"]),
     ("pct", "rev", ("%", "turns"), ["unit `pct`"]),
     ("foo", "µm", ("1", "um"), ["unit `foo`"])],
)  # fmt: skip
def test_units_of_a_robot_are_those_of_the_titles_and_doubted_where_they_are_ambiguous(
    tmp_path: Path, motor: str, output: str, taken_units: tuple[str, str], doubted: list[str]
) -> None:
    guess = guess_robot(
        write(tmp_path / "log.csv", {"time [s]": TIME, f"cmd [{motor}]": A, f"flexion [{output}]": ONE})
    )
    assert (guess.robot.motors.unit, guess.robot.outputs.unit) == taken_units
    assert [doubt.about for doubt in guess.doubts] == ["robot", *doubted]


@pytest.mark.parametrize("title", ["time_s", "time [s]", "t_s"])
@pytest.mark.parametrize(("sample_time", "doubted"), [(2.0, False), (10.0, False), (2e-4, True)])
def test_a_robot_may_be_as_slow_as_the_title_of_its_clock_says(
    tmp_path: Path, title: str, sample_time: float, doubted: bool
) -> None:
    time = sample_time / 0.02 * TIME
    guess = guess_robot(write(tmp_path / "log.csv", {title: time, "cmd [V]": A, "x [mm]": ONE}))
    # Six digits are written.
    assert import_log(tmp_path / "log.csv", guess.layout).recording.sample_time == pytest.approx(sample_time, rel=1e-4)
    assert any(doubt.channels == ("time",) for doubt in guess.doubts) == doubted
    assert sum("unusual sample time" in line for line in guess.lines) == doubted


def test_columns_in_millimetres_are_no_angles_of_a_neck(tmp_path: Path) -> None:
    named = {f"Kanal {j} [mm]": values for j, values in enumerate((A, B, A - B, ONE, BENT), start=1)}
    file = write(tmp_path / "log.csv", {"time [s]": TIME, **named})
    guess = guess_layout(file)
    assert not set(guess.layout.channels) & {"motor_setpoint_1", "motor_position_1", "pitch", "roll"}
    assert guess.missing
    file = write(tmp_path / "weg.csv", {"Zeit [s]": TIME, "Sollweg 1 [mm]": A, "Sollweg 2 [mm]": B, "x [m]": ONE})
    assert guess_robot(file).robot.motors.names == ("Sollweg_1", "Sollweg_2")


def test_a_unit_behind_a_tight_slash_is_read_as_in_brackets(tmp_path: Path) -> None:
    file = write(tmp_path / "log.csv", {"t/s": TIME, "I_soll/A": A, "F/N": ONE, "tip mm/s": NOISE[0]})
    guess = guess_robot(file)
    assert (guess.robot.motors.names, guess.robot.motors.unit) == (("I_soll",), "A")
    assert (guess.robot.outputs.names, guess.robot.outputs.unit) == (("F",), "N")
    assert import_log(file, guess.layout).recording.sample_time == pytest.approx(0.02)


def test_names_keep_the_letters_under_accents_and_another_unit_is_the_reason(tmp_path: Path) -> None:
    columns = {"time [s]": TIME, "Düse [V]": A, "Krümmung [mm]": ONE, "x [mm]": BENT, "twist [deg]": TURNED}
    guess = guess_robot(write(tmp_path / "log.csv", columns))
    assert (guess.robot.motors.names, guess.robot.outputs.names) == (("Duse",), ("Krummung", "x"))
    assert any(line.startswith("left out: twist [deg]: of another quantity than") for line in guess.lines)


@pytest.mark.parametrize(("title", "numbers", "doubted"), [("min", 1.0 / 60.0, False), ("ms", 1.0, True)])
def test_the_clock_of_any_robot_is_checked_against_its_title(
    tmp_path: Path, title: str, numbers: float, doubted: bool
) -> None:
    columns = {f"time [{title}]": numbers * TIME, "cmd [V]": A, "x [mm]": ONE}
    guess = guess_robot(write(tmp_path / "log.csv", columns))
    # Six digits of minutes are written: a step is off by 2 %.
    assert import_log(tmp_path / "log.csv", guess.layout).recording.sample_time == pytest.approx(0.02, rel=1e-3)
    assert [doubt.channels == ("time",) for doubt in guess.doubts] == [False, *[True] * doubted]


STEPS = 0.02 + 0.004 * np.random.default_rng(3).uniform(-1.0, 1.0, ROWS)


@pytest.mark.parametrize(
    ("clock", "runs"),
    [
        ({"elapsed": TIME}, 1),
        ({"elapsed": 44_000.0 + TIME / 86_400.0}, 1),
        ({"elapsed": np.cumsum(STEPS)}, 1),
        ({"elapsed": np.r_[TIME[:200], TIME[:200]]}, 2),
        ({"sec": np.floor(TIME), "nanosec": np.round(1e9 * (TIME - np.floor(TIME)))}, 1),
        ({"dt": STEPS}, 1),
        ({"time": np.floor(TIME)}, 1),
    ],
)
def test_named_columns_take_the_clock_that_the_guess_finds(tmp_path: Path, clock: dict[str, Vector], runs: int) -> None:
    path = tmp_path / "log.csv"
    table = np.column_stack([*clock.values(), A, ONE])
    # Days of a spreadsheet need all digits.
    np.savetxt(path, table, delimiter=",", header=",".join([*clock, "p", "answer"]), comments="", fmt="%.17g")
    guess = guess_robot(path, NamedColumns(("p",), ("answer",)))
    made = import_log(path, guess.layout).recording
    # The steps of the uneven clocks have this mean, within 3 standard errors.
    assert made.sample_time == pytest.approx(0.02, rel=0.02)
    assert (len(made), len(made.runs())) == (ROWS, runs)
    assert "--sample-time" not in columns_line(path)
    with pytest.raises(DataError, match="no column is a time; say its sample time"):
        guess_robot(write(tmp_path / "none.csv", {"p": A, "answer": ONE}), NamedColumns(("p",), ("answer",)))


def test_a_unit_of_another_quantity_than_the_given_robots_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "log.csv", {"time [s]": TIME, "cmd [V]": A, "x [mm]": ONE})
    robot = guess_robot(path).robot
    wrong = write(tmp_path / "wrong.csv", {"time [s]": TIME, "cmd [bar]": A, "x [mm]": ONE})
    with pytest.raises(DataError, match=r"wrong.csv: `cmd \[bar\]` is in bar; `cmd_setpoint` of robot `log`"):
        guess_robot(wrong, robot=robot)


def test_a_sample_time_beside_what_may_be_a_clock_is_doubted_by_the_columns_name(tmp_path: Path) -> None:
    columns = {"stamp": TIME[::-1], "cmd [V]": A, "x [mm]": ONE}
    path = write(tmp_path / "log.csv", columns)
    guess = guess_robot(path, sample_time=0.02)
    (doubt,) = guess.doubts[1:]
    assert doubt.about == "sample time"
    assert "'stamp' was not recognised as a clock" in doubt.why
    titled = layout_for(path, guess.robot, sample_time=0.02)
    assert titled.doubts == (doubt,)
    clocked = write(tmp_path / "clock.csv", {"time": TIME, "cmd [V]": A, "x [mm]": ONE})
    for say in (
        lambda: guess_robot(clocked, sample_time=0.02),
        lambda: layout_for(clocked, guess.robot, sample_time=0.02),
    ):
        with pytest.raises(SettingsError, match=r"has a clock, `time`; leave out --sample-time"):
            say()


@pytest.mark.parametrize(
    ("name", "roles", "left_out"),
    [
        (
            "finger.csv",
            (["Pcmd_kPa"], ["P_meas_kPa"], ["flexion(deg)"]),
            ["left out: T_amb: 'amb' is neither motor nor output"],
        ),
        (
            "outputs_copied.csv",
            ([f"valve_{j} [V]" for j in (1, 2, 3)], [], ["tip_x [cm]", "tip_y [cm]"]),
            ["left out: pose_x [cm]: a copy of tip_x [cm]", "left out: pose_y [cm]: a copy of tip_y [cm]"],
        ),
    ],
)
def test_the_reported_logs_are_read_as_their_readme_says(
    shared_data: Path, name: str, roles: tuple[list[str], ...], left_out: list[str]
) -> None:
    path = shared_data / "reports" / name
    if not path.is_file():
        pytest.skip(f"{path} is absent on this machine")
    guess = guess_robot(path)
    assert taken(guess) == roles
    assert set(left_out) <= set(guess.lines)
    assert is_of_another_robot(path)


# How other loggers write the titles of one robot: kilovolts in, micrometres out.
STYLES = (
    ("t [s]", "U_cmd [kV]", "tip [µm]"), ("t (s)", "U_cmd (kV)", "tip (um)"), ("t/s", "U_cmd / kV", "tip / μm"),
    ("t in s", "U cmd in kV", "tip in µm"), ("t_s", "U_cmd_kV", "tip_um"), ("t [s]", "Ucmd[kV]", "tip[µm]"),
)  # fmt: skip


@pytest.mark.parametrize("titles", STYLES, ids=lambda titles: titles[1])
def test_no_style_of_titles_loses_a_unit_or_puts_it_into_a_name(titles: tuple[str, str, str], tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    np.savetxt(log, np.column_stack([TIME, A, ONE]), delimiter=",", header=",".join(titles), comments="", fmt="%.6f")
    guess = guess_robot(log)
    robot = guess.robot
    assert (robot.motors.unit, robot.outputs.unit, robot.outputs.names) == ("kV", "um", ("tip",))
    assert robot.motors.names[0].replace("_", "") == "Ucmd"
    assert [doubt.about for doubt in guess.doubts] == ["robot"]
    # The robot that was proposed finds the same columns in the next log.
    assert layout_for(log, robot).layout.channels == guess.layout.channels


def test_greek_letters_are_words(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    titles = "t [s],τ_cmd [mN·m],θ [deg],ω [deg/s]"
    data = np.column_stack([TIME, A, ONE, NOISE[0]])
    np.savetxt(log, data, delimiter=",", header=titles, comments="", fmt="%.6f", encoding="utf-8")
    guess = guess_robot(log)
    assert (guess.robot.motors.names, guess.robot.motors.unit) == (("tau_cmd",), "mNm")
    assert guess.robot.outputs.names == ("theta",)


@pytest.mark.parametrize("rows", range(4))
def test_a_log_of_few_rows_is_read_or_refused_in_one_line(rows: int, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    lines = [f"{0.1 * k:g},{k % 3},{(k + 1) % 3}" for k in range(rows)]
    log.write_text("\n".join(["time [s],u [V],y [mm]", *lines, ""]))
    if rows < 2:
        with pytest.raises(
            DataError, match=rf"log\.csv: has {rows} row\(s\) of numbers; a log has one for each sample"
        ):
            guess_robot(log)
    else:
        assert guess_robot(log).robot.motors.unit == "V"


def test_an_input_that_stands_still_is_named(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    data = np.column_stack([TIME, np.full(ROWS, 2.5), ONE])
    np.savetxt(log, data, delimiter=",", header="time [s],valve [V],angle [deg]", comments="", fmt="%.6f")
    with pytest.raises(DataError, match=r"no column was recognised as motor \(valve \[V\] is constant at 2\.5"):
        guess_robot(log)


def test_the_most_motors_and_outputs_are_found_and_one_more_is_refused_by_their_number(tmp_path: Path) -> None:
    motors = {f"p{j}_cmd_MPa": steps(j, 0.0, 1.0) for j in range(1, 9)}
    places = ("tip_x", "tip_y", "mid_x", "mid_y")
    moved = {f"{name}_mm": lagged(motors[f"p{2 * k + 1}_cmd_MPa"], 0.8) for k, name in enumerate(places)}

    def write(columns: dict[str, Vector]) -> Path:
        log = tmp_path / f"{len(columns)}.csv"
        data = np.column_stack([TIME, *columns.values()])
        np.savetxt(log, data, delimiter=",", header=",".join(["t_s", *columns]), comments="", fmt="%.6f")
        return log

    robot = guess_robot(write({**motors, **moved})).robot
    assert (len(robot.motors.names), robot.outputs.names) == (8, places)
    nine = write({**motors, "p9_cmd_MPa": steps(9, 0.0, 1.0), **moved})
    assert is_of_another_robot(nine)
    with pytest.raises(DataError, match=r"1 to 8.*Name fewer: --motor COL"):
        guess_robot(nine)


def test_messages_of_several_clocks_are_merged_for_any_robot(tmp_path: Path) -> None:
    """Outputs before the first set-point were an error, as the rows of a bag were taken for those of a table."""
    n = TIME.size
    time = np.sort(np.concatenate([TIME + 0.001, TIME]))
    cells = np.full((2 * n, 3), np.nan)
    cells[0::2, 2], cells[3::4, 0], cells[3::4, 1] = ONE, A[1::2], B[1::2]
    rows = [",".join("" if np.isnan(v) else f"{v:.6g}" for v in (t, *row)) for t, row in zip(time, cells, strict=True)]
    (tmp_path / "bag.csv").write_text("time [s],p1_cmd [bar],p2_cmd [bar],height [mm]\n" + "\n".join(rows) + "\n")
    guess = guess_robot(tmp_path / "bag.csv")
    assert guess.layout.merge
    found = import_log(tmp_path / "bag.csv", guess.layout).recording
    # The first row with a set-point before it is the second output after it.
    np.testing.assert_allclose(found.outputs[:, 0], 1e-3 * ONE[2:], rtol=1e-5)
    np.testing.assert_allclose(found.set_points[:, 0], 1e5 * np.repeat(A[1::2], 2)[: n - 2], rtol=1e-5)


@pytest.mark.parametrize(
    ("motors", "channels"),
    [(["heater_setpoint [W]"], ("heater_setpoint",)), (["setpoint [V]"], ("motor_setpoint_1",)),
     (["setpoint_1 [V]", "setpoint_2 [V]"], ("motor_setpoint_1", "motor_setpoint_2")),
     (["p_setpoint_1 [bar]", "p_setpoint_2 [bar]"], ("p_1_setpoint", "p_2_setpoint"))],
)  # fmt: skip
def test_a_motor_titled_as_set_point_is_named_so_once(
    tmp_path: Path, motors: list[str], channels: tuple[str, ...]
) -> None:
    columns = dict(zip(motors, (A, B), strict=False))
    write(tmp_path / "log.csv", {"time [s]": TIME, **columns, "height [mm]": ONE})
    guess = guess_robot(tmp_path / "log.csv")
    assert guess.robot.set_points == channels
    write_recording(tmp_path / "rec.csv", import_log(tmp_path / "log.csv", guess.layout).recording)
    assert read_recording(tmp_path / "rec.csv").set_points.shape == (ROWS, len(motors))
