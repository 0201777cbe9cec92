"""Tasks of a stranger, kept as patches: each applies to a copy of the package, touches few files, and passes."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
PATCHES = sorted((HERE / "patches").glob("*.patch"))


@pytest.mark.parametrize("patch", PATCHES, ids=lambda path: path.stem)
def test_a_task_of_a_stranger(patch, tmp_path):
    """The patch applies, changes no more files of src than its head promises, and its own test passes."""
    text = patch.read_text(encoding="utf-8")
    promised = re.search(r"Files of src: (\d+)", text)
    assert promised, "the head of a patch says how many files of src it touches"
    files = {name for name in re.findall(r"^\+\+\+ b/(\S+)", text, flags=re.MULTILINE)}
    assert sum(name.startswith("src/") for name in files) <= int(promised[1])
    leave = shutil.ignore_patterns("__pycache__")
    shutil.copytree(HERE.parent / "src", tmp_path / "src", ignore=leave)
    subprocess.run(["git", "apply", "--whitespace=error", str(patch)], cwd=tmp_path, check=True)
    path = os.pathsep.join([str(tmp_path / "src"), str(HERE)])
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
