"""Check the formations of a mission: their shapes, edges and distances."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.text import agent_names
from rigidfleet.formation import distance_geometry, graphs, shapes
from rigidfleet.formation.rest import rest_places_beside
from rigidfleet.math import proximity
from rigidfleet.mission import bounds
from rigidfleet.mission.files import NOT_A_FILE
from rigidfleet.mission.findings import Keys, suggest_shape
from rigidfleet.mission.rules import Breach, Breaches, Draft, unused_key_rules
from rigidfleet.mission.schema import Formation

#: Maximum number of contradictions among distances that are listed.
_SHOWN = 6
#: Light of vehicles that rest.
_DARK = "#000000"
#: Approximate maximum number of triangles and tetrahedra that are checked among distances.
_MOST_CLIQUES = 5e6


def coincident_pairs(points: ArrayLike) -> list[tuple[int, int]]:
    """Pairs (first, later) of points (N, 3) [m] that are closer than half the smallest length."""
    p, apart = np.asarray(points, dtype=np.float64), bounds.LENGTH.least / 2
    if len(p) < 2:
        return []
    # Cells first: a search tree of many equal points degenerates and compares all pairs.
    _, one, cell = np.unique(np.round(p / apart), axis=0, return_index=True, return_inverse=True)
    first, own = one[cell.ravel()], np.arange(len(p))
    if len(one) == len(p) and (proximity.nearest(p) < apart).any():
        from scipy.spatial import KDTree

        return sorted(KDTree(p).query_pairs(apart))
    return list(zip(first[first < own].tolist(), own[first < own].tolist(), strict=True))


def edge_limit(n: int) -> int:
    """Maximum number of edges of a formation of n agents."""
    return max(bounds.EDGES, bounds.EDGES_EACH * n)


def formation_rules(m: Draft) -> Breaches:
    """Each formation by itself; all are parts of the mission, including those with findings."""
    m.parts["formations"] = {}
    tables = m.data.get("formations", {})
    if not isinstance(tables, dict):
        yield Breach((), "must be a table", "write [formations.NAME] for each formation")
        return
    for name, data in tables.items():
        if isinstance(data, dict) and isinstance(data.get("slots"), str):
            remedy = "load the mission from its file, or give the slots as points"
            yield Breach((name, "slots"), NOT_A_FILE, remedy)
            continue
        path = ("formations", name)
        if (form := m.validate(Formation, data, path)) is not None:
            m.formations[name] = form
            m.record_breaches(path, _single_formation_rules(m, form, name))


def _single_formation_rules(m: Draft, form: Formation, name: str) -> Breaches:
    """A formation has slots or distances for all agents, and nothing without effect."""
    path, n = ("formations", name), m.n
    if n is not None and (form.rest is not None or form.agents is not None):
        m.formations[name] = form = yield from _pad_slots(m, form, n, path)
    right = m.is_valid(path, "shape", "size", "slots", "distances")
    if form.shape is not None and form.slots is not None:
        yield Breach("slots", "a shape has its own slots", "give either shape and size or slots")
    if right and form.shape is None and form.size is not None:
        yield Breach("size", "there is no shape of this size", "give shape or remove size")
    if right and form.shape is form.slots is form.distances is None:
        problem = "has neither shape nor slots nor distances"
        remedy = f"give shape and size; shapes: {', '.join(shapes.SHAPES)}"
        yield Breach((), problem, remedy, None)
    if form.shape is not None:
        yield from _shape_rules(m, form, form.shape, n, path)
    if n is None:
        return
    edges = n * (n - 1) // 2 if form.edges == "complete" else len(form.edges)
    # Edges between all pairs are only for few agents: their constraint law is solved densely.
    most = bounds.EDGES if form.edges == "complete" else edge_limit(n)
    if edges > most:
        problem = f"{n:,} agents have {edges:,} edges; the maximum is {most:,}"
        remedy = "use 'neighbours' or a list of pairs; a few more than 3 N - 6 edges hold a shape"
        yield Breach("edges", problem, remedy, "complete" if form.edges == "complete" else None)
    if form.slots is not None:
        if len(form.slots) != n:
            fewer = ", or rest = 'sides' for the others" if len(form.slots) < n else ""
            remedy = f"give one slot per agent, {n} in all{fewer}"
            yield Breach("slots", f"has {len(form.slots)} slots for {n} agents", remedy, None)
        for i, j in coincident_pairs(form.slots):
            yield Breach(("slots", j), f"is the same point as slot {i + 1}", "move the slots apart")
    if form.tolerance is not None and "tolerance_share" in form.model_fields_set:
        problem = "has no effect beside tolerance, which is in metres"
        yield Breach("tolerance_share", problem, "remove one of them")
    if isinstance(form.colour, tuple) and len(form.colour) != n:
        problem = f"has {len(form.colour)} colours for {n} agents"
        yield Breach("colour", problem, "give one colour, or one per slot", None)
    if m.is_valid(path, "edges"):
        yield from _edge_rules(m, form, n, path)
    if form.distances is not None and m.is_valid(path, "edges", "distances"):
        yield from _distance_rules(form, form.distances, n)
    if (form.dimension or m.data.get("dimension")) == 2 and m.is_valid(("formations",), name):
        slots = form.slot_array(n)
        if slots is not None and distance_geometry.dimension(slots) > 2:
            problem = "the slots do not lie in a plane, but the dimension is 2"
            yield Breach("dimension", problem, "use 3, or move the slots into a plane")


def _pad_slots(m: Draft, form: Formation, n: int, path: Keys) -> Generator[Breach, None, Formation]:
    """A formation of fewer than n agents gets slots for all: those that rest come last."""
    slots = form.slots
    if form.agents is not None:
        if form.shape is None or form.rest is None:
            without = "rest" if form.rest is None else "shape"
            remedy = f"add {without}, or remove it"
            yield Breach("agents", f"has no effect without {without}", remedy)
            return form
        if form.agents > n:
            yield Breach("agents", f"is more than the {n} agents", "give fewer")
            return form
        yield from _shape_rules(m, form, form.shape, form.agents, path)
        if not m.is_valid(path, "shape", "size"):
            return form
        made = form.slot_array(form.agents)
        assert made is not None  # a shape has them
        slots = tuple(map(tuple, made.tolist()))
    if slots is None or form.distances is not None:
        problem = "needs slots" if slots is None else "does not go with distances"
        remedy = (
            "give slots, or shape and agents; edges keep the lengths that they have in the slots"
        )
        yield Breach("rest", problem, remedy)
        return form
    waiting = n - len(slots)
    if isinstance(form.rest, tuple):
        places = form.rest
        if len(places) != waiting:
            problem = f"has {len(places)} places for the {max(waiting, 0)} agents that have no slot"
            yield Breach("rest", problem, "give a place to each, or 'sides'", None)
            return form
    elif waiting < 1:
        return form
    elif len(slots) < 2:
        yield Breach("rest", "needs two or more slots", "give the places as a list of points")
        return form
    else:
        places = tuple(map(tuple, rest_places_beside(slots, waiting).tolist()))
    colour = form.colour
    if colour is not None:
        lit = (colour,) * len(slots) if isinstance(colour, str) else colour
        colour = lit + (_DARK,) * len(places)
    changed = {"slots": (*slots, *places), "shape": None, "size": None, "colour": colour}
    return form.model_copy(update=changed)


def _shape_rules(m: Draft, form: Formation, shape: str, n: int | None, path: Keys) -> Breaches:
    """A shape has a name, a size, and suits the number of agents."""
    if shape not in shapes.SHAPES:
        yield Breach("shape", "unknown shape", suggest_shape(shape))
    elif form.size is None:
        yield Breach("size", "is missing", "add size, the edge length [m]")
    elif n is not None:
        try:
            slots = form.slot_array(n)
        except ValueError as error:
            yield Breach("shape", str(error), "change the shape, its size or the number of agents")
            return
        assert slots is not None  # a shape has them
        far = float(np.abs(slots).max())
        if far > bounds.LENGTH.most:
            problem = f"the slots of {n:,} agents extend to {far:.3g} m; the maximum is {bounds.LENGTH.most:g} m"
            yield Breach("size", problem, "reduce the size")


def _edge_rules(m: Draft, form: Formation, n: int, path: Keys) -> Breaches:
    """Edges join different agents, each pair once."""
    if isinstance(form.edges, str):
        yield from _named_graph_rules(m, form, n, path)
        return
    seen: dict[tuple[int, ...], int] = {}
    for k, edge in enumerate(form.edges):
        first = seen.setdefault(tuple(sorted(edge)), k)
        if not all(1 <= agent <= n for agent in edge):
            problem = f"has an agent outside 1 to {n}"
            yield Breach(("edges", k), problem, "correct it; agents count from 1")
        elif edge[0] == edge[1]:
            yield Breach(("edges", k), "joins an agent to itself", "join two different agents")
        elif first != k:
            yield Breach(("edges", k), f"repeats edge {first + 1}", "remove it and its distance")


def _named_graph_rules(m: Draft, form: Formation, n: int, path: Keys) -> Breaches:
    """A named graph can be derived from the slots; all except 'complete' are."""
    yield from unused_key_rules(form, "reach", "edges", "neighbours")
    if form.edges == "complete":
        return
    right = m.is_valid(path, "shape", "size", "slots")
    if form.distances is not None or (right and form.shape is form.slots is None):
        remedy = "list the pairs, or give shape and size and omit distances"
        yield Breach("edges", "needs slots, and takes its distances from them", remedy)
        return
    if not right:
        return
    slots = form.slot_array(n)
    assert slots is not None  # there are a shape or slots
    if form.edges == "neighbours":
        many = graphs.count_neighbour_edges(slots, form.reach)
        if many > edge_limit(n):
            problem = f"joins {many:,} pairs of {n:,} agents; the maximum is {edge_limit(n):,}"
            remedy = "reduce it; 1.9 includes second neighbours"
            yield Breach("reach", problem, remedy, form.reach)
        return
    try:
        graphs.refuse_flat_shapes(slots)
    except ValueError as error:
        yield Breach("edges", str(error), "use 'neighbours' or give a list of pairs")


def _distance_rules(form: Formation, lengths: Sequence[float], n: int) -> Breaches:
    """There is a distance for each edge, and points with these distances exist."""
    edges = form.edge_array(n)
    if len(lengths) != len(edges):
        problem = f"has {len(lengths)} entries for {len(edges)} edges"
        order = "12, 13, ..., 23, ..." if form.edges == "complete" else "that of edges"
        yield Breach("distances", problem, f"give one per edge, in the order {order}", None)
        return
    # The common neighbours of both ends of an edge are at most the neighbours of either end.
    degree = np.bincount(edges.ravel(), minlength=n)
    cliques = (degree[edges].min(axis=1, initial=n).astype(float) ** 2).sum()
    violations = distance_geometry.violations(edges, lengths) if cliques < _MOST_CLIQUES else []
    between = "" if n < 10 else "-"
    names = [
        f"d{between.join(str(i + 1) for i in e)} = {d:g}"
        for e, d in zip(edges, lengths, strict=True)
    ]
    for v in islice(violations, _SHOWN):
        sides = ", ".join(names[k] for k in v.edges)
        problem = f"{agent_names(v.agents)} form no tetrahedron (Cayley-Menger < 0): {sides} m"
        remedy = "change one of the six (a flat shape needs 7 digits: 5.656854) or give a shape"
        if len(v.agents) == 3:
            problem = f"{agent_names(v.agents)} form no triangle: {sides} m"
            remedy = f"shorten the longest by at least {v.excess:.4g} m or lengthen the others"
        yield Breach("distances", problem, remedy, None)
    if len(violations) > _SHOWN:
        problem = f"{len(violations) - _SHOWN} more triangles or tetrahedra are impossible"
        yield Breach("distances", problem, "correct the ones above first", None)
    if not violations:
        try:
            distance_geometry.slots_of_all_distances(n, edges, lengths)
        except ValueError as error:
            yield Breach("distances", str(error), "change them or give shape and size", None)
