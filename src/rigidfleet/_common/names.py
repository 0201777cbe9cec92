"""Names of columns that people use, and units: which quantity a column has, of which vehicle."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

#: Units by dimension, as factors to s, m and rad.
UNITS = {
    "time": {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3, "us": 1e-6,
             "usec": 1e-6, "microsecond": 1e-6, "ns": 1e-9, "nsec": 1e-9, "nsecs": 1e-9, "nanosec": 1e-9, "nanosecond": 1e-9, "min": 60.0, "h": 3600.0},
    "length": {"m": 1.0, "metre": 1.0, "meter": 1.0, "mm": 1e-3, "millimetre": 1e-3, "millimeter": 1e-3, "cm": 1e-2,
               "centimetre": 1e-2, "centimeter": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048, "in": 0.0254},
    "angle": {"rad": 1.0, "radian": 1.0, "deg": math.radians(1.0), "degree": math.radians(1.0)},
}  # fmt: skip
#: Axis and sign of each direction, from east, north and up; and names of columns after directions.
AXES = {"e": (0, 1.0), "w": (0, -1.0), "n": (1, 1.0), "s": (1, -1.0), "u": (2, 1.0), "d": (2, -1.0)}
DIRECTIONS = {"north": "n", "east": "e", "south": "s", "west": "w", "down": "d", "up": "u"}
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]+")
_AXIS = re.compile(r"(pos|vel|acc|[ptvajq])?([xyzw])")
_KINDS = {
    "": {"p", "t", "pos", "position", "pose", "translation", "location", "coordinate", "point", "local", "world",
         "global", "odom", "map", "rs", "r", "wb", "estimate", "field", "msg", "data", "transform", "enu", "state"},
    "v": {"v", "vel", "velocity", "twist", "linear"},
    "a": {"a", "acc", "acceleration"},
    "j": {"j", "jerk"},
    "q": {"q", "quat", "quaternion", "orientation", "rotation", "attitude", "rs"},
}  # fmt: skip
_KIND_OF = {"pos": "", "p": "", "t": "", "vel": "v", "acc": "a", None: None}
_TIME = {"t", "time", "timestamp", "stamp", "sec", "secs", "second", "seconds", "elapsed", "datetime", "nsec", "nsecs",
         "nanosec", "clock"}  # fmt: skip
_TIME_TOO = {"header", "sim", "field", "ros", "utc", "unix", "epoch", "date", "since", "start", "relative", "rel", "log",
             "of", "posix", "world"}  # fmt: skip
#: Words for vehicles, and words that may be for other things.
_VEHICLES = {"agent", "drone", "vehicle", "uav", "uas", "robot", "cf", "crazyflie", "quad", "quadrotor", "quadcopter",
             "copter", "aircraft", "plane", "body", "rigid", "track", "sysid", "mav", "uri", "callsign", "tail", "craft",
             "bot", "ship", "rover"}  # fmt: skip
_THINGS = {"id", "name", "uid", "uuid", "object", "marker", "label", "ns", "namespace", "child", "entity", "node", "tag",
           "target", "device", "model", "actor", "player", "serial", "instance", "hostname", "key"}  # fmt: skip
_THINGS_TOO = {"no", "nr", "num", "number", "system", "frame", "index", "idx", "subject"}
_YAW = {"yaw", "psi"}
#: Words of a column beside its axis that make it another quantity than a position.
_NO_PLACE = {"std", "var", "cov", "covariance", "err", "error", "sigma", "noise", "rate", "offset", "min", "max", "mean",
             "limit", "size", "scale", "omega", "angular", "gyro", "mag", "torque", "force", "thrust", "gyr", "ang",
             "euler", "rpy", "bias", "w", "b"}  # fmt: skip
_HUES = {"r": "red", "g": "green", "b": "blue"}
_HUE = re.compile(r"(?:led|diffuse|colou?r|rgb)?[ _.]*(r|g|b|red|green|blue)")
_GLOBE = {"lat": "latitude", "lon": "longitude", "lng": "longitude", "long": "longitude", "latitude": "latitude",
          "longitude": "longitude"}  # fmt: skip
_DIMENSIONS = {"": "length", "v": "length/time", "a": "length/time2", "j": "length/time3"}


class Quantity(NamedTuple):
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
        if self.kind in ("time", "duration"):
            return "time"
        if self.kind in ("yaw", "yaw_rate"):
            return "angle" if self.kind == "yaw" else "angle/time"
        if self.kind in DIRECTIONS or re.fullmatch(r"[vaj]?[xyz]", self.kind):
            return _DIMENSIONS[self.kind[:-1] if self.kind not in DIRECTIONS else ""]
        return ""


def unit_of(text: str) -> tuple[str, float] | None:
    """Dimension of a unit, and its factor to s, m and rad; None if it is unknown."""
    plain = text.strip().lower().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    for dimension, units in UNITS.items():
        if factor := units.get(plain) or (len(plain) > 3 and units.get(plain.rstrip("s"))):
            return dimension, factor
    parts = re.fullmatch(r"([a-z]+)[/_ *·]+([a-z]+)\^?-?(\d?)", plain)
    above, below = (unit_of(parts[1]), unit_of(parts[2])) if parts else (None, None)
    if parts is None or above is None or below is None:
        return None
    power = parts[3] if parts[3] != "1" else ""
    return f"{above[0]}/{below[0]}{power}", above[1] / below[1] ** int(power or 1)


@cache
def quantity_of(name: str) -> Quantity:
    """The quantity, unit and vehicle of a column's name."""
    if bracket := re.fullmatch(r"(.*?)\s*[\[(](.*?)[\])]\s*", name):
        found = _plain(bracket[1])
        return found._replace(unit=bracket[2].strip()) if found.kind else found
    found = _plain(name)
    for cut in (2, 1):
        parts = re.split(r"_", name)
        unit = "_".join(parts[-cut:])
        if len(parts) <= cut or (found.kind and not found.who) or (known := unit_of(unit)) is None:
            continue
        short = _plain("_".join(parts[:-cut]))
        if short.kind and short.dimension == known[0]:
            return short._replace(unit=unit)
    return found


