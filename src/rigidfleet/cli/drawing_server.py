"""What the server of drawing processes loads, once, when it starts; nothing else should import this module.

Server and processes collect no garbage, which takes a tenth of their time: they end after some figures. Nor does the
server write the help of each artist, as matplotlib does whenever it is loaded, for a fifth of the time to load all this.
"""

import gc
from importlib import import_module
from typing import Any, cast

from matplotlib import artist

gc.disable()
cast("Any", artist.Artist)._update_set_signature_and_docstring = lambda: None
for _name in (
    "rigidfleet.plotting", "rigidfleet.plotting.figure", "rigidfleet.plotting.layout", "rigidfleet.mission",
    "rigidfleet.cli.drawing", "matplotlib.backends.backend_agg", "matplotlib.patheffects",
    "mpl_toolkits.mplot3d.axes3d",
):  # fmt: skip
    import_module(_name)
