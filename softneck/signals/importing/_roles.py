"""Roles of the columns of any robot's log: motors, measured positions and outputs, by words, units and motion."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from softneck.core import Matrix, Vector

from ._column_titles import TEMPERATURES, plain, read_title, words_of
from ._guess_shapes import correlation
from ._layout import Column
from ._table_format import SniffResult

# Words of other languages and their endings that `words_of` leaves as they are.
_TRANSLATED = {
    "druck": "pressure", "ventil": "valve", "pumpe": "pump", "kammer": "chamber", "biegung": "bending",
    "biege": "bending", "auslenkung": "deflection", "weg": "position", "hub": "stroke", "batterie": "battery",
    "umgebung": "ambient", "krummung": "curvature", "hohe": "height", "heizung": "heater", "presion": "pressure",
    "valvula": "valve", "bomba": "pump", "flexion": "flexion", "curvatura": "curvature", "bateria": "battery",
    "ambiente": "ambient", "salida": "output", "entrada": "input", "desplazamiento": "displacement",
    "calentador": "heater", "consigne": "setpoint", "commande": "command", "mesure": "measured",
    "mesuree": "measured", "pression": "pressure", "vanne": "valve", "pompe": "pump", "temps": "time",
    "courant": "current", "couple": "torque", "vitesse": "velocity", "sortie": "output", "entree": "input",
    "fleche": "deflection", "deplacement": "displacement", "erreur": "error", "courbure": "curvature",
    "chauffage": "heater", "riferimento": "reference", "comando": "command", "misura": "measured",
    "misurata": "measured", "misurato": "measured", "pressione": "pressure", "valvola": "valve", "tempo": "time",
    "corrente": "current", "tensione": "voltage", "coppia": "torque", "angolo": "angle", "posizione": "position",
    "errore": "error", "uscita": "output", "ingresso": "input", "pressao": "pressure", "tensao": "voltage",
    "erro": "error", "saida": "output", "druk": "pressure", "gemeten": "measured", "gewenst": "desired",
    "klep": "valve", "hoek": "angle", "stroom": "current", "temperatur": "temperature",
}  # fmt: skip
_COMMAND = {"cmd", "command", "commanded", "ref", "reference", "set", "setpoint", "setpoints", "sp", "target", "des",
            "desired", "goal", "demand", "input", "control", "ctrl", "cs", "manipulated"}  # fmt: skip
_MEASURED = {"meas", "measured", "measurement", "enc", "encoder", "act", "actual", "fb", "feedback", "sensor", "sensed",
             "sens", "observed", "present", "reached"}  # fmt: skip
# What a controller sends out, whatever else its title says.
_SENT = {"pwm", "duty", "valve", "pump", "heater", "voltage", "volt", "throttle", "spool", "pulse", "servovalve"}
_ACTUATOR = {"pressure", "press", "chamber", "motor", "mot", "servo", "tendon", "cable", "winch", "actuator", "muscle",
             "cylinder", "bellow", "bellows", "piston", "wire", "sma", "drive", "force", "torque"}  # fmt: skip
# Of a drive; a set-point only where nothing else is.
_LOAD = {"current", "curr", "torque", "effort", "power"}
_OUTPUT = {"flexion", "flex", "bend", "bending", "tip", "pitch", "roll", "yaw", "x", "y", "z", "displacement", "output",
           "deflection", "curvature", "level", "height", "extension", "elongation", "strain", "orientation", "tilt",
           "inclination", "theta", "phi", "pose", "stroke", "end", "effector", "ee", "marker"}  # fmt: skip
_PLATFORM = {"pitch", "roll", "yaw", "inclination", "orientation", "tilt", "azimuth"}
_RATE = {"velocity", "vel", "speed", "rate", "omega", "acc", "accel", "acceleration", "gyro"}
_ASIDE = {"temperature", "temp", "amb", "ambient", "battery", "bat", "batt", "supply", "status", "state", "flag",
          "error", "err", "deviation", "residual", "mode", "humidity", "latency", "cpu", "fault", "alarm",
          "index", "idx", "row", "counter", "count", "id"}  # fmt: skip
_WARM = {"temperature", "temp"}
_PLACE = {"position", "pos", "angle"}
# Words of which glued titles such as `Pcmd` and `Solldruck` consist, besides one leading letter.
_KNOWN = _COMMAND | _MEASURED | _SENT | _ACTUATOR | _LOAD | _OUTPUT | _RATE | _ASIDE | _PLACE | {"p"}
# `mid` is no `m` and `id`.
_GLUED = sorted((word for word in _KNOWN | set(_TRANSLATED) if len(word) > 1 and word != "id"), key=len, reverse=True)
# A measured motor follows its set-point at least so closely; a copy is equal but for the last digit.
_FOLLOWS, _DIGITS, _EQUAL = 0.5, 1e-9, 1e-3
_RATE_AGREES, _FEW_ROWS = 0.98, 20
#: How the reasons begin for columns that cannot be anything.
NOTHING_NEW = ("constant", "a copy", "exactly", "the rate")
# Of an output's variance that the motors explain: less is no response.
_LEAST_RESPONSE = 0.05
# Of a temperature where nothing else is an output: a warm motor follows its set-points less.
_HEATED = 0.5
# Lags [samples] and poles of it, and rows enough to see it.
_LAGS, _POLES, _FIT_ROWS = (0, 1, 3, 10, 30), (0.0, 0.5, 0.8, 0.9, 0.95, 0.98), 5000
# A measured motor follows its set-point through such a lag; of two motors none explains the other so well.
_TRAILS = 0.9
_MOST_ROWS, _MOST_COLUMNS, _MOST_OUTPUTS = 20_000, 40, 4


@dataclass(slots=True)
class Roles:
    """The columns of a log by role; `left_out` holds the reason for each of the others, `notes` other remarks."""

    motors: list[Column] = field(default_factory=list)
    positions: list[Column] = field(default_factory=list)
    outputs: list[Column] = field(default_factory=list)
    time: Column | None = None
    run: Column | None = None
    why: str = ""
    left_out: dict[Column, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def lines(self) -> list[str]:
        """Return a line for each column without a role."""
        return [*self.notes, *(f"left out: {column}: {why}" for column, why in self.left_out.items())]


@dataclass(frozen=True, slots=True)
class _Words:
    """What a title says: its words, number and unit, and the quantity of the unit (`Pa`, `rad`, ..., or None)."""

    words: frozenset[str]
    number: int | None
    unit: str | None
    quantity: str | None

    def any(self, *groups: set[str]) -> bool:
        return any(self.words & group for group in groups)

    @property
    def commanded(self) -> bool:
        # `u` of control theory, alone or as `train.u`; `u_bat` is a voltage.
        sent = "u" in self.words and not self.any(_OUTPUT, _ASIDE)
        return (self.any(_COMMAND) or sent) and not self.any(_MEASURED)

    @property
    def measured(self) -> bool:
        return self.any(_MEASURED)

    @property
    def sent(self) -> bool:
        of_unit = self.quantity in ("Pa", "V", "s") or self.unit == "%"
        return self.any(_SENT) or (of_unit and not self.any(_OUTPUT))

    @property
    def actuator(self) -> bool:
        return self.sent or self.any(_ACTUATOR, _LOAD) or self.quantity in ("A", "W") or self.words == {"p"}

    @property
    def place(self) -> bool:
        of_unit = self.quantity in ("rad", "m") or self.any(_PLACE)
        return self.any(_OUTPUT) or (of_unit and not self.any(_ACTUATOR))

    @property
    def load(self) -> bool:
        return self.any(_LOAD) or self.quantity == "A"

    @property
    def stem(self) -> frozenset[str]:
        return self.words - _COMMAND - _MEASURED - _PLACE

    @property
    def kind(self) -> str:
        """Columns of one robot's motors or outputs share it: the quantity, else what the words name."""
        return self.quantity or next((word for word in ("pwm", "pressure", "voltage") if word in self.words), "1")


