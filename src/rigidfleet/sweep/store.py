"""Where a sweep's rows are kept: one SQLite file, written by one process, a transaction for each chunk.

SQLite because a chunk that was committed survives kill -9 at any moment and one that was not leaves no
trace; the run's number is the primary key, so that no run counts twice; it comes with Python; and any
tool reads it, also while the sweep goes on.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from rigidfleet.errors import ResultError
from rigidfleet.sweep.definition import Sweep
from rigidfleet.sweep.metrics import METRICS
from rigidfleet.sweep.record import RunRecord
from rigidfleet.typing import Bools, Floats, Ints

FILE = "sweep.db"
#: Locked by the process that writes; the lock ends with it, however it ends.
_LOCK = "sweep.lock"
#: Version of the store's format, its `user_version`; the first one has 0.
_FORMAT = 2
_COLUMNS = ("passed", "reason", "detail", "wall", "codes", *METRICS)
#: Little-endian, so that the file reads the same everywhere.
_CODES = np.dtype("<f8")


@dataclass(frozen=True)
class Table:
    """Rows of a sweep as arrays, in the order of their numbers.

    Attributes
    ----------
    sweep : what was flown
    run : numbers (n,) of the runs that are there, from 0
    passed : whether each passed (n,)
    reason, detail : why it did not (n,)
    codes : value of each column (n, D), as `Variation.code` has it
    metrics : values (n,) of each metric, NaN where it does not apply
    wall : how long each took (n,) [s]
    """

    sweep: Sweep
    run: Ints
    passed: Bools
    reason: NDArray[np.object_]
    detail: NDArray[np.object_]
    codes: Floats
    metrics: dict[str, Floats]
    wall: Floats

    @property
    def complete(self) -> bool:
        """Whether every run is there."""
        return len(self.run) == self.sweep.runs


class Store:
    """The store of one sweep, open for writing: a context.

    Raises
    ------
    ResultError
        The folder holds another sweep, a file that is none, or cannot be written.
    """

    def __init__(self, folder: Path, sweep: Sweep, *, replace: bool = False) -> None:
        self.path = folder / FILE
        with _explained(self.path):
            folder.mkdir(parents=True, exist_ok=True)
            self.lock = sqlite3.connect(folder / _LOCK, timeout=0.0, isolation_level=None)
            try:
                self.lock.execute("BEGIN EXCLUSIVE")
                if replace:
                    for end in ("-wal", "-shm", ""):
                        self.path.with_name(FILE + end).unlink(missing_ok=True)
                self.db = sqlite3.connect(self.path, isolation_level=None)
                try:
                    self._open(sweep)
                except BaseException:
                    self.db.close()
                    raise
            except BaseException:
                self.lock.close()
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self.db.close()
        self.lock.close()

    def add(self, rows: Iterable[RunRecord]) -> None:
        """Keep rows: all of them or none. Those of a number that is there already take its place."""
        entries = [
            (
                row.run, int(row.passed), row.reason, row.detail, row.wall,
                np.array(row.codes, dtype=_CODES).tobytes(),
                *(None if math.isnan(x) else x for x in (row.metrics[name] for name in METRICS)),
            )
            for row in rows
        ]  # fmt: skip
        marks = ", ".join("?" * (len(_COLUMNS) + 1))
        with _explained(self.path), self._transaction():
            self.db.executemany(f"INSERT OR REPLACE INTO runs VALUES ({marks})", entries)

    def there(self) -> Bools:
        """Which of the sweep's runs are there (runs,)."""
        found = np.zeros(self.runs, dtype=bool)
        with _explained(self.path):
            numbers = self.db.execute("SELECT run FROM runs WHERE run < ?", (self.runs,))
            found[[n for (n,) in numbers]] = True
        return found

    def _open(self, sweep: Sweep) -> None:
        self.runs = sweep.runs
        self.db.execute("PRAGMA journal_mode = WAL")
        self.db.execute("PRAGMA synchronous = NORMAL")
        identity = json.dumps(sweep.identity, ensure_ascii=False, sort_keys=True)
        with self._transaction():
            _readable(self.db, self.path.parent)
            self.db.execute(f"PRAGMA user_version = {_FORMAT}")
            self.db.execute("CREATE TABLE IF NOT EXISTS sweep (key TEXT PRIMARY KEY, value TEXT)")
            self.db.execute(f"CREATE TABLE IF NOT EXISTS runs ({_schema()})")
            there = dict(self.db.execute("SELECT key, value FROM sweep"))
            if there and there.get("identity") != identity:
                raise ResultError(f"{self.path.parent}: {_difference(there, identity)}")
            if there and json.loads(there["sweep"])["runs"] > sweep.runs:
                n = json.loads(there["sweep"])["runs"]
                raise ResultError(
                    f"{self.path.parent}: holds this sweep with {n} runs, more than {sweep.runs}. Ask for as"
                    " many, or replace it by --force, or name another folder by --out."
                )
            entries = {"identity": identity, "sweep": sweep.json()}
            self.db.executemany("INSERT OR REPLACE INTO sweep VALUES (?, ?)", entries.items())

    @contextmanager
    def _transaction(self) -> Generator[None]:
        self.db.execute("BEGIN IMMEDIATE")
        try:
            yield
            self.db.execute("COMMIT")
        except BaseException:
            self.db.execute("ROLLBACK")
            raise


