"""A user's functions: called for forces, checked, and made callable from the kernel."""

from __future__ import annotations

import ctypes
import math
import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet.errors import FlightError
from rigidfleet.typing import Floats

Force = Callable[[float, "Floats", "Floats"], ArrayLike]


@dataclass(frozen=True)
class Observation:
    """What a controller sees at a control step; arrays are copies.

    All of it is of the time ``t``, but positions and velocities are measured: with noise, they are each vehicle's last
    measurement, as the built-in law knows it at the same tick; without, they are those of ``t``. Masses are those the
    control laws assume. The attitude, rates and rotors of vehicles are known without delay; they are None for point
    masses that give any force at once.

    Attributes
    ----------
    t : mission time [s]
    phase : name of the phase
    position, velocity : (N, 3) of each agent, world axes [m, m/s]
    reference_position, reference_velocity, reference_acceleration : (N, 3) of its slot, world axes [m, m/s, m/s^2];
        NaN where no slots are tracked
    masses : (N,) [kg]
    gravity : [m/s^2]
    attitude : (N, 4) of each vehicle, world to body, scalar first
    rates : (N, 3) of each vehicle, body axes [rad/s]
    rotor_speed : (N, 4) front left, front right, rear right, rear left [rad/s]
    """

    t: float
    phase: str
    position: Floats
    velocity: Floats
    reference_position: Floats
    reference_velocity: Floats
    reference_acceleration: Floats
    masses: Floats
    gravity: float
    attitude: Floats | None = None
    rates: Floats | None = None
    rotor_speed: Floats | None = None


@dataclass(frozen=True)
class AttitudeCommand:
    """What a controller may return for vehicles instead of forces: thrust and attitude, which their autopilots hold.

    Attributes
    ----------
    thrust : (N,) along each vehicle's z axis [N]
    attitude : (N, 4) quaternions, world to body, scalar first
    rates : (N, 3) of that attitude, in its own axes [rad/s]; default: zero
    """

    thrust: ArrayLike
    attitude: ArrayLike
    rates: ArrayLike | None = None


@dataclass(frozen=True)
class RotorCommand:
    """What a controller may return for vehicles instead of forces: the speeds of their rotors.

    Attributes
    ----------
    speed : (N, 4) front left, front right, rear right, rear left [rad/s]
    """

    speed: ArrayLike


Command = AttitudeCommand | RotorCommand
Controller = Callable[[Observation], "ArrayLike | Command"]


def call_user_code(who: str, when: str, function: Callable[..., Any], *arguments: object) -> Any:
    """What a user's function returns; its exceptions are told as those of a flight."""
    try:
        return function(*arguments)
    except Exception as error:
        raise FlightError(f"{who} raised {type(error).__name__} {when}: {error}") from error


def article_and_kind(command: Command) -> str:
    """What a controller returned, with its article."""
    return f"{'an' if isinstance(command, AttitudeCommand) else 'a'} {type(command).__name__}"


def copy_finite_array(x: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """A copy of finite numbers of a shape, as a user's function gives them.

    Raises
    ------
    ValueError
        They are something else, which the message names.
    """
    try:
        array = np.asarray(x)
        if array.dtype.kind not in "cSU":
            array = np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError, OverflowError):
        raise ValueError(reprlib.repr(x)) from None
    if array.dtype.kind == "c":
        raise ValueError("complex numbers")
    if array.dtype.kind in "SU":
        raise ValueError(reprlib.repr(x))
    if array.shape != shape:
        raise ValueError(f"an array of shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{reprlib.repr(x)}, which is not finite")
    return array


def check_command(command: Command, n: int, t: float) -> dict[str, Floats]:
    """Arrays of a command, by their names; an error says which one is wrong."""
    rows = {"thrust": (n,), "attitude": (n, 4), "rates": (n, 3), "speed": (n, 4)}
    arrays = {}
    for name, value in vars(command).items():
        try:
            arrays[name] = copy_finite_array(
                np.zeros(rows[name]) if value is None else value, rows[name]
            )
        except ValueError as error:
            raise FlightError(
                f"the controller returned {article_and_kind(command)} at t = {t:.3f} s whose {name} is not an array"
                f" {rows[name]} of finite numbers, but {error}"
            ) from None
    if "attitude" in arrays:
        size = np.linalg.norm(arrays["attitude"], axis=1, keepdims=True)
        if not (size > 0.0).all():
            raise FlightError(f"the controller returned an attitude of norm zero at t = {t:.3f} s")
        arrays["attitude"] = arrays["attitude"] / size
    return arrays


def check_force(f: ArrayLike, n: int, who: str, t: float) -> Floats:
    """Forces (N, 3) [N] from a user's function, checked; an error says what it returned instead."""
    try:
        return copy_finite_array(f, (n, 3))
    except ValueError as error:
        raise FlightError(
            f"{who} returned {error} at t = {t:.3f} s; return an array ({n}, 3) of forces, a row for each agent [N]"
        ) from None


class ExternalForce:
    """A user's force as a C function that the kernel can call.

    An exception cannot pass through compiled code. It is stored, the force becomes NaN, the step is
    rejected, and `raise_user_error` raises it once the kernel has returned.
    """

    _SIGNATURE = ctypes.CFUNCTYPE(None, ctypes.c_double, *(ctypes.c_void_p,) * 3, ctypes.c_ssize_t)

    def __init__(self, force: Force, n: int) -> None:
        self.error: BaseException | None = None
        self._keep: Any = force  # the owner of the code must live as long as its address
        address = getattr(force, "address", None)
        if address is not None:  # a Numba cfunc
            self.address = int(address)
            return

        @cache
        def array_at_address(address: int) -> Floats:
            """The array (N, 3) at an address; the kernel has few of them, and calls often."""
            return np.ctypeslib.as_array((ctypes.c_double * 3 * n).from_address(address))

        def call_force(t: float, r: int, v: int, f: int, _: int) -> None:
            x = array_at_address(r).copy(), array_at_address(v).copy()
            try:
                if self.error is None:
                    answer = call_user_code("the force", f"at t = {t:.3f} s", force, t, *x)
                    array_at_address(f)[:] = check_force(answer, n, "the force", t)
                    return
            except BaseException as error:
                self.error = error
            array_at_address(f)[:] = math.nan

        self._keep = self._SIGNATURE(call_force)
        self.address = int(ctypes.cast(self._keep, ctypes.c_void_p).value or 0)

    def raise_user_error(self) -> None:
        """Raise the error that the user's function raised, and call the function again from then on."""
        error, self.error = self.error, None
        if error is not None:
            raise error
