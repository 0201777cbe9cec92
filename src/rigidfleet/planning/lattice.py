"""Ways of a rigid shape among obstacles: a search over places, attitudes and shapes.

A *layer* is a shape in an attitude: balls at fixed offsets from the centre of mass. Within a layer the shape moves
straight; from layer to layer it turns or changes its shape on the spot. Places form a lattice whose coordinates follow
from the obstacles: along each axis, the middles between the places at which the shape just touches an obstacle's
extent. A gap between two boxes along the axes therefore has coordinates in its middle, however narrow it is. A few
even coordinates, common to all layers, join them; there the layer can change. Turned boxes bring lattices along their
own axes.

A motion is kept only if conservative advancement proves it: halved again and again, until the room in the middle of
each part, less the way that a ball flies from there, is what is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rigidfleet.math import proximity
from rigidfleet.mission import Obstacle
from rigidfleet.mission.obstacles import Ground
from rigidfleet.solids import records
from rigidfleet.typing import Bools, Floats, Ints

#: Greatest number of halvings of a motion, and of parts of motions looked at in one step.
_HALVINGS, _PARTS = 12, 400_000
#: Room to spare on either side in a gap that is found [m].
SPARE = 0.005
#: Greatest number of coordinates along an axis that follow from obstacles.
_MOST = 26
#: What a metre aside of the straight way counts, where ways are compared by their room [m].
_ASIDE = 1e-5
#: Places of a motion, both ends included, at which it is looked for what stands in the way.
_LOOKED_AT = 5
#: How often a way is shortened.
_SHORTER = 3
#: Costs, as lengths: of a change in multiples of its longest way plus a length [m]; of a way in another shape.
_CHANGE, _OTHER = 1.0, 1.2

#: Offsets (K, M, 3) [m] of balls at shares (K,) of a motion.
Path = Callable[[Floats], Floats]


class FreeSpace(NamedTuple):
    """Obstacles at rest, and the box (2, 3) [m] in which agents' centres must stay, infinite without a geofence."""

    obstacles: Sequence[Obstacle]
    fence: Floats

    def clearance(self, r: Floats, radius: Floats, most: Floats | float = np.inf) -> Floats:
        """Least distance (..., M) [m] of balls at r (..., M, 3) to an obstacle, or of their centres to the fence.

        Beyond ``most`` (..., M) [m] the distance does not matter.
        """
        least = self.clearance_to_obstacles(r, radius, most)
        return np.minimum(least, np.minimum(r - self.fence[0], self.fence[1] - r).min(axis=-1))

    def clearance_to_obstacles(self, r: Floats, radius: Floats, most: Floats | float) -> Floats:
        """The same from obstacles alone."""
        return proximity.obstacle_clearances(r, radius, self.obstacles, most=most)[0]

    def is_inside_fence(self, a: Floats, b: Floats, path: Path, ways: Floats, need: float) -> Bools:
        """Whether the fence leaves the room ``need`` [m] to motions (E,), which are those of `is_clear`.

        Coordinates along a straight way are between those of its ends, however near the fence it runs. A path on the
        spot is the same wherever it is: it is looked at once, as finely as halvings would.
        """
        if not np.isfinite(self.fence).any():  # nothing is looked at: that took half of a search
            return np.ones(len(a), dtype=np.bool_)
        parts = 2**_HALVINGS
        offsets, off = path((np.arange(parts) + 0.5) / parts), ways[:, None] / (2.0 * parts)
        low, high = (offsets.min(axis=0) - off).min(axis=0), (offsets.max(axis=0) + off).max(axis=0)
        above = np.minimum(a, b) + low >= self.fence[0] + need
        return (above & (np.maximum(a, b) + high <= self.fence[1] - need)).all(axis=1)


class Layer(NamedTuple):
    """A shape in an attitude."""

    formation: str
    angles: tuple[float, float, float]  # roll, pitch, yaw [deg]
    offsets: Floats  # (M, 3) of balls from the centre of mass, world axes [m]


class Change(NamedTuple):
    """A motion on the spot from one layer to another."""

    before: int
    after: int
    path: Path
    ways: Floats  # (M,) upper bounds of what each ball flies [m]

    @property
    def cost(self) -> float:
        """As a length [m]."""
        return _CHANGE + float(self.ways.max())


