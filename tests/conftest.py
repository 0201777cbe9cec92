import os

from hypothesis import settings

os.environ.setdefault("MPLBACKEND", "Agg")

# Compiling takes longer than any deadline; a red test is to be red for everybody.
settings.register_profile("rigidfleet", deadline=None, derandomize=True, database=None)
settings.load_profile("rigidfleet")
