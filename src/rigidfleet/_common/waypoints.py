"""How well waypoints are to be met: what the check before a flight and the verdict after it have in common."""

#: Greatest miss of a waypoint's position [m], velocity [m/s], attitude [deg] and rates [deg/s]. An outdoor
#: vehicle knows its own state this well; a regulator that meets its waypoint leaves far smaller errors.
WAYPOINT_TOLERANCE = {"position": 0.1, "velocity": 0.1, "attitude": 1.0, "rates": 1.0}
#: Units of these quantities.
UNITS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "deg/s"}
