"""The public names, as type checkers see them."""

from rigidfleet._version import __version__ as __version__
from rigidfleet.assessment import Verdict as Verdict
from rigidfleet.assessment import assess as assess
from rigidfleet.errors import FlightError as FlightError
from rigidfleet.errors import MissionError as MissionError
from rigidfleet.errors import ResultError as ResultError
from rigidfleet.errors import RigidfleetError as RigidfleetError
from rigidfleet.errors import SweepError as SweepError
from rigidfleet.interchange import Export as Export
from rigidfleet.interchange import export as export
from rigidfleet.mission import Mission as Mission
from rigidfleet.mission import load_mission as load_mission
from rigidfleet.mission import mission_names as mission_names
from rigidfleet.plotting import plot as plot
from rigidfleet.preflight.check import Preflight as Preflight
from rigidfleet.preflight.check import check as check
from rigidfleet.reporting import report as report
from rigidfleet.result import Result as Result
from rigidfleet.rigidity.design import design as design
from rigidfleet.simulation.ensemble import Ensemble as Ensemble
from rigidfleet.simulation.ensemble import establish as establish
from rigidfleet.simulation.flight import AttitudeCommand as AttitudeCommand
from rigidfleet.simulation.flight import Flight as Flight
from rigidfleet.simulation.flight import FlightInterrupted as FlightInterrupted
from rigidfleet.simulation.flight import Observation as Observation
from rigidfleet.simulation.flight import Progress as Progress
from rigidfleet.simulation.flight import RotorCommand as RotorCommand
from rigidfleet.simulation.flight import simulate as simulate
from rigidfleet.simulation.trajectories import trajectories as trajectories
from rigidfleet.sweep import Sweep as Sweep
from rigidfleet.tuning import Tuned as Tuned
from rigidfleet.tuning import tune as tune
from rigidfleet.web.live import live as live
from rigidfleet.web.replay import replay as replay

__all__: list[str]
_HOME: dict[str, str]
