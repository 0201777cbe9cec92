"""Tasks of those who change the package: each touches few files, and what it adds works everywhere.

A task is a script below `tests/patches`, and a patch of the same name unless nothing has to change. The patch is
applied to a copy of the package and its documents, and the script runs there, in a process that imports the copy. Where
a patch no longer applies, make the change by hand and write it again: `git diff -U1 > tests/patches/NAME.patch`.
"""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PATCHES = ROOT / "tests" / "patches"
#: Most files of `src` that each task may touch.
TASKS = {
    "add_a_controller": 4, "add_a_kind_of_phase": 3, "add_a_limit": 2, "add_a_quantity": 2,
    "change_a_message_everywhere": 1, "find_eq_12": 0, "say_why_a_flight_failed": 0,
}  # fmt: skip


def test_each_task_is_counted():
    """Every script and patch is one of the tasks."""
    assert {path.stem for path in PATCHES.iterdir() if path.suffix in (".py", ".patch")} == {*TASKS}


@pytest.mark.parametrize(
    "task",
    # A law is compiled with all that calls it.
    [pytest.param(x, marks=pytest.mark.long if x == "add_a_controller" else ()) for x in TASKS],
)
def test_a_task_touches_few_files_and_works(task, tmp_path):
    """The patch of a task touches no more files of the package than it may, applies, and passes its script."""
    for name in ("src", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    patch = PATCHES / f"{task}.patch"
    touched = re.findall(r"^\+\+\+ b/(.*)$", patch.read_text(), re.M) if patch.exists() else []
    assert len([name for name in touched if name.startswith("src/")]) <= TASKS[task]
    if touched:
        subprocess.run(["git", "apply", "--unidiff-zero", patch], cwd=tmp_path, check=True)
    done = subprocess.run(
        [sys.executable, PATCHES / f"{task}.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "done\n"


def test_the_recipe_of_a_controller_names_who_tells_laws_apart():
    """Only the files that CONTRIBUTING names compare the law of a phase with one that has feedback."""
    tells = set()
    for path in (ROOT / "src" / "rigidfleet").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Compare):
                text = ast.unparse(node)
                law = re.search(r"\b(TRACKING|BODY)\b|'(tracking|body)'", text)
                if law and re.search(r"\bcontrols?\b", text):
                    tells.add(path.relative_to(ROOT / "src" / "rigidfleet").as_posix())
    recipe = (ROOT / "CONTRIBUTING.md").read_text().partition("## Add a controller")[2]
    assert "kernel/control.py" in tells
    assert tells <= {*re.findall(r"`([\w/]+\.py)`", recipe)}
    assert len(tells) <= 7
