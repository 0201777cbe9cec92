import importlib
import os
import sys
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")
# As in the command: matrices are small, and where each of several processes of tests has several threads, these take up
# to twenty times the processor time by waiting for each other. To be set before NumPy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Compiling takes longer than any deadline; a red test is to be red for everybody.
settings.register_profile("rigidfleet", deadline=None, derandomize=True, database=None)
settings.load_profile("rigidfleet")


@pytest.fixture(scope="session")
def benchmark_named():
    """A module of the benchmarks by its name; it imports those beside it."""
    folder = str(Path(__file__).parents[1] / "benchmarks")
    sys.path.insert(0, folder)
    yield importlib.import_module
    sys.path.remove(folder)
