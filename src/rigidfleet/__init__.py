"""Fly many air vehicles as one rigid body.

The names below are loaded on first use, so that ``import rigidfleet`` and ``rigidfleet --help``
wait neither for the compiler nor for the plotting library.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from rigidfleet._version import __version__ as __version__

if TYPE_CHECKING:
    from rigidfleet.assessment import assess
    from rigidfleet.mission import load_mission
    from rigidfleet.plotting import plot
    from rigidfleet.reporting import report
    from rigidfleet.result import Result
    from rigidfleet.simulation.flight import simulate
    from rigidfleet.web.live import live
    from rigidfleet.web.replay import replay


__all__ = [
    "Result",
    "__version__",
    "assess",
    "live",
    "load_mission",
    "plot",
    "replay",
    "report",
    "simulate",
]

_HOME = {
    "Result": "result",
    "assess": "assessment",
    "live": "web.live",
    "load_mission": "mission",
    "plot": "plotting",
    "replay": "web.replay",
    "report": "reporting",
    "simulate": "simulation.flight",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
