"""Levels of vehicles that cross as seen from above: those that come near each other get different ones."""

from __future__ import annotations

import itertools

import numpy as np

from rigidfleet.formation.assignment import pairs_nearer_than
from rigidfleet.typing import Floats, Ints

#: What of a place is seen from above.
_ABOVE = np.array([1.0, 1.0, 0.0])


def altitude_levels(distance: float, p: Floats, q: Floats) -> Ints:
    """Level (N,) of each vehicle, from 0: others on ways across that come nearer than a distance [m] get another one.

    Of two that are one above the other at first, the higher one gets the higher level.
    """
    near, level = neighbours_on_ways(distance, p, q), np.full(len(p), -1)
    for i in np.argsort(p[:, 2], kind="stable").tolist():
        others = np.array([j for j in near[i] if level[j] >= 0], dtype=np.int64)
        under = others[np.linalg.norm((p[others] - p[i])[:, :2], axis=1) < distance]
        level[i] = _first_free_level(level[others], int(level[under].max(initial=-1)) + 1)
    return level


def neighbours_on_ways(distance: float, p: Floats, q: Floats) -> list[list[int]]:
    """Of each vehicle, the others that come nearer than a distance [m], seen from above, on ways from p to q (N, 3)."""
    near: list[list[int]] = [[] for _ in p]
    for i, j in pairs_nearer_than(distance, p * _ABOVE, q * _ABOVE).tolist():
        near[i].append(j)
        near[j].append(i)
    return near


def _first_free_level(taken: Ints, least: int = 0) -> int:
    """The first level from a least one on that is not taken."""
    return next(k for k in itertools.count(least) if k not in taken)


def layer_levels(near: list[list[int]]) -> Floats:
    """Level (N,) of each agent, ... -1, 0, 1, ..., such that no two that are near each other are within a level."""
    colour = np.full(len(near), -1)
    for i in np.argsort([-len(others) for others in near], kind="stable").tolist():
        colour[i] = _first_free_level(colour[near[i]])
    # The fullest in the middle: 0, 1, -1, 2, -2, ...
    order = np.argsort(-np.bincount(colour), kind="stable")
    place = np.empty(len(order))
    place[order] = [(k + 1) // 2 * (1 if k % 2 else -1) for k in range(len(order))]
    return place[colour]
