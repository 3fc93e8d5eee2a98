"""Frequency responses: circles that hold the truth, noise and distortion told apart, loops."""

from __future__ import annotations

from pathlib import Path

import control
import numpy as np
import pytest
from scipy import signal as scipy_signal

from softneck.core import DataError, Matrix, SettingsError, Vector
from softneck.identification import FrequencyResponse, OutputError, frequency_response
from softneck.identification.uncertainty._local_polynomial import local_polynomial, spectrum
from softneck.plant import NeckParameters, VirtualNeck, record
from softneck.robot import Robot
from softneck.signals import (
    Recording,
    concatenate,
    motors_from,
    multisine_experiments,
    redefine,
    signal,
    write_recording,
)

TS = 0.02
S = control.TransferFunction([1.0, 0.0], [1.0])


def axis(gain: float, poles: tuple[float, ...], delay: int) -> control.TransferFunction:
    """Return a plant of one, two or three poles [1/s], held and sampled, with a dead time in samples."""
    G = gain * np.prod([p / (S + p) for p in poles])
    return control.sample_system(G, TS, "zoh") * control.TransferFunction([1.0], [1.0, *[0.0] * delay], TS)


# Pitch from theta_i, roll from phi_i, and what each leaks into the other.
PLANT = [[axis(0.09, (5.0,), 3), axis(0.02, (3.0,), 1)], [axis(0.01, (6.0,), 2), axis(0.1, (4.0, 30.0, 60.0), 4)]]


def answers(inputs: Matrix) -> Matrix:
    """Return pitch and roll (time, 2) of the plant at rest before."""
    columns = [sum(run(PLANT[i][j], inputs[:, j]) for j in range(2)) for i in range(2)]
    return np.column_stack(columns)


def run(G: control.TransferFunction, u: Vector) -> Vector:
    numerator, denominator = G.num[0][0], G.den[0][0]
    padded = np.concatenate([np.zeros(denominator.size - numerator.size), numerator])
    return np.asarray(scipy_signal.lfilter(padded, denominator, u))


def truth(w: Vector) -> np.ndarray:
    z = np.exp(1j * w * TS)
    return np.moveaxis(np.array([[G(z) for G in row] for row in PLANT]), 2, 0)


def recording(inputs: Matrix, outputs: Matrix, **more: Vector) -> Recording:
    motors = motors_from(np.column_stack([inputs, np.zeros(len(inputs))]))
    channels = {f"motor_setpoint_{j + 1}": motors[:, j] for j in range(3)}
    channels |= {"pitch": outputs[:, 0], "roll": outputs[:, 1], **more}
    return Recording(np.arange(len(inputs)) * TS, TS, channels)


def played(seed: int, *, noise: float = 0.005, **how: object) -> list[Recording]:
    """Return multisine experiments on the linear plant."""
    rng = np.random.default_rng(seed)
    parts = []
    for item in multisine_experiments(seed=seed, **how):  # pyright: ignore[reportArgumentType]
        inputs = redefine(item.set_points)[:, :2]
        parts.append(recording(inputs, answers(inputs) + noise * rng.standard_normal((len(inputs), 2))))
    return parts


def share_within(found: FrequencyResponse) -> float:
    return float((np.abs(found.response - truth(found.frequency)) <= found.radius()).mean())


def test_circles_of_multisines_hold_the_truth_as_often_as_they_say() -> None:
    found = [frequency_response(played(seed)) for seed in range(10)]
    assert {item.method for item in found} == {"robust"}
    # 1,320 circles of 95 %; those of one draw move together, so 0.92 to 0.98 and not 0.938 to 0.962.
    assert 0.92 < np.mean([share_within(item) for item in found]) < 0.98


def test_circles_of_any_excitation_hold_the_truth_as_often_as_they_say() -> None:
    w = np.geomspace(0.3, 20.0, 12)
    G, held = truth(w), []
    for seed in range(12):
        u = redefine(signal("aprbs", seed=seed, duration=60.0).set_points)[:, :2]
        y = answers(u) + 0.02 * np.random.default_rng(seed).standard_normal(u.shape)
        found = local_polynomial([spectrum(u, y, TS)], w, 2)
        item = FrequencyResponse(
            sample_time=TS, robot=Robot.preset(), inputs=("theta_i", "phi_i"), method="local polynomials", frequency=w,
            response=found.response, covariance=found.covariance, freedom=found.freedom, coherence=found.coherence,
            noise=np.full(G.shape, np.nan), amplitude=np.ones(2),
        )  # fmt: skip
        held.append(float((np.abs(item.response - G) <= item.radius()).mean()))
    # 576 circles in 12 draws: as above, a little wider.
    assert 0.90 < np.mean(held) < 0.98


