"""The physics, compiled: constraint force, body frame, closed loop, integrator.

The kernel knows arrays, not missions: a `Program` (see `rigidfleet.kernel.program`) holds
everything it reads, a `Workspace` everything it writes. Importing this package imports Numba.

Numba's own cache does not notice a change in a callee that lives in another file, so the cache
folder is keyed here by a digest of all sources of the kernel.
"""

import hashlib
import os
import sys
import tempfile
from pathlib import Path

import numba


def cache_directory() -> Path:
    """Return the folder of the compiled kernel: one per state of its sources, Numba and Python.

    The base is ``NUMBA_CACHE_DIR`` if set, else ``XDG_CACHE_HOME`` or ``~/.cache``; a folder that
    cannot be written falls back to the system's temporary folder.
    """
    digest = hashlib.sha256(f"{numba.__version__} {sys.version}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    base = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    for root in (Path(base).expanduser(), Path(tempfile.gettempdir())):
        folder = root / "rigidfleet" / f"kernel-{digest.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return folder


def is_compiled() -> bool:
    """Return whether the flight kernel is in the cache, so that nothing has to be compiled."""
    return any(_CACHE.rglob("flight.integrate-*.nbc"))


_CACHE = cache_directory()
_before = numba.config.CACHE_DIR
numba.config.CACHE_DIR = str(_CACHE)
try:
    from rigidfleet.kernel import ensemble as ensemble
    from rigidfleet.kernel import flight as flight
    from rigidfleet.kernel import large as large
finally:
    numba.config.CACHE_DIR = _before
