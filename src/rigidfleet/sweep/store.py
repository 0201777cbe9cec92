"""Store of a sweep: one SQLite file, written by one process, with a transaction for each chunk.

Why SQLite: a committed chunk survives kill -9 at any moment, and an uncommitted one leaves no trace. The number of the
run is the primary key, so no run counts twice. SQLite is part of Python, and any tool can read the file, even while
the sweep is running.
"""

from __future__ import annotations

import json
import math
import shutil
import sqlite3
from collections import Counter
from collections.abc import Generator, Iterable
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from rigidfleet._common.files import unwritable_error
from rigidfleet.errors import ResultError, refuse_format
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS
from rigidfleet.sweep.record import RunRecord
from rigidfleet.typing import Bools, Floats, Ints

FILE = "sweep.db"
#: Locked by the process that writes. The lock ends with the process, even if that is killed.
LOCK = "sweep.lock"
#: Version of the format, stored as `user_version`; 0 in files of the first format.
_FORMAT = 3
#: Space on a disk that SQLite needs to work, and reports as errors of all kinds if it has less [bytes].
_ROOM = 1 << 20
_COLUMNS = ("run", "passed", "reason", "detail", "wall", "level", "codes", *METRICS)
_KINDS = {"passed": "INTEGER", "reason": "TEXT", "detail": "TEXT", "level": "TEXT", "codes": "BLOB"}
#: Of a row in the order of the columns: what depends on the sweep alone, not on who flew it.
outcome = itemgetter(*(k for k, x in enumerate(_COLUMNS) if x not in ("wall", "level")))
#: Little-endian, so that the file can be read on every machine.
_CODES = np.dtype("<f8")


