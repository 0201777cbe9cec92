"""What the server of drawing processes loads, once, when it starts; nothing else should import this module.

Server and processes collect no garbage, which takes a tenth of their time: they end after some figures.
"""

import gc
from importlib import import_module

gc.disable()
for _name in (
    "rigidfleet.plotting", "rigidfleet.plotting.figure", "rigidfleet.mission", "rigidfleet.cli.drawing",
    "matplotlib.backends.backend_agg", "matplotlib.patheffects", "mpl_toolkits.mplot3d.axes3d",
):  # fmt: skip
    import_module(_name)
