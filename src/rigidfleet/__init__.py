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

TYPE_CHECKING = False  # for the command, which has to take over Ctrl-C before it loads `typing`
if TYPE_CHECKING:
    from rigidfleet.assessment import Verdict, assess
    from rigidfleet.errors import (
        FlightError,
        MissionError,
        ResultError,
        RigidfleetError,
        SweepError,
    )
    from rigidfleet.interchange import Export, export
    from rigidfleet.mission import Mission, load_mission, mission_names
    from rigidfleet.plotting import plot
    from rigidfleet.preflight.check import Preflight, check
    from rigidfleet.reporting import report
    from rigidfleet.result import Result
    from rigidfleet.rigidity.design import design
    from rigidfleet.simulation.ensemble import Ensemble, establish
    from rigidfleet.simulation.flight import (
        AttitudeCommand,
        Flight,
        FlightInterrupted,
        Observation,
        Progress,
        RotorCommand,
        simulate,
    )
    from rigidfleet.simulation.trajectories import trajectories
    from rigidfleet.sweep import Sweep
    from rigidfleet.tuning import Tuned, tune
    from rigidfleet.web.live import live
    from rigidfleet.web.replay import replay


__all__ = [
    "AttitudeCommand",
    "Ensemble",
    "Export",
    "Flight",
    "FlightError",
    "FlightInterrupted",
    "Mission",
    "MissionError",
    "Observation",
    "Preflight",
    "Progress",
    "Result",
    "ResultError",
    "RigidfleetError",
    "RotorCommand",
    "Sweep",
    "SweepError",
    "Tuned",
    "Verdict",
    "__version__",
    "assess",
    "check",
    "design",
    "establish",
    "export",
    "live",
    "load_mission",
    "mission_names",
    "plot",
    "replay",
    "report",
    "simulate",
    "trajectories",
    "tune",
]

#: The module of each public name.
_HOME = {
    "AttitudeCommand": "simulation.flight",
    "Ensemble": "simulation.ensemble",
    "Export": "interchange",
    "Flight": "simulation.flight",
    "FlightError": "errors",
    "FlightInterrupted": "simulation.flight",
    "Mission": "mission",
    "MissionError": "errors",
    "Observation": "simulation.flight",
    "Preflight": "preflight.check",
    "Progress": "simulation.flight",
    "Result": "result",
    "ResultError": "errors",
    "RigidfleetError": "errors",
    "RotorCommand": "simulation.flight",
    "Sweep": "sweep",
    "SweepError": "errors",
    "Tuned": "tuning",
    "Verdict": "assessment",
    "assess": "assessment",
    "check": "preflight.check",
    "design": "rigidity.design",
    "establish": "simulation.ensemble",
    "export": "interchange",
    "live": "web.live",
    "load_mission": "mission",
    "mission_names": "mission",
    "plot": "plotting",
    "replay": "web.replay",
    "report": "reporting",
    "simulate": "simulation.flight",
    "trajectories": "simulation.trajectories",
    "tune": "tuning",
}


def __getattr__(name: str) -> object:
    """Load a public name from its module on first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