def is_clear(
    space: FreeSpace, a: Floats, b: Floats, offset_at: Path, ways: Floats, radius: Floats, need: float
) -> Bools:  # fmt: skip
    """Whether motions (E,) keep the room ``need`` [m]: from a to b (E, 3) [m], with offsets that follow a path.

    ``ways`` (M,) bounds what each ball flies relative to the centre of mass [m].
    """
    free = space.is_inside_fence(a, b, offset_at, ways, need)
    way = np.linalg.norm(b - a, axis=1)[:, None] + ways
    who, length = np.flatnonzero(free), 1.0
    low = np.zeros(len(who))
    for _ in range(_HALVINGS):
        middle = low + length / 2
        place = a[who] + middle[:, None] * (b - a)[who]
        wanted = need + way[who] * length / 2
        room = space.clearance_to_obstacles(place[:, None] + offset_at(middle), radius, wanted)
        free[who[(room < need).any(axis=1)]] = False
        open_ = free[who] & (room < wanted).any(axis=1)
        who, low, length = who[open_], low[open_], length / 2
        if not len(who):
            return free
        if len(who) * 2 > _PARTS:
            break
        who, low = np.tile(who, 2), np.concatenate([low, low + length])
    free[who] = False
    return free


def constant_path(layer: Layer) -> Path:
    """The path of a layer that does not change."""
    return lambda share: np.broadcast_to(layer.offsets, (len(share), *layer.offsets.shape))


class Lattice:
    """Places of one layer in the axes of one frame, and its motions that are proved."""

    def __init__(
        self, space: FreeSpace, layer: Layer, radius: Floats, need: float, frame: Floats, common: list[Floats]
    ) -> None:  # fmt: skip
        """Find places and motions.

        Parameters
        ----------
        frame : (3, 3), from world axes to those of the lattice
        common : coordinates [m] along the axes that all layers have
        """
        offsets = layer.offsets @ frame.T
        axes = [
            _lattice_coordinates(
                common[k],
                np.array([_extent(thing, frame)[:, k] for thing in space.obstacles]).reshape(-1, 2),
                float((offsets[:, k] + radius).max()) + need,
                float((radius - offsets[:, k]).max()) + need,
            )
            for k in range(3)
        ]
        self.layer, self.axes, self.shape = layer, axes, tuple(map(len, axes))
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        self.points = grid @ frame
        self.room = space.clearance(self.points[:, None] + layer.offsets, radius, need).min(axis=1)
        free = self.room >= need
        index = np.arange(len(grid)).reshape(self.shape)
        ends = ([np.delete(index, end, axis=k).ravel() for k in range(3)] for end in (-1, 0))
        self.all_edges = np.array([np.concatenate(nodes) for nodes in ends])
        edges = self.all_edges[:, free[self.all_edges].all(axis=0)]
        still = np.zeros(len(radius))
        a, b = self.points[edges[0]], self.points[edges[1]]
        self.edges = edges[:, is_clear(space, a, b, constant_path(layer), still, radius, need)]
        self.common = index[
            np.ix_(*(np.searchsorted(axes[k], common[k]) for k in range(3)))
        ].ravel()
        self.free = free


def _lattice_coordinates(common: Floats, spans: Floats, above: float, below: float) -> Floats:
    """Coordinates [m] along an axis: common ones, and middles between places where the shape touches a span (B, 2)."""
    low, high = common[0], common[-1]
    touch = np.unique(np.concatenate([spans[:, 0] - above, spans[:, 1] + below]))
    touch = touch[(touch > low) & (touch < high)]
    if len(touch) > _MOST:
        touch = touch[np.linspace(0, len(touch) - 1, _MOST).round().astype(int)]
    touch = np.concatenate([[low], touch, [high]])
    wide = np.diff(touch) > SPARE
    return np.unique(np.concatenate([common, ((touch[1:] + touch[:-1]) / 2)[wide]]))


def _extent(thing: Obstacle, frame: Floats) -> Floats:
    """Lowest and highest coordinates (2, 3) [m] of an obstacle along the axes of a frame."""
    solid, ends = thing.solid, records.swept_extent(thing.solid)
    if not np.isfinite(ends).all():
        return ends  # all that is below a height, whatever the frame's yaw
    turned = solid._replace(
        turn=solid.turn @ frame.T, origin=solid.origin @ frame.T, turned=np.ones(1, dtype=np.int64)
    )
    return records.swept_extent(turned)


class Stops(NamedTuple):
    """The stops of a way, in order: a place (3,) [m] and a layer of each."""

    places: list[Floats]
    layers: list[int]
    cost: float  # as a length [m]


#: A place (3,) [m] and a layer.
Stop = tuple[Floats, int]


