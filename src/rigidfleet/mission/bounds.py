"""Bounds on the text, the counts and the numbers of a mission. They are checked first, and docs/missions.md lists them.

Within these bounds no number overflows, and everything that is built from a mission fits into memory. They are far
beyond any real mission: lengths range from a micrometre to twice the distance of a geostationary satellite.
"""

from __future__ import annotations

import re
from typing import NamedTuple


class Bound(NamedTuple):
    """Smallest and largest magnitude of a quantity. The smallest applies only to quantities that must be > 0."""

    least: float
    most: float
    unit: str


# -- text --------------------------------------------------------------------------------------------

#: Maximum size of a file [bytes]: the positions of 400,000 agents. It also rejects a device or a video.
BYTES = 64 * 2**20
#: Maximum depth of nested brackets, and of the parts of a dotted key. The format itself needs three of each.
DEPTH = 8
#: Maximum number of keys and tables.
KEYS = 50_000
#: Maximum number of entries in lists.
ENTRIES = 10_000_000

# -- how many ----------------------------------------------------------------------------------------

AGENTS = 1_000_000
FORMATIONS = 200
PHASES = 1000
OBSTACLES = 1000
#: Maximum number of fences, of places with people, and of corners of one of them.
FENCES, CORNERS = 100, 2000
#: Maximum number of points of a convex hull, and of heights of a height map.
HULL, HEIGHTS = 1000, 40_000
#: Maximum number of edges of a formation: EDGES, or EDGES_EACH per agent if that is more. All pairs of 200 agents are
#: fewer.
EDGES, EDGES_EACH = 20_000, 32
#: Maximum number of slots of all formations together.
SLOTS = 5_000_000
#: Maximum number of pairs of agents that touch at the start or in a formation, if all have the largest radius.
TOUCHING = 5_000_000
#: Maximum number of agents where all pairs are compared: assignment to slots.
ALL_PAIRS = 20_000

# -- how large ---------------------------------------------------------------------------------------

LENGTH = Bound(1e-6, 1e8, "m")
TIME = Bound(1e-6, 1e9, "s")
SPEED = Bound(1e-6, 1e6, "m/s")
ACCELERATION = Bound(1e-6, 1e6, "m/s^2")
JERK = Bound(1e-6, 1e6, "m/s^3")
MASS = Bound(1e-6, 1e9, "kg")
FORCE = Bound(1e-9, 1e12, "N")
ANGLE = Bound(1e-6, 1e6, "deg or deg/s")
GAIN = Bound(1e-6, 1e6, "1/s")
WEIGHT = Bound(1e-15, 1e15, "")
TOLERANCE = Bound(1e-15, 1e8, "m, m/s")
#: Maximum ratio of the largest mass to the smallest.
MASS_RATIO = 1e9

_BARE = r"[A-Za-z0-9_\-]++"
_QUOTED = r'"(?:[^"\\\n]|\\[^\n])*+"?' + r"|'[^'\n]*+'?"
_NEXT = rf"[ \t]*+\.[ \t]*+(?:{_BARE}|{_QUOTED})"
#: Strings and comments, which may contain brackets and dots; dotted keys; brackets. Everything else is skipped.
_TOKENS = re.compile(
    # A multi-line string may end in one or two quotes of its own before the closing three.
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:"{3,5})?'
    r"|'''(?:[^']|'(?!''))*+(?:'{3,5})?"
    r"|#[^\n]*+"
    rf"|(?P<key>(?:{_QUOTED})(?:{_NEXT})*+|(?<![A-Za-z0-9_.\-]){_BARE}(?:{_NEXT}){{2,}}+)"
    r"|(?P<open>[\[{])|(?P<shut>[\]}])",
    re.DOTALL,
)
_PARTS = re.compile(rf"{_BARE}|{_QUOTED}")


def toml_oversize_in_words(text: str) -> str:
    """Describe how TOML text exceeds the bounds; "" if it does not.

    One pass without recursion, before any parser sees the text: a parser would recurse into keys of any depth.
    """
    if len(text) > BYTES:
        return f"is larger than {BYTES >> 20} MiB"
    for signs, most, what in ("=", KEYS, "keys"), (",[", ENTRIES, "entries in lists"):
        many = sum(text.count(sign) for sign in signs)
        if many > most:
            return f"has {many:,} {what}; the maximum is {most:,}"
    depth = 0
    for token in _TOKENS.finditer(text):
        if token["open"]:
            depth += 1
            what, deep = "the depth of brackets", depth
        elif token["shut"]:
            depth = max(depth - 1, 0)
            continue
        elif token["key"]:
            what, deep = "the depth of a dotted key", len(_PARTS.findall(token["key"]))
        else:
            continue
        if deep > DEPTH:
            line = text.count("\n", 0, token.start()) + 1
            return f"{what} is {deep:,} at line {line:,}; the maximum is {DEPTH}"
    return ""
