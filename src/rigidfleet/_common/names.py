"""Names of columns that people use, and units: which quantity a column has, of which vehicle."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

Dimension = str  # time, length, angle or quotients of them
#: Units by dimension and factor to s, m and rad.
_UNITS = {
    "time": {1.0: "s sec secs second", 1e-3: "ms msec millis millisecond", 1e-6: "us usec microsecond",
             1e-9: "ns nsec nsecs nanosec nanosecond", 60.0: "min", 3600.0: "h hour"},
    "length": {1.0: "m metre meter", 1e-3: "mm millimetre millimeter", 1e-2: "cm centimetre centimeter", 1e3: "km",
               0.1: "dm", 1e-6: "um micron", 0.3048: "ft feet", 0.9144: "yd yard", 0.0254: "in inch"},
    "angle": {1.0: "rad radian", math.radians(1.0): "deg degree"},
}  # fmt: skip
_UNIT = {
    word: (dimension, factor)
    for dimension, units in _UNITS.items()
    for factor, words in units.items()
    for word in words.split()
}
#: Axis and sign of each direction, from east, north and up; and names of columns after directions.
AXES = {"e": (0, 1.0), "w": (0, -1.0), "n": (1, 1.0), "s": (1, -1.0), "u": (2, 1.0), "d": (2, -1.0)}
DIRECTIONS = {name: name[0] for name in ("north", "east", "south", "west", "down", "up")}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]+")
_AXIS = re.compile(r"(pos|vel|acc|[ptvajq])?([xyzw])")
_HUE = re.compile(r"(?:led|diffuse|colou?r|rgb)?[ _.]*(r|g|b)(?:ed|reen|lue)?")
_WORDS = {
    # Beside an axis: a place, a velocity, an acceleration, a jerk, a quaternion; or none of them.
    "": "p t pos position pose translation location coordinate point local world global odom map rs r wb estimate "
        "field msg data transform state",
    "v": "v vel velocity twist linear", "a": "a acc acceleration", "j": "j jerk",
    "q": "q quat quaternion orientation rotation attitude",
    "none": "std var cov covariance err error sigma noise rate offset min max mean limit size scale omega angular "
            "gyro mag torque force thrust gyr ang euler rpy bias w b",
    "wanted": "ref reference setpoint sp target desired des cmd command goal",
    "source": "true truth gt groundtruth est estimated meas measured actual raw filtered ekf kf gps gnss rtk mocap "
        "vicon optitrack qualisys vio slam uwb",
    "time": "t time timestamp stamp sec secs second seconds elapsed datetime nsec nsecs nanosec clock",
    "time too": "header sim field ros utc unix epoch date since start relative rel log of posix world in boot",
    "agent": "agent drone vehicle uav uas robot cf crazyflie quad quadrotor quadcopter copter aircraft plane body "
             "rigid track sysid mav uri callsign tail craft bot ship rover",
    "thing": "id name uid uuid object marker label ns namespace child entity node tag target device model actor "
             "player serial instance hostname key",
    "thing too": "no nr num number system frame index idx subject",
    "yaw": "yaw psi", "colour": "color colour rgb hex led", "height": "alt altitude height elevation",
    "latitude": "lat latitude", "longitude": "lon lng long longitude",
}  # fmt: skip
#: Frames by their names, and where x, y and z point; forward, left, up and forward, right, down are not turned.
_FRAMES = {"enu": "enu", "ned": "ned", "nwu": "nwu", "neu": "neu", "flu": "enu", "frd": "esd"}
_IS = {kind: frozenset(words.split()) for kind, words in _WORDS.items()}
_ABBREVIATED = {"pos": "", "p": "", "t": "", "vel": "v", "acc": "a"}
#: Variables of Crazyflie's logs, by which cfclient names columns beside times in milliseconds: in m or mm, and degrees.
CRAZYFLIE = re.compile(r"stateEstimate(Z?)\.(v?)([xyz]|yaw)")
#: Words for places that are wanted.
WANTED = _IS["wanted"]
#: Words by which places of one vehicle differ, where several have no other name.
SOURCE_WORDS = _IS["source"]
#: Words for places that are wanted, or for no places, beside those of a vehicle.
ROLES = _IS["none"] - {"w", "b"} | WANTED
#: A letter alone, and what a quantity is nothing without: an acceleration without a velocity, ...
_LETTER, _AFTER = r"(?<![^\W_])[a-z]\d*(?![^\W_])", {"a": "vx", "j": "ax", "q": "qw"}
_HUES = {"r": "red", "g": "green", "b": "blue"}
_DIMENSIONS = {"": "length", "v": "length/time", "a": "length/time2", "j": "length/time3"}


class ColumnMeaning(NamedTuple):
    """What a name of a column says.

    Attributes
    ----------
    kind : time; x, y, z, or a direction; vx, ax, jx, qx, ...; yaw, yaw_rate; agent or thing (names of vehicles, or
        perhaps of other things); red, green, blue, colour; latitude, longitude; duration, x^0, ...; "" if it is not
        understood
    unit : as it is written; "" without one
    who : the vehicle, if the name has one (``drone1_x``)
    """

    kind: str
    unit: str = ""
    who: str = ""

    @property
    def dimension(self) -> str:
        """Dimension of the quantity: time, length, angle or quotients of them; "" for names and the like."""
        if place := re.fullmatch(r"([vaj]?)[xyz]", self.kind):
            return _DIMENSIONS[place[1]]
        special = {"time": "time", "duration": "time", "yaw": "angle", "yaw_rate": "angle/time"}
        return "length" if self.kind in (*DIRECTIONS, "height") else special.get(self.kind, "")


def unit_of(text: str) -> tuple[Dimension, float] | None:
    """Dimension of a unit, and its factor to s, m and rad; None if it is unknown."""
    plain = text.strip().lower().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    known = _UNIT.get(plain) or (_UNIT.get(plain.rstrip("s")) if len(plain) > 3 else None)
    parts = re.fullmatch(r"([a-z]+)[/_ *·]+([a-z]+)\^?-?(\d?)", plain)
    if known or parts is None or parts[1] not in _UNIT or parts[2] not in _UNIT:
        return known
    (above, factor), (below, divisor) = _UNIT[parts[1]], _UNIT[parts[2]]
    power = int(parts[3] or 1)
    return f"{above}/{below}{power if power > 1 else ''}", factor / divisor**power


@cache
def meaning_of(name: str) -> ColumnMeaning:
    """The quantity, unit and vehicle of a column's name; kept, as a file's names are asked for several times."""
    if own := CRAZYFLIE.fullmatch(name):
        unit = "deg" if own[3] == "yaw" else ("mm" if own[1] else "m") + "/s" * bool(own[2])
        return ColumnMeaning(own[2] + own[3], unit)
    if bracket := re.fullmatch(r"(.*?)\s*[\[(](.*?)[\])]\s*", name):
        if bracket[2].strip().lower() in {*_FRAMES} | _IS["time too"] - {"in"} | _IS[""]:
            return _meaning_without_unit(f"{bracket[1]}_{bracket[2]}")
        plain = _meaning_without_unit(bracket[1])
        return plain._replace(unit=bracket[2].strip()) if plain.kind else plain
    plain, parts = _meaning_without_unit(name), re.split(r"[_.]", name)
    for cut in (2, 1) if not plain.kind or plain.who else ():
        unit, short = "_".join(parts[-cut:]), _meaning_without_unit("_".join(parts[:-cut]))
        if (known := unit_of(unit)) and known[0] == short.dimension:
            return short._replace(unit=unit)
    return plain


def _meaning_without_unit(name: str) -> ColumnMeaning:
    """The quantity and vehicle of a name without a unit."""
    plain = name.strip().lower().replace(" ", "")
    words = [word.lower() for word in _WORD.findall(name)]
    every = {*words}
    if re.fullmatch(r"duration|(x|y|z|yaw)\^[0-7]", plain):
        return ColumnMeaning(plain)
    bare = [word.removesuffix("ing") for word in words if word not in _IS[""]]
    for way in DIRECTIONS:
        letters = ([way[0]], ["p" + way[0]]) if way[0] in "neud" else ()
        if bare in letters or (way in bare and {*bare} <= {way, *"xyz"}):
            return ColumnMeaning(way)
    units = [word for word in words if (unit_of(word) or ("",))[0] == "time"]
    alone = len(words) == len(units) == 1 and len(plain) > 1 and plain not in ("min", "ns", "us")
    if (every & _IS["time"] or alone) and every <= _IS["time"] | _IS["time too"] | {*units}:
        return ColumnMeaning("time", units[-1] if units else "")
    named = _IS["agent"] | _IS["thing"]
    if every & named and every <= named | _IS["thing too"]:
        return ColumnMeaning("agent" if every & _IS["agent"] else "thing")
    if hue := _HUE.fullmatch(plain):
        return ColumnMeaning(_HUES[hue[1]])
    for kind in ("colour", "latitude", "longitude", "height"):
        if words and (every <= _IS[kind] or (words[-1] == kind and kind != "height")):
            return ColumnMeaning(kind)
    frames = [_FRAMES[word] for word in words if word in _FRAMES]
    words = [word for word in words if word not in _FRAMES]
    for k in (len(words) - 1, 0) if words else ():
        rest = words[:k] + words[k + 1 :]
        beside = {*rest}
        if words[k] in _IS["yaw"]:
            unit, who = _unit_and_vehicle(rest, "angle", _IS["q"])
            return ColumnMeaning("yaw_rate") if who == "rate" else ColumnMeaning("yaw", unit, who)
        axis = _AXIS.fullmatch(words[k])
        if axis is None or beside & _IS["none"]:
            continue
        kind = _ABBREVIATED.get(axis[1], axis[1]) if axis[1] else None
        kinds = [x for x in "vajq" if beside & _IS[x] - _IS[""]] if kind is None else [kind]
        kind = kinds[0] if kinds else ""
        if axis[2] != "w" or kind == "q":
            unit, who = _unit_and_vehicle(rest, "length" if kind == "" else kind, _IS[kind])
            if frames and kind == "":
                letter = frames[0]["xyz".index(axis[2])]
                return ColumnMeaning(next(d for d in DIRECTIONS if d[0] == letter), unit, who)
            return ColumnMeaning(kind + axis[2], unit, who)
    return ColumnMeaning("")


def _unit_and_vehicle(rest: list[str], dimension: str, beside: frozenset[str]) -> tuple[str, str]:
    """The unit of more than a letter and the vehicle among words beside an axis (`x in mm`, `x_mm_cf1`)."""
    units = [w for w in rest if len(w) > 1 and w != "in" and (unit_of(w) or ("",))[0] == dimension]
    who = (w for w in rest if w not in beside | _IS[""] | {*units} | ({"in"} if units else set()))
    return units[-1] if units else "", "".join(who)


def meanings_of(names: Sequence[str]) -> list[ColumnMeaning]:
    """The quantities of all columns of a table.

    A letter such as a, v or b beside three axes is a quantity (`a_x`: an acceleration). It is a vehicle, perhaps one
    that is not read, where others written alike are vehicles (`x_a`, `x_cf1`), or the quantity says nothing here.
    """
    kinds = [meaning_of(name) for name in names]
    if any(map(CRAZYFLIE.fullmatch, names)):
        # Its client writes the vehicle's stamps; a time of another name is the user's own.
        for k, q in enumerate(kinds):
            if q.kind == "time" and "stamp" in names[k].lower():
                kinds[k] = q._replace(unit=q.unit or "ms")
    if [name for name in names if not name.startswith("field")] == ["time"]:
        # `rostopic echo -p`: when a message came, and its stamp, which counts; both in nanoseconds (`_str_plot`).
        for k, q in enumerate(kinds):
            came = "field.header.stamp" in names and names[k] == "time"
            kinds[k] = q._replace(kind="" if came else q.kind, unit="ns") if q.kind == "time" else q
    known, place = {q.kind for q in kinds}, {name.lower(): k for k, name in enumerate(names)}
    alike: dict[str, dict[str, tuple[list[int], str]]] = {}
    for name in place:
        for cut in re.finditer("x", name):
            ends = name[: cut.start()], name[cut.end() :]
            own = [place.get(axis.join(ends), -1) for axis in "xyz"]
            if -1 in own:
                continue
            words = re.findall(r"[^\W_]+", re.sub(r"[\[(].*|_m$", "", " ".join(ends)))
            letters = [word for word in words if re.fullmatch(r"[a-z]\d*", word)]
            unit = meaning_of(re.sub(_LETTER, "", "X".join(ends), count=1)).unit
            same = alike.setdefault(re.sub(r"[^\W_]+", "a", " ".join(ends)), {})
            same[letters[0] if len(letters) == 1 else "".join(words)] = own, unit
    for shape, same in alike.items():
        whose = {kinds[own[0]].who for own, _ in same.values() if kinds[own[0]].kind == "x"}
        letters = {word[:1] for word in same}
        vehicles = whose - ROLES - _IS["agent"] - {""} and not {"p", "v"} <= letters
        lost = len(same) > 1 and letters - {*"vajqw"} and not known & {"x", *DIRECTIONS}
        first = shape.startswith(" ") and "" not in whose
        for word, (own, unit) in same.items():
            kind = kinds[own[0]].kind
            lone = not kind or first or _AFTER.get(kind[0], kind) not in known
            short = re.fullmatch(r"[a-z]\d*", word)
            if (vehicles and not kind) or (short and (vehicles or lost or lone)):
                for k, axis in zip(own, "xyz", strict=True):
                    kinds[k] = ColumnMeaning(axis, unit, word)
    flat, high = {"x", "y"} <= known and not known & {"z", "down"}, known & {"z", "up", "down"}
    up = {"height": "z" if flat else "" if high else "up", "up": "z" if flat else "up"}
    return [q._replace(kind=up.get(q.kind, q.kind)) for q in kinds]


def count_column_names(fields: Sequence[str]) -> int:
    """How many of a line's ``fields`` are names of columns; 0 if it has no place and nothing else besides."""
    kinds = [q.kind for q in meanings_of(fields) if q.kind]
    places = {*DIRECTIONS, "x", "y", "latitude", "x^0"}
    return len(kinds) if len(kinds) > 1 and places & {*kinds} else 0
