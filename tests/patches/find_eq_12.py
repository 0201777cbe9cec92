"""Eq. (12) of the paper is found in one hop from its page, in functions that name it."""

import pkgutil
import re
from pathlib import Path

(row,) = re.findall(
    r"^\| 12 \| (constraint force.*)$", Path("docs/paper.md").read_text(), re.MULTILINE
)
names = re.findall(r"`((?:\w+\.)+\w+)`", row)
assert "kernel.constraint.constraint_force" in names
for name in names:
    pkgutil.resolve_name(f"rigidfleet.{name}")
for module in ("kernel/constraint.py", "math/pid.py", "physics.py"):
    assert "Eq. (12)" in Path("src/rigidfleet", module).read_text(), module
print("done")