class Roadmap:
    """Lattices of several layers and frames, joined where the layer can change."""

    def __init__(
        self, space: FreeSpace, layers: list[Layer], changes: list[Change], radius: Floats, need: float,
        frames: list[Floats], common: list[list[Floats]],
    ) -> None:  # fmt: skip
        """Build the lattices; the parameters are those of `Lattice`, for each layer and frame."""
        self.space, self.layers, self.changes = space, layers, changes
        self.radius, self.need = radius, need
        self.lattices = [
            [Lattice(space, layer, radius, need, frame, even) for layer in layers]
            for frame, even in zip(frames, common, strict=True)
        ]
        counts = [[len(x.points) for x in row] for row in self.lattices]
        starts = np.cumsum([0, *np.ravel(counts)])
        self.first = starts[:-1].reshape(len(frames), len(layers))
        self.size = int(starts[-1])
        self.points = np.concatenate([x.points for row in self.lattices for x in row])
        self.layer_of = np.repeat(np.tile(np.arange(len(layers)), len(frames)), np.ravel(counts))
        links = zip(*self._all_links(), strict=True)
        self.tails, self.heads, self.costs = map(np.concatenate, links)

    def _all_links(self) -> Iterator[tuple[Ints, Ints, Floats]]:
        """Nodes and costs of motions within layers, of changes at common places, of crossings from frame to frame."""
        space, radius, need = self.space, self.radius, self.need
        for f, row in enumerate(self.lattices):
            for k, x in enumerate(row):
                a, b = x.edges + self.first[f, k]
                length = np.linalg.norm(self.points[a] - self.points[b], axis=1)
                other = 1.0 if x.layer.formation == self.layers[0].formation else _OTHER
                yield a, b, length * other
            for change in self.changes:
                one, two = row[change.before], row[change.after]
                free = one.free[one.common] & two.free[two.common]
                a, b = one.common[free], two.common[free]
                spots = one.points[a]
                good = is_clear(space, spots, spots, change.path, change.ways, radius, need)
                a, b = a[good] + self.first[f, change.before], b[good] + self.first[f, change.after]
                yield a, b, np.full(len(a), change.cost)
        for f in range(1, len(self.lattices)):
            for k, layer in enumerate(self.layers):
                yield self._links_to_frame(k, layer, f)

    def _links_to_frame(self, k: int, layer: Layer, frame: int) -> tuple[Ints, Ints, Floats]:
        """Straight ways of a layer between common places of the world's lattice and the nearest of another frame."""
        from scipy.spatial import KDTree

        one, two = self.lattices[0][k], self.lattices[frame][k]
        a, b = one.common[one.free[one.common]], two.common[two.free[two.common]]
        if not (len(a) and len(b)):
            return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)
        near = KDTree(two.points[b]).query(one.points[a], k=min(2, len(b)))[1].reshape(len(a), -1)
        a, b = np.repeat(a, near.shape[1]), b[near.ravel()]
        p, q = one.points[a], two.points[b]
        still = np.zeros(len(self.radius))
        good = is_clear(self.space, p, q, constant_path(layer), still, self.radius, self.need)
        cost = np.linalg.norm(p - q, axis=1)[good]
        return a[good] + self.first[0, k], b[good] + self.first[frame, k], cost

    def node_at(self, place: Floats, layer: int) -> int:
        """The node at a place (3,) of a layer in the world's lattice; common coordinates contain it."""
        x = self.lattices[0][layer]
        at = [int(np.abs(x.axes[k] - place[k]).argmin()) for k in range(3)]
        return int(self.first[0, layer] + np.ravel_multi_index(at, x.shape))

    def stops_of_shortest_way(self, begin: Stop, end: Stop) -> Stops | None:
        """The stops of the way of least cost from a place and layer to others; None if there is none."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        a, b = self.node_at(*begin), self.node_at(*end)
        graph = csr_array(
            (np.maximum(self.costs, 1e-9), (self.tails, self.heads)), shape=(self.size, self.size)
        )
        cost, before = dijkstra(graph, directed=False, indices=a, return_predecessors=True)
        if not np.isfinite(cost[b]):
            return None
        nodes = [b]
        while nodes[-1] != a:
            nodes.append(int(before[nodes[-1]]))
        nodes.reverse()
        places, layers = [self.points[k] for k in nodes], [int(self.layer_of[k]) for k in nodes]
        return Stops(places, layers, float(cost[b]))

    def stops_of_shorter_way(self, stops: Stops) -> Stops:
        """The stops of a way that is straight where that is proved, with changes at stops or half-way between them."""
        each = list(zip(stops.places, stops.layers, strict=True))
        for _ in range(_SHORTER):
            each = self._move_layer_changes(self._straighten(each))
        ends = stops.places[0], stops.places[-1]
        places = [p if any(p is end for end in ends) else np.round(p, 3) for p, _ in each]
        return Stops(places, [k for _, k in each], stops.cost)

    def _is_free(self, a: Stop, b: Stop) -> bool:
        """Whether the motion from one stop to another is proved: straight in one layer, or a change on the spot."""
        (p, i), (q, j) = a, b
        path, ways = constant_path(self.layers[i]), np.zeros(len(self.radius))
        if i != j:
            change = next((c for c in self.changes if {c.before, c.after} == {i, j}), None)
            if change is None or not np.array_equal(p, q):
                return False
            path, ways = change.path, change.ways
        return bool(is_clear(self.space, p[None], q[None], path, ways, self.radius, self.need)[0])

    def _straighten(self, stops: list[Stop]) -> list[Stop]:
        """From each stop on to the farthest one of its layer that is straight ahead."""
        stops, k = list(stops), 0
        while k < len(stops) - 2:
            run = k + 1
            while run + 1 < len(stops) and stops[run + 1][1] == stops[k][1]:
                run += 1
            far = next(
                (j for j in range(run, k + 1, -1) if self._is_free(stops[k], stops[j])), k + 1
            )
            del stops[k + 1 : far]
            k += 1
        return stops

    def _move_layer_changes(self, stops: list[Stop]) -> list[Stop]:
        """Changes moved to the stop before or after, or half-way between the two, which saves a detour to them."""
        stops, first = list(stops), 1
        while first < len(stops) - 1:
            after = first + 1
            while after < len(stops) and np.array_equal(stops[after][0], stops[first][0]):
                after += 1
            if after - first > 1 and after < len(stops):
                a, b = stops[first - 1], stops[after]
                for place in (a[0], b[0], np.round((a[0] + b[0]) / 2, 3)):
                    moved = [(place, layer) for _, layer in stops[first:after]]
                    if all(self._is_free(x, y) for x, y in pairwise([a, *moved, b])):
                        stops[first:after] = moved
                        break
            first = after
        further = (b for a, b in pairwise(stops) if a[1] != b[1] or not np.array_equal(a[0], b[0]))
        return [stops[0], *further]

    def _motion_clearances(self) -> Iterator[tuple[Ints, Ints, Floats]]:
        """Nodes of the world's lattice that a motion or a change joins, proved or not, and the room there [m].

        Nodes above the ground alone: no way leads round it, below the walls that stand on it.
        """
        row, first = self.lattices[0], self.first[0]
        grounds = (x.height for x in self.space.obstacles if isinstance(x, Ground))
        lowest = max(grounds, default=-np.inf) + self.need
        above = []
        for x in row:
            bottom = (x.layer.offsets[:, 2] - self.radius).min()
            above.append(x.points[:, 2] + bottom >= lowest)
        for k, x in enumerate(row):
            a, b = x.all_edges[:, above[k][x.all_edges].all(axis=0)]
            share = np.linspace(0.0, 1.0, _LOOKED_AT)[1:-1]
            between = x.points[a, None] + share[:, None] * (x.points[b] - x.points[a])[:, None]
            room = self.space.clearance(between[:, :, None] + x.layer.offsets, self.radius)
            ends = np.minimum(x.room[a], x.room[b])
            yield a + first[k], b + first[k], np.minimum(room.min(axis=(1, 2)), ends)
        for change in self.changes:
            one, two = row[change.before], row[change.after]
            both = above[change.before][one.common] & above[change.after][two.common]
            a, b = one.common[both], two.common[both]
            room = np.minimum(one.room[a], two.room[b])
            yield a + first[change.before], b + first[change.after], room

    def widest_way_bottleneck(self, begin: Stop, end: Stop) -> tuple[float, Floats, int]:
        """The most room [m] that a way between two nodes leaves everywhere, and place and layer where it is least."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

        tail, head, room = map(np.concatenate, zip(*self._motion_clearances(), strict=True))
        # Of places that are as narrow, the one nearest to the straight way.
        along = end[0] - begin[0]
        beside = np.cross(self.points[tail] - begin[0], along / max(np.linalg.norm(along), 1e-9))
        room = room - _ASIDE * np.linalg.norm(beside, axis=1)
        most = float(room.max()) + 1.0
        tree = minimum_spanning_tree(
            csr_array((most - room, (tail, head)), shape=(self.size, self.size))
        )
        a, b = self.node_at(*begin), self.node_at(*end)
        _, before = breadth_first_order(tree, a, directed=False)
        tree = (tree + tree.T).tocsr()
        at, least = b, (np.inf, b, b)
        while at != a:
            after, at = at, int(before[at])
            least = min(least, (most - float(tree[after, at]), after, at))
        room, *ends = least
        line = np.linspace(*self.points[ends], _LOOKED_AT)[:, None]
        rooms = {
            layer: self.space.clearance(line + self.layers[layer].offsets, self.radius).min(axis=1)
            for layer in self.layer_of[ends].tolist()
        }
        layer = min(rooms, key=lambda layer: rooms[layer].min())
        return room, line[rooms[layer].argmin(), 0], layer