def _plain(name: str) -> Quantity:
    """The quantity and vehicle of a name without a unit."""
    plain = name.strip().lower()
    words = [word.lower() for word in _WORD.findall(name)]
    every = set(words)
    if re.fullmatch(r"duration|(x|y|z|yaw)\^[0-7]", plain.replace(" ", "")):
        return Quantity(plain.replace(" ", ""))
    if plain in DIRECTIONS or plain in _GLOBE:
        return Quantity(_GLOBE.get(plain, plain))
    if re.fullmatch(r"p?[neud]", plain):
        return Quantity({v: k for k, v in DIRECTIONS.items()}[plain[-1]])
    units = [word for word in words if (unit_of(word) or ("",))[0] == "time"]
    if every & _TIME and every <= _TIME | _TIME_TOO | {*units}:
        return Quantity("time", units[-1] if units else "")
    if every & (_VEHICLES | _THINGS) and every <= _VEHICLES | _THINGS | _THINGS_TOO:
        return Quantity("agent" if every & _VEHICLES else "thing")
    if hue := _HUE.fullmatch(plain):
        return Quantity(_HUES.get(hue[1], hue[1]))
    if plain in ("color", "colour", "rgb", "hex", "hex color", "hex_color"):
        return Quantity("colour")
    for place in (-1, 0) if words else ():
        rest = [word for k, word in enumerate(words) if k != place % len(words)]
        if words[place] in _YAW:
            who = "".join(w for w in rest if w not in _KINDS["q"] | _KINDS[""])
            return Quantity("yaw_rate", who="") if who == "rate" else Quantity("yaw", who=who)
        if (axis := _AXIS.fullmatch(words[place])) is None:
            continue
        kind = _KIND_OF.get(axis[1], axis[1])
        for option in ("", "v", "a", "j", "q") if kind is None else (kind,):
            who = "".join(w for w in rest if w not in _KINDS[option] | _KINDS[""])
            named = option and (kind is not None or set(rest) & _KINDS[option])
            if not set(rest) & _NO_PLACE and (
                (named and (axis[2] != "w" or option == "q"))
                or (not option and axis[2] != "w" and not _other(rest))
            ):
                return Quantity(option + axis[2], who=who)
    return Quantity("")


def _other(words: Sequence[str]) -> bool:
    """Whether words name another quantity than a position."""
    return any(set(words) & (_KINDS[kind] - _KINDS[""]) for kind in ("v", "a", "j", "q"))


def understood(names: Sequence[str]) -> int:
    """How many of a line's fields are names of columns; 0 if it has no place and nothing else besides."""
    kinds = [quantity_of(name).kind for name in names]
    places = sum(kind in DIRECTIONS or kind in ("x", "y", "latitude", "x^0") for kind in kinds)
    return sum(map(bool, kinds)) if places and sum(map(bool, kinds)) > 1 else 0