def is_store(folder: Path) -> bool:
    """Whether a folder holds a sweep."""
    return (folder / FILE).is_file()


def read_sweep(folder: Path) -> Sweep:
    """The sweep of a folder.

    Raises
    ------
    ResultError
        There is none.
    """
    with _reading(folder) as db:
        entries = dict(db.execute("SELECT key, value FROM sweep"))
        return Sweep.from_json(entries["sweep"])


def read(folder: str | Path) -> Table:
    """All rows of a folder's sweep; also while it is flown.

    Raises
    ------
    ResultError
        There is no sweep.
    """
    folder = Path(folder)
    sweep = read_sweep(folder)
    names = ", ".join(f'"{name}"' for name in _COLUMNS)
    with _reading(folder) as db:
        rows = db.execute(f"SELECT run, {names} FROM runs ORDER BY run").fetchall()
    run, passed, reason, detail, wall, codes, *metrics = list(zip(*rows, strict=True)) or [
        () for _ in ("run", *_COLUMNS)
    ]
    return Table(
        sweep,
        np.array(run, dtype=np.int64),
        np.array(passed, dtype=bool),
        np.array(reason, dtype=object),
        np.array(detail, dtype=object),
        np.frombuffer(b"".join(codes), dtype=_CODES).reshape(len(run), len(sweep.columns)),
        {name: np.array(x, dtype=np.float64) for name, x in zip(METRICS, metrics, strict=True)},
        np.array(wall, dtype=np.float64),
    )


@contextmanager
def _reading(folder: Path) -> Generator[sqlite3.Connection]:
    path = folder / FILE
    if not path.is_file():
        raise ResultError(f"{folder}: holds no sweep. `rigidfleet sweep` makes one.")
    with _explained(path):
        db = sqlite3.connect(path)
        try:
            _readable(db, folder)
            yield db
        finally:
            db.close()


def _readable(db: sqlite3.Connection, folder: Path) -> None:
    """ResultError where a store is of another format."""
    if db.execute("SELECT 1 FROM sqlite_master WHERE name = 'sweep'").fetchone() is None:
        return  # new
    made = max(1, db.execute("PRAGMA user_version").fetchone()[0])
    if made > _FORMAT:
        raise ResultError(
            f"{folder}: holds a sweep of format {made}, and this version of rigidfleet reads up to {_FORMAT}. Use a"
            " newer version, or name another folder by --out."
        )
    if made < _FORMAT:
        raise ResultError(
            f"{folder}: holds a sweep written by an earlier rigidfleet (sweep format {made}); this one reads format"
            f" {_FORMAT}. Fly the sweep again: replace it by --force, or name another folder by --out."
        )


@contextmanager
def _explained(path: Path) -> Generator[None]:
    """SQLite's errors, and the system's, in words."""
    try:
        yield
    except sqlite3.OperationalError as error:
        why = "another sweep is writing it" if "locked" in str(error) else str(error)
        raise ResultError(
            f"{path}: cannot be used: {why}. Wait for it, free the disk, or name another folder by --out."
        ) from error
    except (sqlite3.DatabaseError, KeyError, ValueError) as error:
        raise ResultError(
            f"{path}: is no store of a sweep, or damaged ({error}). Replace it by --force, or name"
            " another folder by --out."
        ) from error
    except OSError as error:
        why = (error.strerror or str(error)).lower()
        raise ResultError(
            f"{path.parent}: cannot be written ({why}). Name another folder by --out."
        ) from error


def _schema() -> str:
    kinds = {"passed": "INTEGER", "reason": "TEXT", "detail": "TEXT", "codes": "BLOB"}
    columns = (f'"{name}" {kinds.get(name, "REAL")}' for name in _COLUMNS)
    return f"run INTEGER PRIMARY KEY, {', '.join(columns)}"


def _difference(there: dict[str, str], identity: str) -> str:
    """What sets the sweep that is there apart from the one asked for."""
    old, new = json.loads(there["identity"]), json.loads(identity)
    names = {
        "mission": "mission",
        "vary": "variations",
        "seed": "seed",
        "evaluate": "what is evaluated",
        "version": "version",
    }
    other = [words for key, words in names.items() if old.get(key) != new[key]]
    return (
        f"holds another sweep, it differs in: {', '.join(other)}. It is kept; replace it by --force, or name"
        " another folder by --out."
    )
