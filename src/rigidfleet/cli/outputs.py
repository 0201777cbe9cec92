"""Paths of the files of a flight. Existing files are not overwritten unless the user asks for it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

from rigidfleet.errors import ResultError


@dataclass(frozen=True)
class Files:
    """Paths of the files of a flight."""

    folder: Path
    name: str

    @property
    def result(self) -> Path:
        """Result of the flight, netCDF."""
        return self.folder / f"{self.name}.nc"

    @property
    def verdict(self) -> Path:
        """Verdict, JSON."""
        return self.folder / "verdict.json"

    @property
    def table(self) -> Path:
        """Table of the samples, CSV."""
        return self.folder / f"{self.name}.csv"

    @property
    def figures(self) -> list[Path]:
        """All possible figures."""
        from rigidfleet.plotting import FORMATS, figure_names

        return [
            self.folder / "figures" / f"{name}.{kind}"
            for name in figure_names()
            for kind in FORMATS
        ]

    @property
    def report(self) -> Path:
        """Report, HTML."""
        return self.folder / "report.html"

    @property
    def replay(self) -> Path:
        """Replay, HTML."""
        return self.folder / "replay.html"

    @property
    def derived(self) -> list[Path]:
        """All files that are derived from the result."""
        return [self.verdict, self.table, self.report, self.replay, *self.figures]

    def claim(self, *, replace: bool) -> None:
        """Check before a flight that its files can be written.

        Raises
        ------
        ResultError
            Files exist and must not be overwritten, or the folder cannot be written.
        """
        there = [path for path in (self.result, *self.derived) if path.exists()]
        if there and not replace:
            raise taken(there[0])
        self.try_out()

    def try_out(self) -> None:
        """Test that the folder, or the folder in which it will be created, can be written.

        Raises
        ------
        ResultError
            The folder cannot be written.
        """
        folder = self.folder.absolute()
        while not os.path.lexists(folder):
            folder = folder.parent
        try:
            TemporaryFile(dir=folder).close()
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def make_folder(self) -> None:
        """Create the folder if it does not exist.

        Raises
        ------
        ResultError
            The folder cannot be created.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise unwritable(self.folder, error) from error

    def make_new_folder(self) -> Files:
        """Create a new folder: this one, or if it exists, one with a number added to its name.

        Raises
        ------
        ResultError
            The folder cannot be created.
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
        """Remove all files that are derived from an earlier result."""
        for path in self.derived:
            path.unlink(missing_ok=True)


def taken(path: Path) -> ResultError:
    """Error about a file that exists and must not be overwritten."""
    return ResultError(
        f"{path}: already exists; use --force to overwrite or --out to choose another place."
    )


def unwritable(path: Path, error: OSError) -> ResultError:
    """Error about a folder that cannot be written."""
    why = (error.strerror or str(error)).lower()
    return ResultError(f"{path}: cannot be written ({why}). Choose another folder by --out.")