def find_roles(table: SniffResult, named: Mapping[str, Sequence[Column]]) -> Roles:
    """Return the roles of a log's columns; `named` holds the motors, positions, outputs and time that are known."""
    found = Roles()
    given = {column for columns in named.values() for column in columns}
    said = {column: _read(table, column) for column in table.columns}
    rest = [column for column in table.columns if column not in given]
    found.time, found.run = next(iter(named["time"])) if "time" in named else _clock(table, rest), _run(rest)
    rest = [column for column in rest if column not in (found.time, found.run)]
    rows = {column: table.columns[column][:_MOST_ROWS] for column in table.columns}
    for column in [one for one in rest if not _moves(rows[one])]:
        value = rows[column][np.isfinite(rows[column])][:1]
        what = " (a command that moves nothing)" if said[column].commanded or said[column].sent else ""
        found.left_out[column] = f"constant{''.join(f' at {one:g}' for one in value)}{what}"
        rest.remove(column)
    rest = _without_copies(rows, [*given, *rest], rest, said, found)
    found.motors = list(named.get("motors", ())) or _motors(rest, said, found)
    if not named.get("motors") and not named.get("positions"):
        found.motors, found.positions = _without_trailing(found.motors, said, rows)
    rest = [column for column in rest if column not in (*found.motors, *found.positions)]
    found.positions = list(named.get("positions", ())) or found.positions or _positions(rest, said, rows, found.motors)
    rest = [column for column in rest if column not in found.positions]
    found.outputs = list(named.get("outputs", ())) or _outputs(rest, said, rows, found)
    if not found.outputs and found.positions and not named.get("positions"):
        found.outputs, found.positions = found.positions[:_MOST_OUTPUTS], []
    _tell(rest, said, found)
    return found


