"""What the first drawing process loads when it starts, for all; nothing else should import this module.

Drawing processes do not write the help of each artist, as matplotlib does whenever it is loaded, for nearly half of the
time to load it.
"""

from importlib import import_module
from typing import Any

from matplotlib import artist

_help: Any = artist
_help.kwdoc = lambda _: ""
_help.Artist._update_set_signature_and_docstring = lambda: None
for _name in (
    "rigidfleet.plotting.figure", "matplotlib.backends.backend_agg",
    "matplotlib.patheffects", "mpl_toolkits.mplot3d.axes3d",
):  # fmt: skip
    import_module(_name)