def test_a_clean_recording_gives_the_plant() -> None:
    found = frequency_response(played(0, noise=0.0))
    # What is left of the transient after one period of 12.6 s, a time constant of 0.33 s.
    np.testing.assert_allclose(found.response, truth(found.frequency), atol=1e-9)


def test_one_input_agrees_with_welch() -> None:
    rng = np.random.default_rng(3)
    u = np.column_stack([rng.standard_normal(20_000), np.zeros(20_000)])
    y = answers(u) + 0.001 * rng.standard_normal(u.shape)
    found = frequency_response(recording(u, y))
    assert found.inputs == ("theta_i",)
    f, p_uy = scipy_signal.csd(u[:, 0], y[:, 0], 1.0 / TS, nperseg=1024)
    _, p_uu = scipy_signal.welch(u[:, 0], 1.0 / TS, nperseg=1024)
    band = (found.frequency > 1.0) & (found.frequency < 20.0)
    theirs = np.interp(found.frequency[band], 2.0 * np.pi * f, np.abs(p_uy / p_uu))
    # Welch's window of 20 s biases it by a few thousandths, and 39 averages leave as much noise.
    np.testing.assert_allclose(np.abs(found.response[band, 0, 0]), theirs, rtol=0.03)


def test_noise_and_nonlinear_distortion_are_told_apart() -> None:
    linear = frequency_response(played(1, realisations=8))
    ratio = np.median(linear.noise / linear.variance())
    # Nothing but noise: both say the same, each from few degrees of freedom.
    assert 0.6 < ratio < 1.6
    bent = []
    for item in multisine_experiments(amplitude=2.0, realisations=8):
        u = redefine(item.set_points)[:, :2]
        bent.append(recording(u, answers(u + 0.1 * u**3)))
    found = frequency_response(bent)
    # A cube scatters over realisations and repeats itself over periods.
    assert np.max(found.noise[:, 0, 0] / found.variance()[:, 0, 0]) < 1e-6
    # The gain of the best linear approximation of u + 0.1 u^3 over Gaussian inputs is 1 + 0.3 var(u) (Bussgang).
    gain = np.abs(found.response[:, 0, 0] / truth(found.frequency)[:, 0, 0])
    # 33 lines are not quite Gaussian, 8 realisations scatter by 1 %.
    assert np.median(gain) == pytest.approx(1.0 + 0.3 * float(found.amplitude[0]) ** 2 / 2.0, rel=0.03)


