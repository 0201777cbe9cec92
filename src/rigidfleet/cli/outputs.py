"""The files of a flight: where they are, and that nothing is written over unasked."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from rigidfleet.errors import ResultError


@dataclass(frozen=True)
class Files:
    """Where the files of a flight are."""

    folder: Path
    name: str

    @property
    def result(self) -> Path:
        """The flight itself, netCDF."""
        return self.folder / f"{self.name}.nc"

    @property
    def verdict(self) -> Path:
        """Its verdict, JSON."""
        return self.folder / "verdict.json"

    @property
    def table(self) -> Path:
        """Its samples, CSV."""
        return self.folder / f"{self.name}.csv"

    @property
    def figures(self) -> list[Path]:
        """All figures there may be."""
        from rigidfleet.plotting import FORMATS, figure_names

        return [
            self.folder / "figures" / f"{name}.{kind}"
            for name in figure_names()
            for kind in FORMATS
        ]

    @property
    def report(self) -> Path:
        """Its report, HTML."""
        return self.folder / "report.html"

    @property
    def replay(self) -> Path:
        """Its replay, HTML."""
        return self.folder / "replay.html"

    @property
    def derived(self) -> list[Path]:
        """All that is made from the result."""
        return [self.verdict, self.table, self.report, self.replay, *self.figures]

    def claim(self, *, replace: bool) -> None:
        """Make sure, before anything is flown, that the files of a flight can be written.

        Raises
        ------
        ResultError
            There are some already, and they are not to be replaced; or the folder cannot be written.
        """
        there = [path for path in (self.result, *self.derived) if path.exists()]
        if there and not replace:
            raise taken(there[0])
        self.try_out()

    def try_out(self) -> None:
        """Write for a moment into the folder, or into the one that it will be made in.

        Raises
        ------
        ResultError
            It cannot be written.
        """
        folder = self.folder.absolute()
        while not os.path.lexists(folder):
            folder = folder.parent
        try:
            TemporaryFile(dir=folder).close()
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def make_folder(self) -> None:
        """Make the folder, if it is not there.

        Raises
        ------
        ResultError
            It cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def make_new_folder(self) -> Files:
        """Make a folder that was not there: this one, or where that is taken, one with a number.

        Raises
        ------
        ResultError
            It cannot be made.
        """
        folder, count = self.folder, 1
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            while True:
                try:
                    folder.mkdir()
                    return Files(folder, self.name)
                except FileExistsError:
                    count += 1
                    folder = self.folder.with_name(f"{self.folder.name}-{count}")
        except OSError as error:
            raise unwritable(folder, error) from error

    def forget(self) -> None:
        """Remove what was made from an earlier result."""
        for path in self.derived:
            path.unlink(missing_ok=True)


def taken(path: Path) -> ResultError:
    """Of a file that is there and shall not be replaced."""
    return ResultError(
        f"{path}: exists already and is kept. "
        "Replace it by --force, or name another place by --out."
    )


def unwritable(path: Path, error: OSError) -> ResultError:
    """Of a place that cannot be written."""
    why = (error.strerror or str(error)).lower()
    return ResultError(f"{path}: cannot be written ({why}). Name another folder by --out.")
