"""GNU Octave's `ode45` on the paper's equations as they stand: the nearest to the paper's MATLAB."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from .case import DURATION, TOLERANCES, AbsentError, Array, Case, Flight, Peer

SCRIPT = Path(__file__).with_name("establish.m")


def peer() -> Peer:
    """ode45, at a tolerance."""
    program = shutil.which("octave-cli") or shutil.which("octave")
    if program is None:
        raise AbsentError(
            "GNU Octave: install the package octave (Debian), with octave-cli on PATH"
        )
    text = subprocess.run([program, "--version"], check=True, capture_output=True, text=True)

    def flight(case: Case, tolerance: float) -> Flight:
        """The undamped law; the time is Octave's own, without its start."""

        def fly() -> tuple[float, Array]:
            with tempfile.TemporaryDirectory() as folder:
                given = {
                    "agents": np.column_stack([case.m, case.r, case.force]),
                    "edges": np.column_stack([case.edges + 1, case.d]),
                    "numbers": np.array([*case.gains, DURATION, tolerance]),
                }
                for name, values in given.items():
                    np.savetxt(Path(folder) / name, values)
                subprocess.run(
                    [program, "--norc", "--quiet", SCRIPT, folder], check=True, capture_output=True
                )
                out = np.loadtxt(Path(folder) / "end")
            return float(out[0]), out[1:].reshape(-1, 3)

        return fly

    return Peer(
        "GNU Octave ode45",
        text.stdout.split("version ")[1].split()[0],
        "the same law and order of method; vectorised",
        True,
        TOLERANCES,
        "tolerance",
        flight,
    )