def _read(table: SniffResult, column: Column) -> _Words:
    if isinstance(column, int):
        return _Words(frozenset(), None, None, None)
    title = table.title(column)
    words = {part for word in title.family.split() for part in _split(word)}
    words |= {"temp"} if plain(title.written) in TEMPERATURES else set()
    words -= {"supply"} if words & _COMMAND else set()
    return _Words(frozenset(words), title.motor, title.unit, None if title.unit == "1" else title.quantity or None)


def _split(word: str) -> list[str]:
    """Return the known words of which a word is made, in English, or the word itself: `pcmd` is `p` and `cmd`."""
    if word in _KNOWN or word in _TRANSLATED:
        return [_TRANSLATED.get(word, word)]
    for start in (0, 1):
        rest, parts = word[start:], list(word[:start])
        while rest and (part := next((one for one in _GLUED if rest.startswith(one)), None)):
            parts.append(part)
            rest = rest[len(part) :]
        if not rest and len(parts) > start:
            return [english for part in parts for english in words_of(_TRANSLATED.get(part, part))]
    return [word]


def names_a_place(table: SniffResult, column: Column) -> bool:
    """Return whether the title of a column names an output that is no angle of a neck."""
    w = _read(table, column)
    return w.any(_OUTPUT) and not w.any(_PLATFORM)


def may_be_motor(table: SniffResult, column: Column) -> bool:
    """Return whether no word or unit speaks against a column as a motor's."""
    w = _read(table, column)
    return not (w.place or w.any(_ASIDE, _RATE, _PLATFORM))


def _clock(table: SniffResult, columns: Iterable[Column]) -> Column | None:
    """Return the column of time: named or with a unit of time, else without a title; it rises."""
    found: list[tuple[float, Column]] = []
    for column in columns:
        values = table.columns[column]
        step = np.diff(values)
        if step.size < 2 or not np.isfinite(step).all():
            continue
        title = table.title(column)
        named = title.role == "time" or column in table.dates or title.written in ("s", "ms", "us", "ns")
        rising = float((step > 0).mean())
        if (named and rising > 0.5) or (isinstance(column, int) and (step > 0).all()):
            found.append((rising, column))
    return max(found, key=lambda one: one[0])[1] if found else None


def _run(columns: Iterable[Column]) -> Column | None:
    return next((column for column in columns if read_title(str(column)).role == "run"), None)


def _moves(values: Vector) -> bool:
    present = values[np.isfinite(values)]
    return present.size > 0 and float(np.ptp(present)) > 0.0


def _without_copies(
    rows: Mapping[Column, Vector], every: Sequence[Column], free: Sequence[Column], said: Mapping[Column, _Words],
    found: Roles,
) -> list[Column]:  # fmt: skip
    """Return the free columns without copies, sums and differences of others; commands are named and kept."""
    moving = [column for column in every if _moves(rows[column])][:_MOST_COLUMNS]
    kept: list[Column] = [column for column in moving if column not in free]
    for column in sorted((one for one in moving if one in free), key=lambda one: said[one].any(_ASIDE)):
        same = next((other for other in kept if _close(rows[column], rows[other])), None)
        if same is not None:
            found.left_out[column] = f"a copy of {same}"
            continue
        parts = next((pair for pair in itertools.combinations(kept, 2) if _is_sum(rows, column, pair, said)), None)
        if parts is not None:
            first, second = parts
            if _close(rows[column], rows[first] + rows[second]):
                what = f"exactly {first} plus {second}"
            else:
                first, second = parts if _close(rows[column], rows[first] - rows[second]) else parts[::-1]
                what = f"exactly {first} minus {second}"
            if not (said[column].commanded or said[column].sent):
                found.left_out[column] = what
                continue
            found.notes.append(f"{column}: {what}")
        kept.append(column)
    return [column for column in free if column in kept]


