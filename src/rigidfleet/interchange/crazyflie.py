"""Trajectories for Crazyflies: Crazyswarm2's table of polynomials, and the two images of the vehicle's memory.

Sources: Crazyswarm2's `uav_trajectory.py` (columns of the table); the Crazyflie firmware's `pptraj.h` (`poly4d`) and
`pptraj_compressed.c` (compressed pieces: Bernstein coefficients, of which each piece takes the first from the end of
the piece before).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

import numpy as np

from rigidfleet.errors import ResultError
from rigidfleet.foreign.curves import CHANNEL_NAMES, curve_to_rows, rows_to_curve
from rigidfleet.interchange.curves import YAW_TOLERANCE, ExportedMotion, fit_curves
from rigidfleet.math.piecewise import Piecewise
from rigidfleet.math.splines import POWERS

#: Bytes of the vehicle's memory for trajectories, and of one piece of kind poly4d.
MEMORY, _POLY4D = 4096, 4 * (4 * POWERS + 1)
PIECES = MEMORY // _POLY4D
#: Units of the compressed form: lengths [m], angles [rad], times [s]; each within 16 bits.
_MM, _TENTH, _MS = 1e-3, np.radians(0.1), 1e-3
_MOST, _LONGEST = 32_767, 65_535
#: What rounding to millimetres can move a position, and more [m].
COMPRESSED_ROUNDING = 1e-3
_HEADER = ",".join(["duration", *(f"{name}^{k}" for name in CHANNEL_NAMES for k in range(POWERS))])
#: Numbers of coefficients that a compressed piece can store beyond the first, by kind; its head: kinds and duration.
_STORED = (0, 1, 3, 7)
_PIECE = struct.Struct("<BH")
_END = _PIECE.pack(0, 0)
#: Tolerances that are tried for a flight that does not fit [m].
_TRIED = tuple(1e-3 * np.array([2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 1000]))


#: An image, the memory it needs in words, and the size [bytes] and time [s] up to the end of each piece.
_Image = tuple[bytes, str, list[tuple[int, float]]]


def write_within_memory(
    images: Callable[[ExportedMotion, float], Iterator[_Image]], motion: ExportedMotion, tolerance: float
) -> Iterator[bytes]:  # fmt: skip
    """Images that fit the vehicle's memory.

    Raises
    ------
    ResultError
        One does not fit: which tolerance, and how many seconds do.
    """
    for agent, (data, needed, ends) in enumerate(images(motion, tolerance)):
        if len(data) > MEMORY:
            alone, wider = motion.of_vehicle(agent), [x for x in _TRIED if x > tolerance]
            enough = next((x for x in wider if len(next(images(alone, x))[0]) <= MEMORY), None)
            remedy = f"--tolerance {enough:g}" if enough else "No tolerance up to 1 m"
            until = max((t for size, t in ends if size <= MEMORY), default=ends[0][1])
            raise ResultError(
                f"the flight of agent {agent + 1} needs {needed}. {remedy} makes it fit; at "
                f"{1e3 * tolerance:g} mm, the first {until:.1f} s fit."
            )
        yield data


def write_polynomial(motion: ExportedMotion, tolerance: float) -> Iterator[bytes]:
    """A table for each vehicle: duration [s], and 8 coefficients of x, y, z [m] and yaw [rad] of each piece."""
    row = ",".join(["%.9g"] * (1 + len(CHANNEL_NAMES) * POWERS))
    for curve in fit_curves(motion.curve_chunks(), tolerance):
        lines = [row % tuple(numbers) for numbers in curve_to_rows(curve)]
        yield "\n".join([_HEADER, *lines, ""]).encode()


def poly4d_images(motion: ExportedMotion, tolerance: float) -> Iterator[_Image]:
    """A memory image for each vehicle: pieces of 32 coefficients and a duration, as 32-bit floats."""
    for curve in fit_curves(motion.curve_chunks(), tolerance):
        rows, after = np.roll(curve_to_rows(curve), -1, axis=1), curve.time - curve.time[0]
        needed = f"{len(rows)} pieces of {_POLY4D} bytes, and the memory has room for {PIECES}"
        ends = [(_POLY4D * k, t) for k, t in enumerate(after.tolist()) if k]
        yield rows.astype("<f4").tobytes(), needed, ends


def read_poly4d(data: bytes) -> list[Piecewise]:
    """The way in an image of `poly4d_images`, from time zero on."""
    rows = np.frombuffer(data, "<f4").reshape(-1, 4 * POWERS + 1)
    return [rows_to_curve(np.roll(rows, 1, axis=1))]


def compressed_images(motion: ExportedMotion, tolerance: float) -> Iterator[_Image]:
    """A compressed image for each vehicle: Bernstein coefficients in millimetres and tenths of a degree.

    Raises
    ------
    ResultError
        The tolerance is not more than the rounding, or the flight needs a length of more than 32.767 m, or a piece of
        more than 65.535 s.
    """
    if tolerance <= COMPRESSED_ROUNDING:
        raise ResultError(
            f"the tolerance of {1e3 * tolerance:g} mm cannot be met: this format rounds to millimetres. "
            f"Use --tolerance {2 * COMPRESSED_ROUNDING:g} or more."
        )
    # Times are whole milliseconds.
    near, turned = tolerance - COMPRESSED_ROUNDING, YAW_TOLERANCE - _TENTH
    ways = (way.with_knots(np.round(way.time / _MS) * _MS) for way in motion.curve_chunks())
    curves = fit_curves(ways, near, yaw_tolerance=turned, longest=_LONGEST * _MS)
    for number, curve in enumerate(curves, 1):
        yield _compressed_image(curve, number)


def _compressed_image(curve: Piecewise, number: int) -> _Image:
    """The image of the curve of a vehicle."""
    duration = np.diff(curve.time)
    position = Piecewise(curve.time, curve.pieces[:, :3]).control_points() / _MM
    # Yaw is of degree 3, like the reference between samples.
    yaw = Piecewise(curve.time, curve.pieces[:, 3:, :4]).control_points() / _TENTH
    if abs(position).max() > _MOST:
        k = int(np.argmax(abs(position).max(axis=(1, 2))))
        far = float(abs(position).max()) * _MM
        raise ResultError(
            f"agent {number} or a control point of its curve is {far:.3f} m from the origin along an axis, between "
            f"{curve.time[k]:g} and {curve.time[k + 1]:g} s, and this format ends at {_MOST * _MM:g} m. Fly nearer to "
            f"the origin, or smaller by a factor of {_MOST * _MM / far:.2g}, or use poly4d."
        )
    if abs(yaw).max() > _MOST:
        raise ResultError(
            f"the yaw of agent {number} reaches {abs(yaw).max() / 10:.0f} deg, and this format ends at "
            f"{_MOST / 10:g} deg. Turn less, or use poly4d."
        )
    points = [*np.round(np.moveaxis(position, 1, 0)).astype(int), np.round(yaw[:, 0]).astype(int)]
    at = [int(x[0, 0]) for x in points]
    data, ends = struct.pack("<4h", *at), []
    for k, milliseconds in enumerate(np.round(duration / _MS).astype(int).tolist()):
        kinds, body = 0, b""
        for axis, x in enumerate(points):
            due = x[k, 1:].tolist()
            if any(value != at[axis] for value in due):  # else a constant, of kind 0
                kinds |= _STORED.index(len(due)) << 2 * axis
                body += struct.pack(f"<{len(due)}h", *due)
                at[axis] = due[-1]
        data += _PIECE.pack(kinds, milliseconds) + body
        ends.append((len(data + _END), curve.time[k + 1] - curve.time[0]))
    data += _END
    return data, f"{len(data)} bytes, and the memory has {MEMORY}", ends


def read_compressed(data: bytes) -> list[Piecewise]:
    """The way in an image of `compressed_images`, from time zero on."""
    units = [_MM, _MM, _MM, _TENTH]
    at = [x * unit for x, unit in zip(struct.unpack_from("<4h", data), units, strict=True)]
    place, rows = 8, []
    while (head := _PIECE.unpack_from(data, place))[1]:
        kinds, milliseconds = head
        place += _PIECE.size
        piece = np.zeros((4, POWERS))
        for axis, unit in enumerate(units):
            count = _STORED[kinds >> 2 * axis & 3]
            due = struct.unpack_from(f"<{count}h", data, place)
            place += 2 * count
            points = np.array([[at[axis], *(x * unit for x in due)]])
            way = Piecewise.of_bernstein(np.array([0.0, milliseconds * _MS]), points)
            piece[axis, : count + 1] = way.pieces[0]
            at[axis] = points[0, -1]
        rows.append([milliseconds * _MS, *piece.ravel()])
    return [rows_to_curve(rows)]
