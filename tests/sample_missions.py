"""Small missions that several tests change."""

from typing import Any

#: Keys that a phase of a kind needs, beside one that ends it. Formations are those of a test.
REQUIRED_KEYS: dict[str, dict[str, Any]] = {
    "brake": {},
    "establish": {"formation": "frame"},
    "fly": {"position": [1.5, 0, 6]},
    "follow": {"file": "a.csv"},
    "go": {"position": [1.5, 0, 6]},
    "hold": {},
    "land": {},
    "orbit": {"centre": [4, 0, 6], "radius": 4, "rate_deg_s": 12},
    "reshape": {"formation": "wide"},
    "takeoff": {"height": 6},
    "turn": {"yaw_deg": 9.0},
}


def three_points(establish: dict[str, Any], *phases: dict[str, Any]) -> dict[str, Any]:
    """Three agents that form a triangle about (2, 1, 5) m and then fly these phases, smoothly."""
    return {
        "schema_version": 1,
        "name": "smooth",
        "smoothness": "jerk",
        "agents": {"mass": 1.0, "position": [[0, 0, 5], [4, 0, 5], [2, 3, 5]]},
        "formations": {
            "triangle": {"shape": "triangle", "size": 4.0},
            "wide": {"shape": "triangle", "size": 6.0},
        },
        "phases": [{"kind": "establish", "formation": "triangle"} | establish, *phases],
    }


def three_quadrotors(*phases: dict[str, Any]) -> dict[str, Any]:
    """Three quadrotors that establish a triangle within three seconds, and then fly these phases."""
    establish = {"kind": "establish", "formation": "triangle", "blend": 2.5, "until": 3.0}
    return {
        "schema_version": 1, "name": "short", "smoothness": "jerk",
        "vehicles": {"drone": {"model": "paper"}},
        "agents": {"vehicle": "drone", "position": [[1, 6, 3], [5, 4, 3], [4, 7, 3]]},
        "tracking": {"drag_feedforward": True},
        "formations": {"triangle": {"shape": "triangle", "size": 4.0}},
        "phases": [establish, *phases],
    }  # fmt: skip
