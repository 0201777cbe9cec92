"""Load a sweep as a dataset of xarray."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigidfleet.sweep import keypaths
from rigidfleet.sweep.definition import Sweep, SweepColumn
from rigidfleet.sweep.metrics import METRICS
from rigidfleet.sweep.store import read

if TYPE_CHECKING:
    import xarray

_UNIT = re.compile(r"\[([^\[\],]+)\]")
_ROLE = {"set": "", "add": "added to: ", "scale": "factor of: "}


def load(folder: str | Path) -> xarray.Dataset:
    """Load the sweep in a folder as a dataset along `run`, with units and meanings; requires xarray.

    Variables are the varied numbers by path (`agents.mass.2`), all metrics, `passed`, `reason`, `detail` and `wall`.
    While the sweep is running, the dataset has the runs finished so far.

    Raises
    ------
    ResultError
        The folder does not contain a sweep.
    """
    import xarray as xr

    table = read(folder)
    sweep = table.sweep
    variables: dict[str, Any] = {}
    for k, column in enumerate(sweep.columns):
        unit, text = unit_and_meaning(sweep, column)
        values = [column.variation.decode(code) for code in table.codes[:, k].tolist()]
        variables[column.name] = ("run", values, {"units": unit, "long_name": text})
    for name, values, text in (
        ("passed", table.passed, "whether the flight passed its verdict"),
        ("reason", table.reason.astype(str), "checks that failed"),
        ("detail", table.detail.astype(str), "first failure in words"),
    ):
        variables[name] = ("run", values, {"long_name": text})
    for name, metric in METRICS.items():
        about = {"units": metric.unit, "long_name": metric.text}
        variables[name] = ("run", table.metrics[name], about)
    variables["wall"] = ("run", table.wall, {"units": "s", "long_name": "time taken"})
    about = {"long_name": "number of the run, from 0"}
    return xr.Dataset(
        variables,
        coords={"run": ("run", table.run, about)},
        attrs={
            "title": f"sweep of the mission {sweep.mission.name}",
            "seed": sweep.seed,
            "runs": sweep.runs,
            "complete": int(table.complete),
            "mission": sweep.mission.text,
            "version": sweep.identity["version"],
        },
    )


def unit_and_meaning(sweep: Sweep, column: SweepColumn) -> tuple[str, str]:
    """Unit and meaning of the number that a column varies."""
    text = keypaths.description_of(sweep.mission, column.keys)
    units = _UNIT.findall(text)
    unit = "1" if column.variation.change == "scale" or not units else units[-1].replace("-", "1")
    return unit, f"{_ROLE[column.variation.change]}{text}"
