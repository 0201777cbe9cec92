"""Keys, values and options that were renamed before the first release.

A message about an old name gives the new one.
"""

from __future__ import annotations

#: Old name to new name. Keys and options are given as text, values as (key, value).
RENAMED: dict[str | tuple[str, str], str] = {
    ("control", "slots"): "tracking",
    ("edges", "joined"): "henneberg",
    ("edges", "tree"): "henneberg-multilevel",
    ("evaluate", "ends"): "final",
    "judged": "evaluate",
    "--ends": "--final-states",
    "links": "[network]",
}


def successor(key: object, value: object = None) -> str:
    """Return a remedy that gives the new name of a key, an option or a value of a key; '' if it was not renamed."""
    new = RENAMED.get(str(key) if value is None else (str(key), str(value)))
    return f"it is now called '{new}'" if new is not None else ""
