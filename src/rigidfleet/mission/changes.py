"""Changes of formation whose slots are assigned anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rigidfleet.mission.kinds import Go, Phase
from rigidfleet.mission.schema import Formation


def split_shared_formations(
    formations: Mapping[str, Formation], phases: Sequence[Phase]
) -> tuple[dict[str, Formation], tuple[Phase, ...]]:
    """Formations and phases in which no formation is taken on two ways that need different slots.

    A formation that is taken again gets a second name, "NAME (2)", and with it slots of its own. It keeps its name, and
    its slots, on the way back from a formation that was reached from it, and wherever it comes from the same one as
    before: there the same slots are as good. After a take-off, or a landing one by one, there is no formation.
    """
    known, renamed = dict(formations), []
    ways: set[tuple[str | None, str]] = set()
    before: str | None = None
    latest: dict[str, str] = {}  # by written name, the name in use
    for phase in phases:
        shaping = phase.shaping
        if shaping is None:
            if phase.vertical is not None and phase.vertical.has_way_per_vehicle:
                before = None
                ways = {way for way in ways if way[0] is not None}
            renamed.append(phase)
            continue
        written = shaping.formation
        name = latest.get(written, written)
        if written in latest and name != before and (before, name) not in ways:
            count = 2
            while (name := f"{written} ({count})") in known:
                count += 1
            known[name] = formations[written]
        latest[written] = name
        ways.add((before, name))
        if before is not None:
            ways.add((name, before))
        renamed.append(phase if name == written else phase.model_copy(update={"formation": name}))
        before = name
    return known, tuple(renamed)


def add_scaled_formations(
    formations: Mapping[str, Formation], phases: Sequence[Phase], n: int
) -> dict[str, Formation]:
    """Formations with those added that phases of kind "go" may shrink: "NAME x 0.8"."""
    known = dict(formations)
    for phase in (phase for phase in phases if isinstance(phase, Go)):  # alone has keys for this
        for scale in phase.scales:
            for name, form in formations.items():
                slots = form.slot_array(n)
                if slots is None or (phase.formations is not None and name not in phase.formations):
                    continue
                lengths = form.distances
                smaller = None if lengths is None else tuple(scale * x for x in lengths)
                edges = form.edges
                if isinstance(edges, str) and edges != "complete":  # rounding must not change them
                    edges = tuple(map(tuple, (form.edge_array(n) + 1).tolist()))
                shrunk = {
                    "edges": edges,
                    "shape": None,
                    "size": None,
                    "slots": tuple(map(tuple, (scale * slots).tolist())),
                    "distances": smaller,
                }
                known[scaled_formation_name(name, scale)] = form.model_copy(update=shrunk)
    return known


def scaled_formation_name(name: str, scale: float) -> str:
    """Name of a formation that is shrunk by a factor."""
    return f"{name} x {scale:g}"
