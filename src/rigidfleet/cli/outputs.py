"""Paths of the files of a flight. Existing files are not overwritten unless the user asks for it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Literal

from rigidfleet._common.files import make_folder, unwritable_error, write_file
from rigidfleet.cli import console
from rigidfleet.errors import ResultError, RigidfleetError

if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict
    from rigidfleet.result import Result


#: Figures that are drawn unless all are wanted.
FEW = ("summary", "trajectory")


class Files:
    """Paths of the files of a flight.

    Attributes
    ----------
    result, table : result, netCDF, and table of the samples, CSV; they have the name of the flight
    verdict, report, replay : verdict, JSON; report and replay, HTML
    """

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.result, self.table = folder / f"{name}.nc", folder / f"{name}.csv"
        self.verdict = folder / "verdict.json"
        self.report, self.replay = folder / "report.html", folder / "replay.html"

    def list_figure_paths(
        self, which: Literal["few", "all"] = "all", formats: Iterable[str] | None = None
    ) -> list[Path]:
        """All possible figures, or the few that are looked at after a flight; by default in all formats."""
        from rigidfleet.plotting import FORMATS, figure_names

        names = figure_names() if which == "all" else FEW
        kinds = FORMATS if formats is None else formats
        return [self.folder / "figures" / f"{name}.{kind}" for name in names for kind in kinds]

    @property
    def derived_paths(self) -> list[Path]:
        """All files that are derived from the result."""
        return [self.verdict, self.table, self.report, self.replay, *self.list_figure_paths()]

    def check_writable(self, *, replace: bool) -> None:
        """Check before a flight that its files can be written.

        Raises
        ------
        ResultError
            Files exist and must not be overwritten, or the folder cannot be written.
        """
        refuse_overwriting(self.result, *self.derived_paths, force=replace)
        self.check_folder_writable()

    def check_folder_writable(self) -> None:
        """Test that the folder, or the folder in which it will be created, can be written.

        Raises
        ------
        ResultError
            The folder cannot be written.
        """
        folder = self.folder.absolute()
        # The root is missing, too, on a drive that is not there
        while not os.path.lexists(folder) and folder != folder.parent:
            folder = folder.parent
        try:
            TemporaryFile(dir=folder).close()
        except OSError as error:
            raise unwritable_error(self.folder, error) from error

    def make_unique_folder(self) -> Files:
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
            raise unwritable_error(folder, error) from error

    def save_result_and_verdict(self, result: Result, verdict: Verdict | None = None) -> Verdict:
        """Write a result and its verdict, without what is left of an earlier result, and return the verdict.

        Raises
        ------
        ResultError
            A file cannot be written.
        """
        from rigidfleet.assessment import assess

        make_folder(self.folder)
        result.save(self.result)
        for path in self.derived_paths:
            path.unlink(missing_ok=True)
        verdict = assess(result) if verdict is None else verdict
        self.write_verdict(verdict)
        return verdict

    def write_verdict(self, verdict: Verdict) -> None:
        """Write a verdict as JSON."""
        write_file(self.verdict, (verdict.json() + "\n").encode())

    def print_paths(self) -> None:
        """Print the paths of the files that are there."""
        console.out().print()
        for what, path in (
            ("Result", self.result), ("Verdict", self.verdict), ("Table", self.table), ("Report", self.report),
            ("Replay", self.replay),
        ):  # fmt: skip
            if path.exists():
                how = " (open it in a browser)" if path.suffix == ".html" else ""
                console.out().print(f"{what:8} {path}{how}", soft_wrap=True)
        if drawn := [path for path in self.list_figure_paths() if path.exists()]:
            text = f"Figures  {drawn[0].parent}{os.sep} ({console.count_text(len(drawn), 'file')})"
            console.out().print(text, soft_wrap=True)


def with_toml_suffix(path: Path) -> Path:
    """The path of a mission: with .toml, as reading expects it; a folder is refused."""
    if not path.name:
        raise RigidfleetError(f"{path}: is a folder. Name a file.")
    return path if path.suffix == ".toml" else path.with_name(f"{path.name}.toml")


def refuse_overwriting(
    *paths: Path | None, force: bool, other: str = "--out to choose another place"
) -> None:
    """Refuse to overwrite files that exist, except with ``force``; ``other`` is the other remedy.

    Raises
    ------
    ResultError
        One of them exists.
    """
    for path in paths:
        if path is not None and path.exists() and not force:
            raise ResultError(f"{path}: already exists; use --force to overwrite or {other}.")
