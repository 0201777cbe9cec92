"""Fly many air vehicles as one rigid body.

>>> import rigidfleet as rf
>>> result = rf.simulate("narrow-passage")
>>> print(rf.assess(result).summary)

What follows is all that most scripts need; the rest is in modules, imported by their names. Everything is
loaded on first use, so that ``import rigidfleet`` and ``rigidfleet --help`` wait neither for the compiler
nor for the plotting library.
"""

from importlib import import_module

from rigidfleet._version import __version__ as __version__

#: The public names of each module; `__init__.pyi` has them for type checkers.
_NAMES = {
    "assessment": ("Verdict", "assess"),
    "errors": ("FlightError", "MissionError", "ResultError", "RigidfleetError", "SweepError"),
    "interchange": ("Export", "export"),
    "mission": ("Mission", "load_mission", "mission_names"),
    "plotting": ("plot",),
    "preflight.check": ("Preflight", "check"),
    "reporting": ("report",),
    "result": ("Result",),
    "rigidity.design": ("design",),
    "simulation.ensemble": ("Ensemble", "establish"),
    "simulation.flight": (
        "AttitudeCommand",
        "Flight",
        "FlightInterrupted",
        "Observation",
        "Progress",
        "RotorCommand",
        "simulate",
    ),
    "simulation.trajectories": ("trajectories",),
    "sweep": ("Sweep",),
    "tuning": ("Tuned", "tune"),
    "web.live": ("live",),
    "web.replay": ("replay",),
}
#: The module of each public name.
_HOME = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted([*_HOME, "__version__"])  # noqa: PLE0605


def __getattr__(name: str) -> object:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
