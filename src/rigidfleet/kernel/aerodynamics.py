"""Air around a fleet: wind and gusts, downwash of vehicles above, ground effect."""

import math

from rigidfleet.kernel.compiler.jit import jit, jit_inline
from rigidfleet.kernel.disturbances import write_spline_value
from rigidfleet.kernel.fleet import downwash_speed
from rigidfleet.kernel.rigid_body import attitude_matrix

# Share of the body's lift in the ground effect (Sanchez-Cuevas et al. 2017), and the least height, in radii, at which
# the formula is used.
_BODY, _LEAST_HEIGHT = 2.0, 0.5

jet = jit_inline(downwash_speed)


@jit
def write_air_velocity_in_step(t, h, around, out):
    """Velocity of the air at each vehicle [m/s] at t, t + h/2 and t + h, into out (3, N, 3)."""
    for s in range(3):
        row = out[s]
        if around.gust.shape[0] > 0:
            write_spline_value(t + 0.5 * s * h, around.gust_step, around.gust, row)
        for i in range(row.shape[0]):
            for q in range(3):
                gust = row[i, q] if around.gust.shape[0] > 0 else 0.0
                row[i, q] = around.wind[q] + gust


@jit
def add_downwash_to_air(S, vehicles, density, T, out):
    """Add to the air (3, N, 3) the jets of all vehicles above, at states S (N, 17).

    Each is that of `fleet.downwash_speed`; they add up. T (3, 3) is work.
    """
    n = S.shape[0]
    for j in range(n):
        if vehicles.radius[j] > 0.0 and not (vehicles.lost[j] or vehicles.point[j]):
            weight = vehicles.m[j] * vehicles.g
            attitude_matrix(S[j, 6:10], T)
            for i in range(n):
                x, y, z = S[j, 0] - S[i, 0], S[j, 1] - S[i, 1], S[j, 2] - S[i, 2]
                s = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z
                if i != j and s > 0.0:
                    rr = x * x + y * y + z * z - s * s
                    flow = jet(weight, density, vehicles.radius[j], vehicles.span[j, 1], s, rr)
                    for stage in range(3):
                        for q in range(3):
                            out[stage, i, q] -= flow * T[2, q]


@jit
def ground_effect_factor(z, R, spacings):
    """Factor of the thrust at a height z [m] above the ground, for rotors of radius R [m].

    Cheeseman and Bennett (1955) for one rotor, extended to the neighbouring rotors at the distance d, the opposite ones
    at b and the body by Sanchez-Cuevas, Heredia and Ollero (2017, doi 10.1155/2017/1823056); ``spacings`` is (d, b).
    Valid above half a radius; below, the value there is used. 1 if R is 0.
    """
    if R == 0.0:
        return 1.0
    z = max(z, _LEAST_HEIGHT * R)
    d, b, near = spacings[0] * spacings[0], spacings[1] * spacings[1], 4.0 * z * z
    one = R / (4.0 * z)
    neighbours = 1.0 / math.sqrt((d + near) ** 3) + 0.5 / math.sqrt((2.0 * d + near) ** 3)
    body = 2.0 * _BODY / math.sqrt((b + near) ** 3)
    return 1.0 / (1.0 - one * one - R * R * z * (neighbours + body))