def _is_sum(
    rows: Mapping[Column, Vector], column: Column, pair: tuple[Column, Column], said: Mapping[Column, _Words]
) -> bool:
    if len({said[one].kind for one in (column, *pair)}) > 1:
        return False
    c, a, b = (rows[one] for one in (column, *pair))
    return any(_close(c[:50], s[:50]) and _close(c, s) for s in (a + b, a - b, b - a))


def _close(a: Vector, b: Vector) -> bool:
    """Return whether two columns are equal but for the last digits that a log prints."""
    if not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return False
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    # Sums of rounded numbers are off by their last digit: 1e-4 of the motion is 14 bits of a sensor.
    return a.size > 2 and float(np.abs(a - b).max()) <= max(1e-4 * float(np.ptp(a)), _DIGITS * float(np.abs(a).max()))


def _motors(rest: Sequence[Column], said: Mapping[Column, _Words], found: Roles) -> list[Column]:
    """Return the columns of set-points: of commands those of actuators, else what is sent to or measured of one."""

    def those(keep: Callable[[_Words], bool]) -> list[Column]:
        return [one for one in rest if not said[one].any(_ASIDE, _RATE) and keep(said[one])]

    commands = those(lambda w: w.commanded and not w.any(_PLATFORM))
    of_actuators = [one for one in commands if said[one].actuator]
    sent = those(lambda w: w.sent and not w.commanded and not w.measured and not w.load)
    other = those(lambda w: w.actuator and not w.commanded and not w.measured)
    measured = those(lambda w: w.actuator and w.measured)
    for columns, why in (
        (of_actuators, "titled as commands"),
        (sent, "sent to actuators by their titles or units"),
        (commands, "titled as commands"),
        ([one for one in other if not said[one].load] or other, "titled as actuators"),
        (measured, "measured, as no set-points were logged"),
    ):
        if columns:
            found.why = why
            kinds = {said[one].kind for one in columns if said[one].any(_SENT)}
            return _most([one for one in columns if said[one].kind in kinds] or columns, said)
    return []


def _without_trailing(
    motors: list[Column], said: Mapping[Column, _Words], rows: Mapping[Column, Vector]
) -> tuple[list[Column], list[Column]]:
    """Return set-points and positions that no title tells apart: each of one half trails one of the other."""
    if len(motors) % 2 or any(said[one].commanded for one in motors):
        return motors, []
    values = {one: _filled(rows[one]) for one in motors}
    leader: dict[Column, Column] = {}
    for one, other in itertools.permutations(motors, 2):
        if one in leader or other in leader or correlation(values[other], values[one]) < _FOLLOWS:
            continue
        after, before = _response(values[one], values[other][:, None]), _response(values[other], values[one][:, None])
        earlier = motors.index(other) < motors.index(one)
        if after >= _TRAILS and (after > before + _EQUAL or (abs(after - before) <= _EQUAL and earlier)):
            leader[one] = other
    lead = [one for one in motors if one in leader.values() and one not in leader]
    if len(lead) != len(leader) or 2 * len(lead) != len(motors):
        return motors, []
    follower = {first: one for one, first in leader.items()}
    return lead, [follower[one] for one in lead]


def _positions(
    rest: Sequence[Column], said: Mapping[Column, _Words], rows: Mapping[Column, Vector], motors: Sequence[Column]
) -> list[Column]:
    """Return the measured position of each motor, or none."""
    found: list[Column] = []
    for motor in motors:
        w = said[motor]
        alike = [one for one in rest if one not in found and not said[one].commanded and _pairs(w, said[one])]
        scores = {one: abs(correlation(_filled(rows[motor]), _filled(rows[one]))) for one in alike}
        best = max(scores, key=lambda one: scores[one], default=None)
        if best is None or scores[best] < _FOLLOWS:
            return []
        found.append(best)
    return found


def _pairs(command: _Words, other: _Words) -> bool:
    """Return whether the titles may be of one motor's set-point and position."""
    if not command.words or not other.words:
        return False
    if other.any(_ASIDE, _RATE) or command.kind != other.kind or command.number != other.number:
        return False
    return command.stem == other.stem or (bool(other.any(_MEASURED, _ACTUATOR)) and not other.any(_OUTPUT))


