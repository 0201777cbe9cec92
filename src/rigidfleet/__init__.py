"""Fly many air vehicles as one rigid body.

The names below are loaded on first use, so that ``import rigidfleet`` and ``rigidfleet --help``
wait neither for the compiler nor for the plotting library.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rigidfleet.assess import assess
    from rigidfleet.figures import plot
    from rigidfleet.live import live
    from rigidfleet.mission import load_mission
    from rigidfleet.replay import replay
    from rigidfleet.report import report
    from rigidfleet.result import Result
    from rigidfleet.simulate import simulate

__version__ = "0.1.0"

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
    "assess": "assess",
    "live": "live",
    "load_mission": "mission",
    "plot": "figures",
    "replay": "replay",
    "report": "report",
    "simulate": "simulate",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    def __setattr__(self, name: str, value: object) -> None:
        # Importing the submodule `simulate` makes Python bind it over the function of that name.
        if _HOME.get(name) == name and isinstance(value, ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
