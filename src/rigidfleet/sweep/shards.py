"""Shards: parts of a sweep that are flown on their own, as by a job array, and merged to one store."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from rigidfleet.errors import ResultError, RigidfleetError
from rigidfleet.sweep.run import GROUP
from rigidfleet.sweep.store import FILE, Store, Table, contents, differences, outcome_of, read
from rigidfleet.typing import Bools

#: Folder of the shards in the folder of their sweep.
_SHARDS = "shards"


@dataclass(frozen=True)
class Shard:
    """Part ``number``, from 1, of ``count``: every ``count``-th group of runs, so that parts grow with their sweep."""

    number: int
    count: int

    @classmethod
    def of(cls, text: str) -> Self:
        """Read a shard as it is written, such as 3/40.

        Raises
        ------
        RigidfleetError
            It is written otherwise, or there is no such part.
        """
        match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", text)
        if match is None or int(match[1]) > int(match[2]):
            raise RigidfleetError(
                f"--shard {text}: is no part of a sweep. Write K/N with K from 1 to N, as 3/40 for the third of 40."
            )
        return cls(int(match[1]), int(match[2]))

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def runs(self, count: int) -> Bools:
        """Mask (count,) of its runs among all of a sweep."""
        return np.arange(count) // GROUP % self.count == self.number - 1

    def folder(self, sweep: Path) -> Path:
        """Its folder in that of its sweep."""
        return sweep / _SHARDS / f"{self.number}-of-{self.count}"


def shard_folders(folder: Path) -> list[Path]:
    """Folders of the shards that are in the folder of a sweep."""
    return sorted(path.parent for path in folder.glob(f"{_SHARDS}/*/{FILE}"))


def merge(folder: str | Path, *, replace: bool = False) -> Table:
    """Make one store of the shards in the folder of a sweep, and return its rows: those of one run, bit for bit.

    Parameters
    ----------
    folder : shards are all stores in folders of its folder `shards`, whatever their names
    replace : overwrite another sweep that is in the folder

    Raises
    ------
    ResultError
        A shard is missing or partly flown, belongs to another sweep, or differs from another copy of it; the folder
        contains another sweep or cannot be written. Nothing is written then.
    """
    folder = Path(folder)
    paths = shard_folders(folder)
    if not paths:
        raise ResultError(
            f"{folder}: contains no shards. `rigidfleet sweep ... --shard K/N` flies one."
        )
    sweep, common, _ = contents(paths[0])
    rows: dict[int, tuple[Any, ...]] = {}
    owner: dict[int, Path] = {}
    for path in paths:
        _, own, part = contents(path)
        if own != common:
            raise ResultError(
                f"{path}: does not fit {paths[0]}; it differs in: {differences(common, own)}. Fly it again, or move it"
                " out of the folder."
            )
        for run, *row in part:
            if run in rows and outcome_of((run, *row)) != outcome_of(rows[run]):
                raise ResultError(
                    f"{path}: run {run} is not as in {owner[run]}. Keep the right one, and move the other out of the"
                    " folder."
                )
            rows[run], owner[run] = (run, *row), path
    there = np.zeros(sweep.runs, dtype=bool)
    there[[*rows]] = True
    count, lacking = common["shards"], []
    for k in np.unique(np.flatnonzero(~there) // GROUP % count).tolist():
        own = Shard(k + 1, count).runs(sweep.runs)
        flown = f" (has {(own & there).sum()} of {own.sum()} runs)" if (own & there).any() else ""
        lacking.append(f"{k + 1}{flown}")
    if lacking:
        raise ResultError(
            f"{folder}: of {count} shards, these are missing or partly flown: {', '.join(lacking)}. Fly each, as by"
            f" `rigidfleet sweep {folder} --shard {lacking[0].split()[0]}/{count}`, and merge again."
        )
    with Store(folder, sweep, replace=replace) as store:
        store.insert(rows.values())
    return read(folder)