def _outputs(
    rest: Sequence[Column], said: Mapping[Column, _Words], rows: Mapping[Column, Vector], found: Roles
) -> list[Column]:
    """Return the columns that follow the motors: places and angles, else what has no other role, else sensors."""
    free = [one for one in rest if not said[one].any(_ASIDE, _RATE) and not said[one].commanded]
    free = [one for one in free if not _is_rate(one, free, rows, found)]
    places = [one for one in free if said[one].place]
    plain_ones = [one for one in free if not said[one].actuator and not said[one].load]
    sensors = [one for one in free if said[one].any({"force", "torque", "level"}) or said[one].quantity == "N"]
    inputs = np.column_stack([_filled(rows[one]) for one in found.motors]) if found.motors else None
    tiers = [tier for tier in (places, plain_ones, sensors, [one for one in free if said[one].measured]) if tier]
    if not tiers and inputs is not None:  # a plate that is heated, not a warm motor
        warm = [one for one in rest if said[one].any(_WARM) and _response(_filled(rows[one]), inputs) >= _HEATED]
        return _most(warm, said)[:_MOST_OUTPUTS] if warm else []
    for columns in tiers:
        answers = {one: 1.0 if inputs is None else _response(_filled(rows[one]), inputs) for one in columns}
        follow = [one for one in columns if answers[one] >= _LEAST_RESPONSE]
        if follow:
            found.left_out |= {one: "does not follow the motors" for one in columns if one not in follow}
            best = _most(follow, said)
            strongest = sorted(best, key=lambda one: -answers[one])[:_MOST_OUTPUTS]
            return [one for one in best if one in strongest]
    if tiers:
        found.notes.append("no column follows the motors within 30 samples; the outputs follow from titles alone")
    return _most(tiers[0], said)[:_MOST_OUTPUTS] if tiers else []


def _most(columns: Sequence[Column], said: Mapping[Column, _Words]) -> list[Column]:
    """Return the columns of the quantity that most have, the first of equals."""
    groups: dict[str, list[Column]] = {}
    for one in columns:
        groups.setdefault(said[one].kind, []).append(one)
    return max(groups.values(), key=len)


def _is_rate(one: Column, free: Sequence[Column], rows: Mapping[Column, Vector], found: Roles) -> bool:
    """Return whether a column is the rate of another; of a circle each coordinate is that of the other."""
    y = _filled(rows[one])
    for other in free if y.size > _FEW_ROWS else ():
        x = _filled(rows[other])
        if other != one and abs(correlation(np.gradient(x), y)) > _RATE_AGREES > abs(correlation(np.gradient(y), x)):
            found.left_out[one] = f"the rate of {other}"
            return True
    return False


def _filled(values: Vector) -> Vector:
    present = np.isfinite(values)
    return np.where(present, values, values[present].mean())


def _response(y: Vector, inputs: Matrix) -> float:
    """Return the share of the variance of `y` (time,) that `inputs` (time, motors) explain through a lag."""
    from scipy.signal import lfilter

    best, inputs, y = 0.0, inputs[:_FIT_ROWS], y[:_FIT_ROWS]
    for lag, pole in itertools.product(_LAGS, _POLES):
        if y.size < lag + 2 * inputs.shape[1] + 2:
            return max(best, float(lag == 0))  # too few rows to tell
        X = np.asarray(lfilter([1.0 - pole], [1.0, -pole], inputs - inputs[0], axis=0))[: len(inputs) - lag]
        X, e = X - X.mean(axis=0), y[lag:] - y[lag:].mean()
        power = float(e @ e)
        left = e - X @ np.linalg.lstsq(X, e, rcond=1e-9)[0]
        best = max(best, 1.0 - float(left @ left) / power if power > 0 else 0.0)
    return best


def _tell(rest: Sequence[Column], said: Mapping[Column, _Words], found: Roles) -> None:
    """Add a line for each column that has no role and no line yet."""
    roles = (*found.motors, *found.positions, *found.outputs)
    for column in rest:
        if column in roles or column in found.left_out:
            continue
        w = said[column]
        if w.any(_ASIDE):
            why = f"'{min(w.words & _ASIDE)}' is neither motor nor output"
        elif w.commanded:
            why = "a reference of an output, or a command in another unit than the motors'"
        elif w.any(_RATE):
            why = "a rate"
        elif w.load or w.actuator:
            why = "a quantity of the actuators that pairs with no motor's set-point"
        elif w.place and found.outputs and w.kind != said[found.outputs[0]].kind:
            why = f"of another quantity than {found.outputs[0]}, and outputs have one unit; --output names it instead"
        else:
            why = "neither motor nor output by title and unit"
        found.left_out[column] = why