@dataclass(frozen=True)
class Table:
    """Rows of a sweep as arrays, in the order of the runs.

    Attributes
    ----------
    sweep : definition of the sweep
    run : numbers (n,) of the finished runs, from 0
    passed : whether each run passed (n,)
    reason, detail : failed checks and message of the first one (n,); "" if the run passed
    codes : value of each column (n, D), encoded by `Variation.encode`
    metrics : values (n,) of each metric; NaN if it does not apply
    wall : wall time of each run (n,) [s]
    levels : number of runs by the level of machine code that flew them, if it is known
    """

    sweep: Sweep
    run: Ints
    passed: Bools
    reason: NDArray[np.object_]
    detail: NDArray[np.object_]
    codes: Floats
    metrics: dict[str, Floats]
    wall: Floats
    levels: dict[str, int] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether all runs are finished."""
        return len(self.run) == self.sweep.runs


class Store:
    """Store of one sweep, or of one ``shard`` of it unless that is "", open for writing; a context manager.

    Raises
    ------
    ResultError
        The folder contains another sweep or shard or a damaged file, or it cannot be written.
    """

    def __init__(self, folder: Path, sweep: Sweep, shard: str, replace: bool) -> None:
        self.path, self.shard = folder / FILE, shard
        with _as_result_errors(self.path), ExitStack() as opened:
            folder.mkdir(parents=True, exist_ok=True)
            lock = sqlite3.connect(folder / LOCK, timeout=0.0, isolation_level=None)
            opened.enter_context(closing(lock)).execute("BEGIN EXCLUSIVE")
            if replace:
                for end in ("-wal", "-shm", "-journal", ""):
                    self.path.with_name(FILE + end).unlink(missing_ok=True)
            self.db = sqlite3.connect(self.path, isolation_level=None)
            opened.enter_context(closing(self.db))
            self._open_database(sweep)
            self._close = opened.pop_all().close

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def add_records(self, rows: Iterable[RunRecord]) -> None:
        """Store records, all of them or none. A record replaces an earlier one of the same run."""
        self.insert_rows(
            (
                row.run, int(row.passed), row.reason, row.detail, row.wall, row.level,
                np.array(row.codes, dtype=_CODES).tobytes(),
                *(None if math.isnan(x) else x for x in (row.metrics[name] for name in METRICS)),
            )
            for row in rows
        )  # fmt: skip

    def insert_rows(self, rows: Iterable[tuple[Any, ...]]) -> None:
        """Store rows as `store_contents` returns them, all of them or none."""
        names, marks = ", ".join(f'"{name}"' for name in _COLUMNS), ", ".join("?" * len(_COLUMNS))
        with _as_result_errors(self.path), self.db:
            self.db.execute("BEGIN IMMEDIATE")
            self.db.executemany(f"INSERT OR REPLACE INTO runs ({names}) VALUES ({marks})", rows)

    def finished_runs(self) -> Bools:
        """Mask (runs,) of the finished runs."""
        mask = np.zeros(self.runs, dtype=bool)
        with _as_result_errors(self.path):
            numbers = self.db.execute("SELECT run FROM runs WHERE run < ?", (self.runs,))
            mask[[n for (n,) in numbers]] = True
        return mask

    def _open_database(self, sweep: Sweep) -> None:
        """Begin the file, or go on with one of the same sweep: it gets the columns that it lacks.

        Raises
        ------
        ResultError
            It has another format, sweep or shard, or more runs.
        """
        self.runs = sweep.runs
        # A log needs memory that processes share, which a network's disk has not; shards often lie on one.
        self.db.execute(f"PRAGMA journal_mode = {'DELETE' if self.shard else 'WAL'}")
        self.db.execute("PRAGMA synchronous = NORMAL")
        identity = json.dumps(sweep.identity, ensure_ascii=False, sort_keys=True)
        with self.db:
            self.db.execute("BEGIN IMMEDIATE")
            _check_format(self.db, self.path.parent)
            self.db.execute(f"PRAGMA user_version = {_FORMAT}")
            self.db.execute("CREATE TABLE IF NOT EXISTS sweep (key TEXT PRIMARY KEY, value TEXT)")
            self.db.execute("CREATE TABLE IF NOT EXISTS runs (run INTEGER PRIMARY KEY)")
            for name in sorted(set(_COLUMNS) - _column_names(self.db), key=_COLUMNS.index):
                self.db.execute(f'ALTER TABLE runs ADD "{name}" {_KINDS.get(name, "REAL")}')
            there = dict(self.db.execute("SELECT key, value FROM sweep"))
            if there and there.get("identity") != identity:
                other = diff_names(json.loads(there.get("identity", "{}")), json.loads(identity))
                raise ResultError(
                    f"{self.path.parent}: contains another sweep; it differs in: {other}. Use --force to overwrite, or"
                    " --out to choose another folder."
                )
            if there and (shard := there.get("shard", "")) != self.shard:
                raise ResultError(
                    f"{self.path.parent}: contains {shard or 'all'} of this sweep, not {self.shard or 'all'}. Go on by"
                    f" `rigidfleet sweep {self.path.parents[2]} --shard {shard or '1/1'}`, or use --force to overwrite."
                )
            if there and (n := json.loads(there["sweep"])["runs"]) > sweep.runs:
                raise ResultError(
                    f"{self.path.parent}: has this sweep with {n} runs, more than {sweep.runs}. Use --runs {n} or more,"
                    " --force to overwrite, or --out to choose another folder."
                )
            entries = {"identity": identity, "sweep": sweep.json(), "shard": self.shard}
            self.db.executemany("INSERT OR REPLACE INTO sweep VALUES (?, ?)", entries.items())


def _column_names(db: sqlite3.Connection) -> set[str]:
    """Columns of a store: none of a new file; one that an earlier version wrote may lack metrics."""
    return {name for _, name, *_ in db.execute("PRAGMA table_info(runs)")}


def is_store(folder: Path) -> bool:
    """Whether a folder contains a sweep: the file of one that was killed as it began has no table yet.

    Raises
    ------
    ResultError
        The file is damaged or cannot be read.
    """
    if not (path := folder / FILE).is_file():
        return False
    with _as_result_errors(path), closing(sqlite3.connect(path)) as db:
        return bool(_column_names(db))


def read(folder: str | Path) -> Table:
    """Read all rows of the sweep in a folder, even while the sweep is running.

    Raises
    ------
    ResultError
        The folder does not contain a sweep.
    """
    sweep, _, rows = store_contents(Path(folder))
    columns = list(zip(*rows, strict=True)) or [()] * len(_COLUMNS)
    run, passed, reason, detail, wall, level, codes, *metrics = columns
    return Table(
        sweep,
        np.array(run, dtype=np.int64),
        np.array(passed, dtype=bool),
        np.array(reason, dtype=object),
        np.array(detail, dtype=object),
        np.frombuffer(b"".join(codes), dtype=_CODES).reshape(len(run), len(sweep.columns)),
        {name: np.array(x, dtype=np.float64) for name, x in zip(METRICS, metrics, strict=True)},
        np.array(wall, dtype=np.float64),
        dict(Counter(filter(None, level))),
    )


@contextmanager
def _open_store(folder: Path) -> Generator[tuple[sqlite3.Connection, dict[str, str], Sweep]]:
    """The database of a folder, what it says of the sweep, and the sweep; errors are ResultErrors."""
    if not is_store(folder):
        raise ResultError(f"{folder}: contains no sweep. `rigidfleet sweep` creates one.")
    path = folder / FILE
    with _as_result_errors(path), closing(sqlite3.connect(path)) as db:
        _check_format(db, folder)
        entries = dict(db.execute("SELECT key, value FROM sweep"))
        yield db, entries, Sweep.from_json(entries["sweep"])


def read_definition(folder: Path) -> Sweep:
    """The sweep of a folder, without its rows.

    Raises
    ------
    ResultError
        The folder does not contain a sweep.
    """
    with _open_store(folder) as (_, _, sweep):
        return sweep


def store_contents(folder: Path) -> tuple[Sweep, dict[str, Any], list[tuple[Any, ...]]]:
    """Sweep of a folder, what all shards of one sweep have in common, and the rows, in the order of the columns.

    Raises
    ------
    ResultError
        The folder does not contain a sweep.
    """
    with _open_store(folder) as (db, entries, sweep):
        common = {"number of shards": int(entries.get("shard", "").partition("/")[2] or 1)}
        known = _column_names(db)
        names = ", ".join(f'"{name}"' if name in known else "NULL" for name in _COLUMNS)
        rows = db.execute(f"SELECT {names} FROM runs ORDER BY run").fetchall()
        return sweep, json.loads(entries["identity"]) | common, rows


def _check_format(db: sqlite3.Connection, folder: Path) -> None:
    """Raise ResultError if a store has another format."""
    if not _column_names(db):
        return  # a new file
    made = max(1, db.execute("PRAGMA user_version").fetchone()[0])
    older = "Fly the sweep again: use --force to overwrite, or --out to choose another folder"
    newer = ", or choose another folder by --out"
    refuse_format(folder, "sweep", made, _FORMAT, newer=newer, older=older)


@contextmanager
def _as_result_errors(path: Path) -> Generator[None]:
    """Turn errors of SQLite and of the operating system into ResultError."""
    try:
        yield
    except sqlite3.OperationalError as error:
        if "locked" in str(error):
            why, remedy = "another sweep is writing it", "Wait until it ends"
        elif "full" in str(error) or shutil.disk_usage(path.parent).free < _ROOM:
            why, remedy = "the disk is full", "Make room and repeat the command, which goes on"
        else:
            why, remedy = str(error), "Check the disk"
        raise ResultError(
            f"{path}: cannot be used: {why}. {remedy}, or choose another folder by --out."
        ) from error
    except (sqlite3.DatabaseError, KeyError, ValueError) as error:
        raise ResultError(
            f"{path}: is damaged or not the store of a sweep ({error}). Use --force to overwrite, or --out to choose"
            " another folder."
        ) from error
    except OSError as error:
        raise unwritable_error(path.parent, error) from error


def diff_names(old: dict[str, Any], new: dict[str, Any]) -> str:
    """Names of what differs between two sweeps, as `Sweep.identity` and `store_contents` have it."""
    names = {
        "vary": "variations",
        "evaluate": "what is evaluated",
        "code": "file of the controller",
    }
    keys = [key for key in {**new, **old} if old.get(key) != new.get(key)]
    return ", ".join(names.get(key, key.replace("_", " ")) for key in keys)