def test_a_closed_loop_with_its_reference_gives_the_plant_where_the_inputs_alone_do_not() -> None:
    rng = np.random.default_rng(4)
    rows = 8000
    r = np.repeat(rng.uniform(-0.1, 0.1, (rows // 40, 2)), 40, axis=0)
    disturbance = np.asarray(scipy_signal.lfilter([0.01], [1.0, -0.95], rng.standard_normal((rows, 2)), axis=0))
    u, y, state = np.zeros((rows, 2)), np.zeros((rows, 2)), np.zeros(2)
    # The diagonal plant in differences, the loop closed by PI: one pole and three samples each.
    a, b = np.exp(-5.0 * TS), 0.09 * (1.0 - np.exp(-5.0 * TS))
    x = np.zeros(2)
    for k in range(rows):
        y[k] = x + disturbance[k]
        state += 0.3 * (r[k] - y[k])
        u[k] = 4.0 * (r[k] - y[k]) + state
        x = a * x + b * (u[k - 3] if k >= 3 else 0.0)
    logged = {"pitch_reference": r[:, 0], "roll_reference": r[:, 1]}
    found = frequency_response(recording(u, y, **logged))
    assert "closed_loop" in found.findings
    # Without the reference the loop's own noise speaks: the more it is, the nearer the answer to -1/K.
    direct = frequency_response(recording(u, y))
    held = []
    for item in (found, direct):
        near = (item.frequency > 0.5) & (item.frequency < 8.0)
        z = np.exp(1j * item.frequency[near] * TS)
        G = b / (z - a) / z**3
        held.append((np.abs(item.response[near, 0, 0] - G) <= item.radius()[near, 0, 0]).mean())
    # Some fifty circles of one draw: 95 % of them within about a tenth.
    assert held[0] > 0.85
    assert held[1] < 0.5


def test_one_sine_is_refused_with_what_to_record() -> None:
    wave = 0.5 * np.tile(np.cos(2.0 * np.pi * np.arange(314) / 314), 12)
    parts = [recording(u, 0.1 * np.sign(np.round(u, 12))) for u in (np.outer(wave, [1, 0]), np.outer(wave, [0, 1]))]
    with pytest.raises(DataError, match="one sine shows no linear response; record `multisine` with a band"):
        frequency_response(parts)


def test_what_is_called_supported_is_right_and_it_says_where_that_ends() -> None:
    u = redefine(signal("eq22", duration=140.0).set_points)[:, :2]
    y = answers(u) + 0.01 * np.random.default_rng(0).standard_normal(u.shape)
    found = frequency_response(recording(u, y))
    band = found.band("pitch", "theta_i")
    assert band is not None
    # Its carriers turn at 1 rad/s and its envelope at 4 at most: nothing that a controller crosses at 15 is told.
    assert band[0] < 1.0
    assert 4.0 < band[1] < 15.0
    G = truth(found.frequency)[:, 0, 0]
    wrong = np.abs(found.response[:, 0, 0] - G) > 0.3 * np.abs(G)
    # One in twenty may be, by the 95 %.
    assert wrong[found.supported("pitch", "theta_i")].mean() <= 0.05


def test_what_was_not_excited_is_not_a_number() -> None:
    found = frequency_response(played(2, noise=0.0, band=(1.0, 4.0), realisations=1))
    high = found.frequency > 30.0
    assert found.method == "local polynomials"
    assert np.isnan(found.response[high]).all()
    assert (found.frd("pitch").frequency < 30.0).all()


def test_python_control_takes_it() -> None:
    found = frequency_response(played(5))
    frd = found.frd("roll")
    assert (frd.input_labels, frd.output_labels, frd.dt) == (["phi_i"], ["roll"], TS)
    np.testing.assert_array_equal(frd.frdata[0, 0], found.response[:, 1, 1])
    assert found.frd().frdata.shape == (2, 2, found.frequency.size)


@pytest.mark.parametrize("robot", ["antagonist", "trunk4", "finger"])
def test_experiments_for_any_robot_stay_within_their_size_and_repeat(robot: str) -> None:
    whose = Robot.preset(robot)
    items = multisine_experiments(amplitude=0.7, band=(0.5, 10.0), realisations=2, robot=whose)
    weights = whose.weights()
    assert weights is not None
    assert len(items) == 2 * weights.shape[0]
    for item in items:
        # The largest value of all is the amplitude; of each experiment, at most.
        assert np.abs(item.set_points @ weights.T).max() <= 0.7 * (1.0 + 1e-12)
        period = len(item.set_points) // 3
        np.testing.assert_array_equal(item.set_points[:period], item.set_points[period : 2 * period])
    assert max(np.abs(item.set_points @ weights.T).max() for item in items) == pytest.approx(0.7)


def test_experiments_of_a_realisation_are_orthogonal_at_each_line() -> None:
    first, second = (redefine(item.set_points)[:, :2] for item in multisine_experiments(realisations=1))
    U = np.stack([np.fft.fft(part[: len(part) // 3], axis=0)[1:51] for part in (first, second)], axis=2)
    excited = np.abs(U[:, 0, 0]) > 1e-6 * np.abs(U).max()
    gram = U[excited] @ np.conj(np.swapaxes(U[excited], 1, 2))
    # Rounding of the transform.
    assert np.abs(gram[:, 0, 1]).max() < 1e-9 * np.abs(gram[:, 0, 0]).max()


def test_bad_input_is_named() -> None:
    good = played(0, realisations=1)
    still = recording(np.zeros((300, 2)), np.zeros((300, 2)))
    rng = np.random.default_rng(0)
    u = rng.standard_normal((300, 2))
    y = answers(u)
    holes = y.copy()
    holes[::5] = np.nan
    with pytest.raises(DataError, match="no input moves"):
        frequency_response(still)
    with pytest.raises(DataError, match=r"run 0 has 150 rows; a frequency response of what is not periodic needs 200"):
        frequency_response(recording(u[:150], y[:150]))
    with pytest.raises(DataError, match="20 % of a channel's samples are missing, more than 10 %"):
        frequency_response(recording(u, holes))
    with pytest.raises(DataError, match="recorded in a closed loop whose reference rests"):
        frequency_response(recording(u, y, pitch_reference=np.zeros(300)))
    with pytest.raises(DataError, match="without its reference: log `pitch_reference`"):
        frequency_response(recording(u, y, innovation=np.zeros(300)))
    with pytest.raises(DataError, match=r"2 inputs move and 1 reference\(s\)"):
        frequency_response(recording(u, y, pitch_reference=u[:, 0]))
    with pytest.raises(DataError, match=r"sizes differ by a factor of 4: .*; make one response of each size"):
        frequency_response([*good, *played(1, amplitude=4.0, realisations=1)])
    with pytest.raises(DataError, match="there is no recording to work on"):
        frequency_response([])
    with pytest.raises(SettingsError, match=r"`band` must rise within .* a quarter of the sampling rate; got 5,2"):
        multisine_experiments(band=(5.0, 2.0))


def test_runs_are_never_joined() -> None:
    parts = played(6)
    apart, together = frequency_response(parts), frequency_response(concatenate(parts))
    np.testing.assert_array_equal(apart.response, together.response)


def test_pressures_and_lengths_are_shown_in_their_units() -> None:
    robot = Robot.from_dict({
        "name": "bellows", "sample_time_s": TS, "motors": {"names": ["p"], "unit": "bar"},
        "outputs": {"names": ["x"], "unit": "mm"}, "directions": {"kind": "matrix", "matrix": [[1.0]]},
    })  # fmt: skip
    parts = []
    for item in multisine_experiments(amplitude=2.0, realisations=2, robot=robot):
        # 3 mm/bar at rest.
        x = 3e-8 * run(axis(1.0, (5.0,), 2), item.set_points[:, 0])
        parts.append(Recording(item.time, TS, {"motor_setpoint_1": item.set_points[:, 0], "x": x}, robot=robot))
    found = frequency_response(parts)
    said, slowest = found.summary(), 3.0 * abs(5.0 / (5.0 + 0.5j))
    # Three digits are printed; the period is a whole number of samples.
    assert f"0.50 rad/s: {slowest:.3g} +-" in said
    assert "mm/bar" in said
    assert found.amplitude[0] > 0.0
    assert f"x_input {1e-5 * found.amplitude[0]:.2g};" in said


def test_motors_that_were_not_always_logged_are_filled_and_not_zero() -> None:
    u = np.repeat(np.random.default_rng(0).standard_normal((60, 2)), 10, axis=0)
    y = answers(u)
    whole = recording(u, y)
    motors = {f"motor_position_{j + 1}": whole.set_points[:, j].copy() for j in range(3)}
    for values in motors.values():
        values[5::50] = np.nan  # in the middle of a level, so that a straight line is the level
    found = frequency_response(whole.with_channels(**motors), source="positions")
    np.testing.assert_allclose(found.response, frequency_response(whole).response, atol=1e-12)
    assert found.findings["missing"].startswith("12 rows")


@pytest.mark.slow
def test_a_response_of_files_is_drawn_and_described(tmp_path: Path) -> None:
    neck = VirtualNeck(NeckParameters.paper())
    parts = [
        record(item, neck, seed=i)
        for i, item in enumerate(multisine_experiments(amplitude=0.4, band=(1.0, 12.0), realisations=2))
    ]
    write_recording(tmp_path / "m.csv", concatenate(parts))
    found = frequency_response(tmp_path / "m.csv")
    assert (found.method, *map(found.own_input, found.outputs)) == ("robust", "theta_i", "phi_i")
    low, high = found.band("pitch", "theta_i") or (0.0, 0.0)
    assert 1.0 <= low < high <= 12.1
    figure = found.plot(models={"oe": OutputError().fit(concatenate(parts))})
    assert figure.get_suptitle() == "theta_i to pitch"
    assert figure.axes[0].get_legend_handles_labels()[1] == ["95 %", "data", "oe"]
    assert "supported from" in found.summary()
    with pytest.raises(DataError, match="f: only a linear model or a family has a response to draw"):
        found.plot(models={"f": found})
