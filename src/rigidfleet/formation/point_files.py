"""Points from text files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from rigidfleet.errors import Finding, MissionError
from rigidfleet.typing import Floats


def read_points(path: str | Path) -> Floats:
    """Slots (N, 3) [m] from a text file: one agent per line, x, y and z (or x and y, for z = 0).

    Numbers are separated by commas, semicolons or blanks. Empty lines, text after `#` and a first line of names
    (`x,y,z`) are ignored.

    Raises
    ------
    MissionError
        The file cannot be read or has no points; with a finding for each invalid line.
    """
    lines = _lines(Path(path))
    findings, points, first = [], [], {}
    for number, line in enumerate(lines, start=1):
        fields = [f for f in re.split(r"\s*[,;]\s*|\s+", line.partition("#")[0].strip()) if f]
        if not fields or (not points and not findings and _are_names(fields)):
            continue
        problem = remedy = ""
        try:
            point = [float(field) for field in fields]
        except ValueError:
            point = []
            problem, remedy = "is not a point", "write x, y, z as numbers, with decimal points"
        if point and len(point) not in (2, 3):
            problem = f"has {len(point)} numbers"
            remedy = "write x, y, z (or x, y); decimal points, not commas"
        elif not np.isfinite(point).all():
            problem, remedy = "is not finite", "write x, y, z [m] as finite numbers"
        if not problem:
            at = first.setdefault(tuple(round(x, 9) for x in (*point, 0.0)[:3]), number)
            if at != number:
                problem, remedy = f"repeats the point of line {at}", "keep the slots apart"
        if problem:
            findings.append(Finding(str(path), f"line {number}", line.strip(), problem, remedy))
        else:
            points.append((*point, 0.0)[:3])
    if not points and not findings:
        remedy = "write one agent per line: x, y, z"
        findings.append(Finding(str(path), "", None, "has no points", remedy))
    if findings:
        raise MissionError(findings)
    return np.array(points, dtype=np.float64)


def _are_names(fields: list[str]) -> bool:
    def number(field: str) -> bool:
        try:
            float(field)
        except ValueError:
            return False
        return True

    return not any(number(f) or f[0].isdigit() for f in fields)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        problem = "is not text"
    except OSError as error:
        problem = f"cannot be read: {(error.strerror or str(error)).lower()}"
    raise MissionError(
        [Finding(str(path), "", None, problem, "give a text file with one agent per line")]
    )
