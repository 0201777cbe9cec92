"""What the first drawing process loads when it starts, for all; nothing else should import this module.

Drawing processes collect no garbage, which takes a tenth of their time: they end after some figures. Nor do they write
the help of each artist, as matplotlib does whenever it is loaded, for a third of the time to load it.
"""

import gc
from importlib import import_module
from typing import Any, cast

from matplotlib import artist

gc.disable()
cast("Any", artist.Artist)._update_set_signature_and_docstring = lambda: None
for _name in (
    "rigidfleet.plotting.figure", "rigidfleet.plotting.layout", "matplotlib.backends.backend_agg",
    "matplotlib.patheffects", "mpl_toolkits.mplot3d.axes3d",
):  # fmt: skip
    import_module(_name)
