"""Arithmetic on eight numbers at once, in the machine's vector registers.

A vector holds eight consecutive states of one flight, or the same state of eight flights. ``+``, ``-``, ``*``,
``abs`` and ``max`` act on each of its numbers.

- ``as_lanes(rows)``: float64 rows (k, n), n a multiple of 8, viewed as vectors (k, n / 8); rows of vectors unchanged;
- ``fill_lanes(x)``: a vector of eight numbers x;
- ``rough_inverse(v)``: 1/v to four digits, in a fraction of a quotient's time;
- ``sum_lanes_or_worst_flight(v, y)``: a vector's sum if y are states of one flight, its greatest number if of eight.

These are names of `rigidfleet.kernel.compiler.simd`. Functions around them would cost the integrator some per cent.
"""

from rigidfleet.kernel.compiler.simd import (
    as_lanes,
    fill_lanes,
    rough_inverse,
    sum_lanes_or_worst_flight,
)

__all__ = [
    "as_lanes",
    "fill_lanes",
    "rough_inverse",
    "sum_lanes_or_worst_flight",
]
