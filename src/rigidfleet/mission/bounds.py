"""How long, deep, many and large a mission may be: stated once, checked first, listed in the documents.

Within these bounds the numbers of a mission stay numbers, and what is built from it fits into memory. They are far
beyond what flies: a length from a micrometre to twice the distance of a geostationary satellite.
"""

from __future__ import annotations

import re
from typing import NamedTuple


class Bound(NamedTuple):
    """Least and greatest size of a quantity; where it may be zero or negative, the least is of what is not."""

    least: float
    most: float
    unit: str


# -- text --------------------------------------------------------------------------------------------

#: Bytes of a file: positions of 400,000 agents. A device or a video given by mistake is noticed, too.
BYTES = 64 * 2**20
#: Brackets within brackets, and parts of a dotted key. The format itself needs three of each.
DEPTH = 8
#: Keys with a value, and tables.
KEYS = 50_000
#: Numbers and strings in lists, and lists.
ENTRIES = 10_000_000

# -- how many ----------------------------------------------------------------------------------------

AGENTS = 1_000_000
FORMATIONS = 200
PHASES = 1000
OBSTACLES = 1000
#: Edges of a formation, of few agents and for each of many; all pairs of 200 agents are fewer.
EDGES, EDGES_EACH = 20_000, 32
#: Slots of all formations together.
SLOTS = 5_000_000
#: Pairs of agents whose spheres, all as large as the largest, touch at the start or in a formation.
TOUCHING = 5_000_000
#: Agents where each is compared with each: assigned to slots, or correlated by distance.
ALL_PAIRS = 5000

# -- how large ---------------------------------------------------------------------------------------

LENGTH = Bound(1e-6, 1e8, "m")
TIME = Bound(1e-6, 1e9, "s")
SPEED = Bound(1e-6, 1e6, "m/s")
ACCELERATION = Bound(1e-6, 1e6, "m/s^2")
MASS = Bound(1e-6, 1e9, "kg")
FORCE = Bound(1e-9, 1e12, "N")
ANGLE = Bound(1e-6, 1e6, "deg or deg/s")
GAIN = Bound(1e-6, 1e6, "1/s")
WEIGHT = Bound(1e-15, 1e15, "")
TOLERANCE = Bound(1e-15, 1e8, "m, m/s")
#: The heaviest vehicle over the lightest.
MASS_RATIO = 1e9

_BARE = r"[A-Za-z0-9_\-]++"
_QUOTED = r'"(?:[^"\\\n]|\\[^\n])*+"?' + r"|'[^'\n]*+'?"
_NEXT = rf"[ \t]*+\.[ \t]*+(?:{_BARE}|{_QUOTED})"
#: What may hide a bracket or a dot, what is deep, and nothing else: numbers are passed over.
_TOKENS = re.compile(
    # A string of several lines may end in one or two quotes of its own.
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?'
    r"|'''(?:[^']|'(?!''))*+(?:'{3,5})?"
    r"|#[^\n]*+"
    rf"|(?P<key>(?:{_QUOTED})(?:{_NEXT})*+|(?<![A-Za-z0-9_.\-]){_BARE}(?:{_NEXT}){{2,}}+)"
    r"|(?P<open>[\[{])|(?P<shut>[\]}])",
    re.DOTALL,
)
_PARTS = re.compile(rf"{_BARE}|{_QUOTED}")


def excess(text: str) -> str:
    """What of TOML text is beyond its bounds, in words; "" if nothing is.

    In one pass and without recursion: a parser need not be asked, which would follow a key however deep.
    """
    if len(text) > BYTES:
        return f"is longer than {BYTES >> 20} MiB"
    for signs, most, what in ("=", KEYS, "keys"), (",[", ENTRIES, "entries in lists"):
        many = sum(text.count(sign) for sign in signs)
        if many > most:
            return f"has {many:,} {what}, more than {most:,}"
    depth = 0
    for token in _TOKENS.finditer(text):
        if token["open"]:
            depth += 1
            what, deep = "brackets are nested", depth
        elif token["shut"]:
            depth = max(depth - 1, 0)
            continue
        elif token["key"]:
            what, deep = "a dotted key has parts", len(_PARTS.findall(token["key"]))
        else:
            continue
        if deep > DEPTH:
            line = text.count("\n", 0, token.start()) + 1
            return f"{what} {deep:,} deep at line {line:,}, more than {DEPTH}"
    return ""
