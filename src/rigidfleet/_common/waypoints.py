"""How well waypoints and shapes are to be met: what missions, their check and the verdict have in common."""

#: Greatest miss of a waypoint's position [m], velocity [m/s], attitude [deg] and rates [deg/s]. An outdoor
#: vehicle knows its own state this well; a regulator that meets its waypoint leaves far smaller errors.
WAYPOINT_TOLERANCE = {"position": 0.1, "velocity": 0.1, "attitude": 1.0, "rates": 1.0}
#: Units of these quantities.
UNITS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "deg/s"}
#: Greatest error of a distance, relative to the shortest intended one, at the end of a shaping phase and of the flight,
#: where a formation has no tolerance of its own. A shape that is reached has errors below 1e-3; one folded another
#: way, of some tenths.
SHAPE_TOLERANCE = 0.01
#: Share of a limit, or of a unit, by which rounding may exceed it.
LEEWAY = 1e-9
#: A vehicle that stays within this distance of an obstacle below it from the start, or until the end, stands on it [m].
PAD = 0.1
