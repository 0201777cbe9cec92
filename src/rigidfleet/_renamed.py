"""Words of missions, sweep files and the command that were replaced before the first release.

Who still writes one is told its successor.
"""

from __future__ import annotations

#: Old word to new: keys and options by themselves, values as (key, value).
RENAMED: dict[str | tuple[str, str], str] = {
    ("control", "slots"): "tracking",
    ("edges", "joined"): "henneberg",
    ("edges", "tree"): "henneberg-multilevel",
    ("evaluate", "ends"): "final",
    "judged": "evaluate",
    "--ends": "--final-states",
}


def successor(key: object, value: object = None) -> str:
    """Remedy that names the successor of an old key or option, or of an old value of a key; '' where there is none."""
    new = RENAMED.get(str(key) if value is None else (str(key), str(value)))
    return f"it is called '{new}' now" if new is not None else ""
