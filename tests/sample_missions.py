"""Small missions that several tests change."""

from typing import Any


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
