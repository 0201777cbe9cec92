"""Shards: parts of a sweep that are flown on their own, as by a job array, and merged to one store."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from rigidfleet.errors import ResultError, RigidfleetError
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.run import GROUP
from rigidfleet.sweep.store import (
    Store,
    Table,
    diff_names,
    is_store,
    outcome,
    read,
    read_definition,
    store_contents,
)
from rigidfleet.typing import Bools, Ints

#: Folder of the shards in the folder of their sweep.
_SHARDS = "shards"
_DIGITS = "If only last digits differ, docs/install.md says what fixes them on all processors."
_MOVE = "Move the wrong one out of the folder."


def runs_of_shard(shard: str, runs: int) -> Bools:
    """Mask (runs,) of the runs of a shard, "3/40": every 40th group, so that shards grow with their sweep; "": all.

    Raises
    ------
    RigidfleetError
        There is no such shard.
    """
    match = re.fullmatch(r"([1-9]\d{0,8})/([1-9]\d{0,8})", shard or "1/1")
    if match is None or int(match[1]) > int(match[2]):
        raise RigidfleetError(f"--shard {shard}: write K/N with K from 1 to N, such as 3/40.")
    return _shard_of_runs(runs, int(match[2])) == int(match[1])


def shard_folder(folder: Path, shard: str) -> Path:
    """Folder of a shard in that of its sweep; the latter, if the shard is ""."""
    return folder / _SHARDS / shard.replace("/", "-of-") if shard else folder


def readable_sweeps(folder: Path) -> Iterator[Sweep]:
    """The sweeps of the shards in a folder of a sweep; those that cannot be read are left out."""
    for path in sorted(folder.glob(f"{_SHARDS}/*")):
        with suppress(ResultError):
            yield read_definition(path)


def merge(folder: str | Path, *, replace: bool = False) -> Table:
    """Make one store of the shards in the folder of a sweep, and return its rows: those of one run, bit for bit.

    Parameters
    ----------
    folder : shards are all stores in folders of its folder `shards`, whatever their names; the sweep has as many runs
        as the longest of them
    replace : overwrite another sweep that is in the folder

    Raises
    ------
    ResultError
        A shard is missing or partly flown, belongs to another sweep, or differs from another copy of it; the folder
        contains another sweep or cannot be written. Nothing is written then.
    """
    folder = Path(folder)
    paths = sorted(filter(is_store, folder.glob(f"{_SHARDS}/*"))) or [folder / _SHARDS]
    stored = [store_contents(path) for path in paths]
    (_, common, _), sweep = stored[0], max((own for own, *_ in stored), key=lambda x: x.runs)
    rows: dict[int, tuple[Path, tuple[Any, ...]]] = {}
    for path, (_, own, part) in zip(paths, stored, strict=True):
        if own != common:
            other = diff_names(common, own)
            raise ResultError(f"{path}: does not fit {paths[0]}; it differs in: {other}. {_MOVE}")
        for row in part:
            where, same = rows.setdefault(row[0], (path, row))
            if outcome(row) != outcome(same):
                raise ResultError(f"{path}: run {row[0]} is not as in {where}. {_DIGITS} {_MOVE}")
    shards = _shard_of_runs(sweep.runs, count := common["number of shards"])
    total, flown = (np.bincount(x, minlength=count + 1) for x in (shards, shards[[*rows]]))
    if lacking := np.flatnonzero(flown < total).tolist():
        words = [
            f"{k} (has {flown[k]} of {total[k]} runs)" if flown[k] else str(k) for k in lacking
        ]
        raise ResultError(
            f"{folder}: of {count} shards, these are missing or partly flown: {', '.join(words)}. Fly each, as by"
            f" `rigidfleet sweep {folder} --shard {lacking[0]}/{count} --runs {sweep.runs}`, and merge again."
        )
    with Store(folder, sweep, "", replace) as store:
        store.insert_rows(row for _, row in rows.values())
    return read(folder)


def _shard_of_runs(runs: int, count: int) -> Ints:
    """Number (runs,), from 1, of the shard that flies each run, of ``count`` shards."""
    return np.arange(runs) // GROUP % count + 1
