"""Machine code of the flight kernel in the wheel: a shared object for each level of x86-64.

It is made on Linux, on x86-64, of this project's own sources, and linked by the C toolchain. Elsewhere, or without a
linker, the wheel has none, and the first flight compiles the kernel. So does an editable installation, whose sources
change.
"""

import atexit
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

#: Whether machine code is made here.
HERE = (sys.platform, platform.machine()) == ("linux", "x86_64")
#: Of every function outside, the linker takes the version that glibc has always had, and no machine lacks. A wheel says
#: so by the oldest glibc that installers know of.
ALWAYS, TAG = "GLIBC_2.2.5", "py3-none-manylinux_2_17_x86_64"
STEP = """
.symver {name}_always, {name}@{version}
.globl {name}
.hidden {name}
{name}: jmp {name}_always@PLT
"""
#: Neither start files nor libraries of the C compiler become part of the shared object.
LINK = ("cc", "-shared", "-nostartfiles", "-nodefaultlibs", "-s", "-Wl,--no-undefined")


class MachineCode(BuildHookInterface):
    """Adds the machine code to wheels."""

    def dependencies(self) -> list[str]:
        """What compiling needs, in the versions that the project needs."""
        needed = self.metadata.core.dependencies
        return [x for x in needed if HERE and re.match("(llvmlite|numba|numpy)[^a-z]", x)]

    def initialize(self, version: str, build_data: dict) -> None:
        """Make the shared objects, unless the package is only linked to its sources."""
        if not HERE or version == "editable":
            return
        if lacking := [program for program in ("cc", "nm") if not shutil.which(program)]:
            self.app.display_warning(f"The wheel has no machine code: no {' and '.join(lacking)}")
            return
        sys.path.insert(0, str(Path(self.root, "src")))
        from rigidfleet.kernel.compiler.cache import sources_digest
        from rigidfleet.kernel.compiler.levels import LEVELS
        from rigidfleet.kernel.engine import objects

        folder, package = Path(tempfile.mkdtemp()), Path(objects.__file__).parents[2]
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # the wheel is written later
        self.app.display_info(f"Compiling the flight kernel for {' and '.join(LEVELS)}")
        jobs = list(product(LEVELS, objects.ENTRIES))
        # Each of these processes takes up to 600 MB.
        with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
            codes = pool.map(lambda job: objects.compile_objects(*job[::-1]), jobs)
            made = dict(zip(jobs, codes, strict=True))
        include = {}
        try:
            if None in made.values():
                raise OSError("the kernel does not compile here")
            for level in LEVELS:
                target = objects.shipped_object_path(level, sources_digest())
                codes = [code for part in objects.ENTRIES for code in made[level, part]]
                include[link(codes, folder / target.name)] = str(target.relative_to(package.parent))
        except (OSError, subprocess.CalledProcessError) as error:
            self.app.display_warning(f"The wheel has no machine code: {error}")
            return
        build_data["force_include"] |= include
        build_data |= {"tag": TAG, "pure_python": False}


def link(codes: list[bytes], target: Path) -> str:
    """Link objects to a shared object that needs nothing of glibc but what it has always had."""
    objects = []
    for k, code in enumerate(codes):
        objects.append(target.with_name(f"{target.name}.{k}.o"))
        objects[-1].write_bytes(code)
    listed = subprocess.run(["nm", "-u", *objects], capture_output=True, text=True, check=True)
    outside = sorted(set(re.findall(r"^\s+U (\w+)$", listed.stdout, re.MULTILINE)))
    steps = target.with_suffix(".s")
    steps.write_text(
        "".join(STEP.format(name=x, version=ALWAYS) for x in outside if not x.startswith("_"))
        + '.section .note.GNU-stack,"",@progbits\n'
    )
    subprocess.run([*LINK, "-o", target, *objects, steps, "-lm", "-lc"], check=True)
    return str(target)
