"""How far each export of three flights is from what was exported, as the exports say themselves.

make exports                                           fly, export, and write the table of docs/export.md
python benchmarks/exports.py --only cube-passage-quadrotors
"""

import argparse
import math
import re
import tempfile
from pathlib import Path

from pages import markdown, splice

import rigidfleet as rf
from rigidfleet.errors import ResultError
from rigidfleet.interchange import FORMATS, brief_number, export

FLIGHTS = ("passage-quadrotors", "cube-passage-quadrotors", "show-1000")


def row(result: rf.Result, name: str, folder: Path, flown: bool) -> str:
    """Deviation [mm] and [deg] and kilobytes of an export, or why there is none."""
    path = folder / (f"{name}.csv" if name == "setpoints" else name)
    try:
        made = export(result, path, name, flown=flown)
    except ResultError as error:
        found = re.search(r"is ([\d.]+ m) from|needs (\d+ \w+) of|needs (\d+ bytes)", str(error))
        return f"refused: {next(x for x in found.groups() if x) if found else error}"
    turned = brief_number(math.degrees(made.yaw_deviation))
    return f"{brief_number(1e3 * made.deviation)} mm, {turned} deg, {made.size / 1e3:,.0f} kB"


def main() -> None:
    """Fly, export and print; or write the table into a page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--only", action="append", choices=FLIGHTS, help="only this flight")
    parser.add_argument("--flown", action="store_true", help="the motion flown, not the reference")
    parser.add_argument("--write", type=Path, help="put the table into a page (docs/export.md)")
    asked = parser.parse_args()
    flights = asked.only or FLIGHTS
    columns = []
    for flight in flights:
        result = rf.simulate(flight)
        with tempfile.TemporaryDirectory() as folder:
            columns.append([row(result, name, Path(folder), asked.flown) for name in FORMATS])
    head = ("format", *(f"`{flight}`" for flight in flights))
    rows = ((f"`{name}`", *cells) for name, *cells in zip(FORMATS, *columns, strict=True))
    table = markdown(head, rows)
    print(table)
    if asked.write:
        splice(asked.write, {"exports": table})


if __name__ == "__main__":
    main()
