"""glTF 2.0 in one binary file (.glb): an animation for Blender and other programs that draw.

Source: the glTF 2.0 specification of Khronos: cubic splines (appendix C), the binary container (section 4); for lights,
its ratified extension KHR_animation_pointer. Axes are right-handed with y up: (x, y, z) of a mission is (x, z, -y)
there. No package is used: those on offer either write no animations (trimesh) or only wrap the JSON (pygltflib, which
the tests read with).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np

from rigidfleet.foreign.curves import with_headings
from rigidfleet.interchange.curves import ExportedMotion, cubic_curves, yaw_knots
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.result import lights
from rigidfleet.typing import Floats, Ints

_FLOAT, _UNSIGNED = 5126, 5125
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
#: Extension by which lights change, and the camera's vertical angle of view [rad].
_POINTER, _FOV = "KHR_animation_pointer", 0.6
#: An octahedron of radius 1: corners and triangles.
_CORNERS = np.kron(np.eye(3), [[1.0], [-1.0]]) + 0.0  # no -0.0
_FACES = np.array(
    [[2, 4, 0], [2, 1, 4], [2, 5, 1], [2, 0, 5], [3, 0, 4], [3, 4, 1], [3, 1, 5], [3, 5, 0]]
)
#: Turns rows (..., 3) with z up to rows with y up; its transpose turns them back.
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class _File:
    """The parts of a file as they are added: arrays in one buffer, each with its description."""

    def __init__(self) -> None:
        self.data, self.views, self.accessors = bytearray(), [], []

    def add_array(self, x: Floats | Ints, dtype: str = "<f4", *, bounds: bool = False) -> int:
        """Add an array (K,) or (K, n) and return its number."""
        values = np.asarray(x, dtype=dtype)
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += values.tobytes()
        each = 1 if values.ndim == 1 else values.shape[1]
        described: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": _FLOAT if dtype == "<f4" else _UNSIGNED,
            "count": len(values),
            "type": _TYPES[each],
        }
        if bounds:
            low, high = (getattr(values.reshape(-1, each), f)(axis=0) for f in ("min", "max"))
            described |= {"min": low.tolist(), "max": high.tolist()}
        self.accessors.append(described)
        return len(self.accessors) - 1


def write_gltf(motion: ExportedMotion, tolerance: float) -> Iterator[bytes]:
    """One scene: a node for each vehicle, moved along cubic splines; its yaw turns at the same keys, and between.

    If the flight has lights, each vehicle shines in its own, seen by a camera in front.
    """
    file = _File()
    mesh = {
        "attributes": {"POSITION": file.add_array(_CORNERS, bounds=True)},
        "indices": file.add_array(_FACES.ravel(), "<u4"),
    }
    nodes, samplers, channels = [], [], []
    radii = motion.result.mission.fleet.radius.tolist()
    for agent, curve in enumerate(cubic_curves(motion, tolerance)):
        times, yaws = yaw_knots(curve)
        turned = np.stack([0 * yaws, np.sin(yaws / 2), 0 * yaws, np.cos(yaws / 2)], axis=1)
        for path, time, values, way in (
            ("translation", curve.time, _hermite_rows(curve), "CUBICSPLINE"),
            ("rotation", times, turned, "LINEAR"),
        ):
            keys = {"input": file.add_array(time, bounds=True), "output": file.add_array(values)}
            samplers.append(keys | {"interpolation": way})
            channels.append({"sampler": len(samplers) - 1, "target": {"node": agent, "path": path}})
        nodes.append(
            {"name": f"agent {agent + 1}", "mesh": 0, "scale": [max(radii[agent], 0.05)] * 3}
        )
    scene: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "rigidfleet"},
        "scene": 0,
        "scenes": [{"name": motion.result.mission.name, "nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": [mesh]}],
        "animations": [{"name": "flight", "samplers": samplers, "channels": channels}],
        "bufferViews": file.views,
        "accessors": file.accessors,
    }
    if lights.has_lights(motion.result):
        _add_lights(scene, file, motion)
    scene["buffers"] = [{"byteLength": len(file.data)}]
    words = json.dumps(scene).encode()
    parts = [(_JSON, words + b" " * (-len(words) % 4)), (_BINARY, bytes(file.data))]
    size = 12 + sum(8 + len(part) for _, part in parts)
    yield struct.pack("<III", _MAGIC, 2, size) + b"".join(
        struct.pack("<II", len(part), kind) + part for kind, part in parts
    )


def _add_lights(scene: dict[str, Any], file: _File, motion: ExportedMotion) -> None:
    """Add lights and a camera to a scene: a material for each vehicle, whose emission changes.

    Programs without the extension show the last colour of each that is not black.
    """
    result, animation, n = motion.result, scene["animations"][0], motion.n_agents
    # A change at once takes a millisecond. Samplers are linear where they do not say.
    ends = [t for fade in lights.light_fades(result) for t in (fade.begin, fade.end + 1e-3)]
    times = np.unique(np.clip(ends, motion.start, motion.end).round(4))
    shown = lights.light_colours(result, times)
    shown = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)  # linear
    last = len(times) - 1 - shown[::-1].any(axis=2).argmax(axis=0)
    scene["extensionsUsed"] = [_POINTER]
    black = {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0}}
    colours = shown[last, np.arange(n)].tolist()
    scene["materials"] = [black | {"emissiveFactor": colour} for colour in colours]
    (shape,) = scene["meshes"][0]["primitives"]
    scene["meshes"] = [{"primitives": [shape | {"material": i}]} for i in range(n)]
    keys = file.add_array(times - motion.start, bounds=True)
    for i, node in enumerate(scene["nodes"]):
        node["mesh"] = i
        animation["samplers"].append({"input": keys, "output": file.add_array(shown[:, i])})
        pointer = {_POINTER: {"pointer": f"/materials/{i}/emissiveFactor"}}
        target = {"path": "pointer", "extensions": pointer}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})
    low, high = result.position.min(axis=(0, 1)), result.position.max(axis=(0, 1))
    far = float(np.linalg.norm(high - low)) / 2 / np.sin(_FOV / 2)
    right, up, back = lights.camera_axes(*lights.angles_facing_formation(result))
    axes = np.stack([right, up, back, (low + high) / 2 + far * back])
    matrix = np.column_stack([axes @ _Y_UP, [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()
    seen = {"yfov": _FOV, "znear": 0.01 * far, "zfar": 10 * far}
    scene["cameras"] = [{"type": "perspective", "perspective": seen}]
    scene["nodes"].append({"name": "front", "camera": 0, "matrix": matrix})
    scene["scenes"][0]["nodes"].append(n)


def read_gltf(data: bytes) -> list[Piecewise]:
    """The ways in a file of `write_gltf`, from time zero on. Rotation is on lines of the angle, as slerp turns."""
    length = struct.unpack_from("<I", data, 12)[0]
    scene = json.loads(data[20 : 20 + length])
    binary = data[28 + length :]

    def array(number: int) -> Floats:
        accessor = scene["accessors"][number]
        view = scene["bufferViews"][accessor["bufferView"]]
        each = {name: n for n, name in _TYPES.items()}[accessor["type"]]
        numbers = np.frombuffer(binary, "<f4", accessor["count"] * each, view["byteOffset"])
        return numbers.astype(float).reshape(-1, each)

    animation = scene["animations"][0]
    channels = [x for x in animation["channels"] if "node" in x["target"]]
    curves = []
    for moved, turned in zip(channels[::2], channels[1::2], strict=True):
        (time, values), (times, quaternions) = (
            [array(animation["samplers"][channel["sampler"]][key]) for key in ("input", "output")]
            for channel in (moved, turned)
        )
        before, at, after = (x @ _Y_UP.T for x in values.reshape(-1, 3, 3).swapaxes(0, 1))
        begin, end = np.stack([at[:-1], after[:-1]]), np.stack([at[1:], before[1:]])
        yaw = np.unwrap(2.0 * np.arctan2(quaternions[:, 1], quaternions[:, 3]))
        way = Piecewise.of_end_states(time[:, 0], begin, end)
        curves.append(with_headings(way, times[:, 0], yaw))
    return curves


def _hermite_rows(curve: Piecewise) -> Floats:
    """Rows (3 K, 3) of a cubic spline: for each key the velocity before, the position and the velocity after."""
    begin, end = (x[..., :3].swapaxes(0, 1) for x in curve.piece_end_states(2))
    rows = np.zeros((len(curve.time), 3, 3))
    rows[1:, :2], rows[:-1, 1:] = end[:, ::-1], begin
    return rows.reshape(-1, 3) @ _Y_UP
