"""The extremes of curves in continuous time, found by the kernel's monitor: of a flight's, or of others'.

`rigidfleet.kernel.monitor` says how extremes are found. This module chooses the pairs to monitor: all pairs of a
small fleet, and the near pairs of a large one. The list of near pairs is renewed before any other pair can have come
as near.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from rigidfleet._common.quantities import MOTIONS, QUANTITIES
from rigidfleet.kernel import avoidance, fleet, records
from rigidfleet.kernel.engine import native, packing
from rigidfleet.kernel.problem import Problem, Workspace
from rigidfleet.math import attitude as att
from rigidfleet.math import proximity
from rigidfleet.mission import Mission, Obstacle
from rigidfleet.mission.boundaries import BoundaryWatch
from rigidfleet.result import PAD, Extremum, PhaseRecord
from rigidfleet.solids.records import join_solids
from rigidfleet.typing import Bools, Floats, Ints

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

#: Greatest number of agents of which all pairs are monitored.
_FEW = 40
#: Distance by which the list reaches beyond the pairs that matter, as a share of the agents' spacing.
_SPARE = 0.5
#: Least such distance, as a share of the fleet's size over the root of its number; agents may be at the same place.
_LEAST = 0.1
#: Overlap from which on it is a contact [m], and the time within which the first one is found [s].
_TOUCH, _INSTANT = 1e-6, 1e-6
#: Greatest rotation of a piece of a step in the body formulation [rad].
_TURN = 0.1
#: Number of agents whose nearest ones are sought, to choose how far the list reaches.
_SAMPLE = 2000
#: Vehicles of a crowd: beyond, lists of the pairs near a long step would take hundreds of megabytes.
_CROWD = 2000
#: The monitor's number of each quantity that it finds; the clearances at the start and the end belong to the flight.
_NAMES = {q.name: getattr(records, q.name.upper()) for q in QUANTITIES.values() if q.monitored}
#: Quantities of a direction, which are searched for where one of them has a limit.
_DIRECTIONS = [q for q in MOTIONS if q.monitored and q.way]
#: What a monitor writes.
_WRITTEN = "worst", "when", "who", "standing", "low", "count"
#: First contacts of a flight by name, each with the quantity that then falls below zero.
_CONTACTS = {f"{name}_first": _NAMES[name] for name in ("separation", "lost", "clearance")}
#: Extremes of a sampled flight by its column, the monitor's quantity, and its sign there.
_SAMPLED = (
    (fleet.ACCELERATION, records.ACCELERATION, -1.0),
    (fleet.LOAD, records.THRUST, -1.0),
    (fleet.CONSTRAINT_FORCE, records.CONSTRAINT_FORCE, -1.0),
    (fleet.HORIZONTAL, records.HORIZONTAL_ACCELERATION, -1.0),
    (fleet.VERTICAL, records.VERTICAL_ACCELERATION, -1.0),
)
_OF_FLIGHT = {"clearance_start": records.STANDING, "clearance_flight": records.FLYING}
#: The quantities of a phase, each with its name, its index, and the sign with which it is stored.
_STORED = [(name, k, 1.0 if QUANTITIES[name].at_least else -1.0) for name, k in _NAMES.items()]
_OF_PHASE = np.array(list(_NAMES.values()))


class CurveWatch:
    """Watches curves of vehicles, and reports their worst values in continuous time."""

    def __init__(self, mission: Mission, t: float = 0.0) -> None:
        """Watch vehicles that begin at a time [s]."""
        fleet, obstacles, limits = mission.fleet, mission.obstacles, mission.limits
        self.boundaries = BoundaryWatch(mission)
        self.n = len(fleet.radius)
        self.radius = np.array(fleet.radius, dtype=float)
        self._set_obstacles(obstacles)
        fence = limits.geofence
        self.fence = np.array([] if fence is None else [*fence.min, *fence.max]).reshape(-1, 6)
        lowest = limits.separation_altitude
        self.altitude = math.inf if lowest is None else lowest
        #: Of a large fleet, pairs that come as near as this [m] are listed: who is farther away in flight is not known.
        self.reach = -math.inf if lowest is None or self.n <= _FEW else limits.separation or 0.0
        self.stacks = self.n <= _FEW or limits.separation_below is not None
        #: Whether there are limits by direction: only then is what they limit searched for.
        self.directed = any(getattr(limits, q.name) is not None for q in _DIRECTIONS)
        count = records.EXTREMA
        self.none = np.full(count, np.inf)
        self.none[records.SEPARATION_FLYING] = abs(self.reach)
        self.none[records.HORIZONTAL_SPEED :] = np.inf if self.directed else -np.inf
        self.worst, self.when = self.none.copy(), np.zeros(count)
        self.who, self.sign = np.full((count, 2), -1), np.zeros(1)
        self.left = np.ones(self.n, dtype=np.bool_)
        self.low = np.full((self.n, 3), np.inf)
        self.standing = np.zeros(self.n, dtype=np.int64)
        if obstacles:
            below = proximity.below(fleet.position, self.radius, obstacles, np.full(self.n, t), PAD)
            self.standing[:] = below.any(axis=0)
        self.pairs = self.columns = self.struck = np.zeros((0, 2), dtype=np.int64)
        self.spare, self.moved = 0.0, np.zeros(2)
        self.touched: dict[str, Extremum] = {}  # first contacts of the flight
        self._list_all_pairs()

    def _set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        corners = [thing.box_bounds for thing in obstacles]
        #: Obstacles of all kinds, unless all are boxes that the monitor itself takes.
        self.solids = None
        if None in corners:
            self.solids, corners = join_solids([thing.solid for thing in obstacles]), []
        self.boxes = np.array(corners).reshape(-1, 6)

    @cached_property
    def monitor(self) -> native.Watch:
        """What monitors: curves of positions and velocities, unless a flight begins to monitor a trail of its own."""
        return self._new_monitor(6 * self.n, 0)

    def _new_monitor(self, states: int, gauge: int) -> native.Watch:
        """A monitor of trails of so many states and forces."""
        return native.Watch(
            records.new_monitor(
                self.radius, self.boxes, self.fence, states, gauge,
                worst=self.worst, when=self.when, who=self.who, sign=self.sign, left=self.left,
                standing=self.standing, low=self.low, pad=PAD, altitude=self.altitude, pairs=self.pairs,
                columns=self.columns, struck=self.struck,
            )
        )  # fmt: skip

    def monitor_curves(self, clock: Floats, points: Floats) -> None:
        """Take curves of fourth degree with starts and lengths (S, 2) [s], by control points (S, 5, 6N).

        The first 3N are positions [m], the others velocities [m/s], world axes.
        """
        # Of a problem, the monitor of curves reads how many vehicles there are, and of an integrator the trail alone.
        problem, state = packing.example_of(Problem), packing.example_of(records.IntegratorState)
        problem = problem._replace(vehicles=problem.vehicles._replace(m=np.ones(self.n)))
        trail = state.trail._replace(clock=clock, points=points)
        count = np.zeros_like(state.count)
        count[records.TRAILED] = len(clock)
        self.monitor_paths(problem, state._replace(trail=trail, count=count))

    def keep_agents(self, left: Bools) -> None:
        """Continue with the vehicles ``left`` (N,) alone, as if the others were not there."""
        self.left[:] = left
        self._list_all_pairs()
        self._watch_listed_pairs(0.0)
        self.moved[:] = np.inf  # of a large fleet, no pairs are listed yet

    def deepest_contact(self) -> Extremum | None:
        """The deepest contact of a vehicle in flight with an obstacle so far; None if there was none."""
        nearest = self._extremum(records.FLYING), self._landing_clearance()
        contacts = [x for x in nearest if x is not None and x.value < -_TOUCH]
        return min(contacts, key=lambda x: x.value, default=None)

    def monitor_paths(
        self, problem: Problem, state: records.IntegratorState, first: int = 0
    ) -> None:
        """Evaluate the paths alone of the steps in a trail from ``first`` on, not the forces."""
        steps = int(state.count[records.TRAILED])
        self._monitor_clearances(problem, state, first, steps)
        if self.boundaries.every:
            rows = _trail_rows(state, np.arange(first, steps))
            clock, points = state.trail.clock[rows], state.trail.points[rows]
            self.boundaries.add_steps(*steps_in_world(clock, points, problem), self.left)
        if self.n > _FEW:
            for step in range(first, steps):
                row = _trail_rows(state, (step,))
                part = state.trail.clock[row], state.trail.points[row]
                self._watch_step(problem, state, *part)
            return
        self.monitor.search_distances(problem, state, first, steps)
        self._find_first_contacts(problem, state, range(first, steps))

    def _find_first_contacts(
        self, problem: Problem, state: records.IntegratorState, step_indices: range
    ) -> None:
        """Find the first contact of each kind in some steps of the trail, if there has been none before.

        Of steps, and then of one step's halves, the first half is searched, until what is left is very short.
        """
        for name, kind in _CONTACTS.items():
            if name in self.touched or not self.worst[kind] < -_TOUCH:
                continue
            deepest = partial(self._deepest_contact_of_kind, kind, problem, state)
            rows = _trail_rows(state, step_indices)
            steps, points = state.trail.clock[rows], state.trail.points[rows]
            while steps[-1].sum() - steps[0, 0] > _INSTANT:
                if len(steps) == 1:
                    steps, points = _half_steps_and_points(*steps[0], points[0])
                half = len(steps) // 2
                part = slice(half) if deepest(steps[:half], points[:half]) else slice(half, None)
                steps, points = steps[part], points[part]
            if (contact := deepest(steps, points)) is not None:
                self.touched[name] = contact

    def _deepest_contact_of_kind(
        self, kind: int, problem: Problem, state: Any, *steps: Floats
    ) -> Extremum | None:
        """The deepest contact of a kind in steps (S, 2), (S, 5, n) of an integrator; None if there is none."""
        trail = records.Trail(*steps, *state.trail[2:])
        state = state._replace(trail=trail, count=np.zeros_like(state.count))
        arrays = [getattr(self.monitor.monitor, name) for name in _WRITTEN]
        before = [array.copy() for array in arrays]
        self.worst.fill(-np.inf)  # nothing else is searched for
        self.worst[kind] = -_TOUCH
        arrays[-1][:] = 0
        self._monitor_clearances(problem, state, 0, len(steps[0]))
        self.monitor.search_distances(problem, state, 0, len(steps[0]))
        contact = self._extremum(kind) if self.worst[kind] < -_TOUCH else None
        for array, own in zip(arrays, before, strict=True):
            array[...] = own
        return contact

    def _monitor_clearances(
        self, problem: Problem, state: records.IntegratorState, first: int, end: int
    ) -> None:
        """Take the clearances of some steps in the trail to obstacles that the monitor itself does not take."""
        if self.solids is not None:
            self.monitor.search_clearances(problem, state, first, end, self.solids)

    def extremes_so_far(self) -> dict[str, Extremum]:
        """Extremes of the phase under way, by name."""
        worst, when, who = self.worst.tolist(), self.when.tolist(), self.who.tolist()
        none = self.none.tolist()
        extremes = {
            name: Extremum(sign * worst[k], when[k], *who[k])
            for name, k, sign in _STORED
            if -math.inf < worst[k] < none[k]
        }
        if (tension := extremes.get("tension")) is not None and self.sign[0] < 0.0:
            extremes["tension"] = tension._replace(value=-tension.value)
        return extremes | {name: Extremum(*x) for name, x in self.boundaries.search().items()}

    def end_phase(self) -> dict[str, Extremum]:
        """Extremes of the phase that ends, by name; start those of the next one."""
        extremes = self.extremes_so_far()
        self.worst[_OF_PHASE] = self.none[_OF_PHASE]
        self.boundaries.worst.clear()
        self.moved[:] = np.inf  # the list was made for a worst value that no longer counts
        return extremes

    def add_extremes_to_phases(self, phases: Sequence[PhaseRecord]) -> None:
        """Give the phases of a finished flight its first contacts, and its clearances in flight and on an obstacle."""
        extremes: dict[str, Extremum | None] = dict(self.touched)
        if self.solids is not None or len(self.boxes):
            extremes |= {name: self._extremum(k) for name, k in _OF_FLIGHT.items()}
            extremes["clearance_end"] = self._landing_clearance()
        for name, x in extremes.items():
            if x is not None:
                last = [p for p in phases if p.t_start <= x.time] or phases
                last[-1].extremes[name] = x

    def _landing_clearance(self) -> Extremum | None:
        """The least clearance of an agent that has stayed near since, as it may be landing; None if there is none."""
        near = np.where(self.left & (self.standing == 0), self.low[:, 0], np.inf)
        i = int(near.argmin())
        value, when, obstacle = self.low[i].tolist()
        return Extremum(value, when, i, int(obstacle)) if math.isfinite(near[i]) else None

    def _extremum(self, kind: int) -> Extremum | None:
        value = float(self.worst[kind])
        if not math.isfinite(value):
            return None
        return Extremum(value, float(self.when[kind]), *map(int, self.who[kind]))

    # -- large fleets ---------------------------------------------------------------------------------

    def _list_all_pairs(self) -> None:
        """List all pairs of a small fleet; none of a large one yet."""
        self.moved[:] = np.inf
        if self.n <= _FEW:
            pairs = proximity.all_pairs(self.n).T
            self.pairs = self.columns = np.ascontiguousarray(
                pairs if self.left.all() else pairs[self.left[pairs].all(axis=1)]
            )

    def _watch_step(
        self, problem: Problem, state: records.IntegratorState, clock: Floats, points: Floats
    ) -> None:
        """Monitor the distances of one step (1, 2), (1, 5, n), in which only the listed pairs matter.

        In a crowd, whose list would be too long for a step in which vehicles go far, its halves are watched instead.
        """
        trail = records.Trail(clock, points, state.trail.gauge[:0], state.trail.start)
        alone = state._replace(trail=trail)
        self.monitor.write_first_step_change_bounds(problem, alone)
        moved = self.monitor.monitor.moves.copy()
        if not self.stacks:
            moved[1] = 0.0
        if (self.moved + moved > self.spare).any():
            begin, length = clock.ravel()
            far = 0.0 if self.n > _CROWD and length > _INSTANT else float(moved.max())
            self._list_near_pairs(problem, points[0, 0], far)
            if moved.max() > self.spare:
                for half in zip(*_half_steps_and_points(begin, length, points[0]), strict=True):
                    self._watch_step(problem, state, *(x[None] for x in half))
                return
        self.moved += moved
        self.monitor.search_distances(problem, alone, 0, 1)
        self._find_first_contacts(problem, alone, range(1))

    def _list_near_pairs(self, problem: Problem, y: Floats, moves: float) -> None:
        """List the pairs that are near each other, or one below the other, at a state (n,).

        The list is valid at least until distances may have changed by ``moves`` [m].
        """
        from scipy.spatial import KDTree

        who = np.flatnonzero(self.left)
        x = y[: 3 * self.n].reshape(-1, 3)[who]
        if len(who) < 2:
            self.pairs = self.columns = np.zeros((0, 2), dtype=np.int64)
            self._watch_listed_pairs(math.inf)
            return
        widest = 2.0 * float(self.radius[who].max())
        tree = KDTree(x, balanced_tree=False, compact_nodes=False)
        # The nearest pair of some agents is no nearer than that of all: the list is only longer.
        some = np.arange(len(who))
        if len(who) > _SAMPLE:
            some = np.random.default_rng(0).integers(len(who), size=_SAMPLE)
        near, j = tree.query(x[some], k=2)
        # Of two agents at the same place, either may be found as its own nearest one.
        other = np.where(j[:, 1] == some, j[:, 0], j[:, 1])
        separations = near[:, 1] - self.radius[who[some]] - self.radius[who[other]]
        size = float(np.linalg.norm(np.ptp(x, axis=0))) / math.sqrt(len(who))
        spare = max(_SPARE * float(np.median(near[:, 1])), _LEAST * size, 1.01 * moves, 1e-6)
        least = min(float(separations.min()), float(self.worst[records.SEPARATION]))
        least = max(least, self.reach)
        pairs = who[tree.query_pairs(least + widest + spare, output_type="ndarray")]
        self.pairs = np.ascontiguousarray(np.sort(pairs, axis=1))
        if self.stacks:
            if problem.body_formulation:
                q = y[6 * self.n + len(problem.graph.edges) :][:4]
                x = x @ att.dcm_from_quaternion(q / np.linalg.norm(q))
            flat = KDTree(x[:, :2], balanced_tree=False, compact_nodes=False)
            columns = who[flat.query_pairs(widest + spare, output_type="ndarray")]
            self.columns = np.ascontiguousarray(np.sort(columns, axis=1))
        self._watch_listed_pairs(spare)

    def _watch_listed_pairs(self, change_until_renewal: float) -> None:
        """Monitor the listed pairs; no others matter until distances have changed by ``change_until_renewal`` [m]."""
        self.spare, self.moved[:] = change_until_renewal, 0.0
        self._replace_monitor_arrays(pairs=self.pairs, columns=self.columns)

    def _replace_monitor_arrays(self, **arrays: Any) -> None:
        """Go on with other arrays in place of some."""
        before = self.monitor.monitor
        self.monitor = native.Watch(before._replace(count=before.count.copy(), **arrays))


class Extremes(CurveWatch):
    """Monitors a flight and reports the worst values of each phase."""

    def __init__(self, mission: Mission) -> None:
        super().__init__(mission)
        #: States in the trail, and edges, for which there is a monitor.
        self.size: tuple[int, int] | None = None
        self._thread: ThreadPoolExecutor | None = None  # of large formations
        self._taking: Future[None] | None = None
        self.of_vehicles: dict[str, Extremum] = {}
        self.avoidance: avoidance.AvoidanceArrays | None = None  # that of the phase under way
        self.of_layers: dict[str, Extremum] = {}  # what its clock and its body layer did

    def replace_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Continue among these obstacles; the first of them are those before."""
        self._set_obstacles(obstacles)
        self._replace_monitor_arrays(boxes=self.boxes)

    def begin_monitoring(self, states: int, edges: int, room: int) -> records.Trail:
        """Begin to monitor a trail, which has room for so many steps, of so many states and edges; return it."""
        size = states, edges
        if size != self.size:  # else the memory of the phase before serves this one
            self.size = size
            self.trail = records.new_trail(room, states, self.n, edges, self.directed)
            self.monitor = self._new_monitor(states, self.trail.gauge.shape[1])
        return self.trail

    def remove_lost(self, lost: Bools) -> None:
        """Continue without the vehicles ``lost`` (N,), which must not hit the others."""
        for i in np.flatnonzero(lost & self.left & (self.low[:, 0] < np.inf)):
            # It was near an obstacle when it was lost, and is no longer landing.
            value, t, b = self.low[i]
            if value < self.worst[records.FLYING]:
                self.worst[records.FLYING], self.when[records.FLYING] = value, t
                self.who[records.FLYING] = i, int(b)
            self.low[i, 0] = np.inf
        self.left[:] = ~lost
        gone, left = np.flatnonzero(lost), np.flatnonzero(~lost)
        struck = np.stack(np.meshgrid(gone, left, indexing="ij"), axis=-1).reshape(-1, 2)
        self.struck = np.ascontiguousarray(struck)
        self._list_all_pairs()
        self.size = None  # other vehicles are monitored from now on

    def search_trail_for_extremes(
        self, problem: Problem, work: Workspace, state: records.IntegratorState, *, last: bool
    ) -> None:
        """Evaluate the steps in the trail; ``last``: no further steps of the segment follow."""
        self.monitor_paths(problem, state, int(self.monitor.monitor.count[records.STAYED]))
        self.monitor.search_forces(problem, work, state, last=last)

    def steps_until_trail_full(self, state: records.IntegratorState) -> int:
        """Number of steps for which the trail has room beside those that another thread evaluates."""
        # Beside as many others, and one that has stayed.
        half = (len(state.trail.clock) - 1) // 2
        return half + 1 - int(state.count[records.TRAILED])

    def send_steps(self, problem: Problem, work: Workspace, state: records.IntegratorState) -> None:
        """Let another thread evaluate the steps in the trail; no more than `steps_until_trail_full` may follow.

        Until `wait_for_steps`, only that thread may use this monitor, ``work``, and what the problem's law changes.
        """
        taken, count = state._replace(count=state.count.copy()), state.count
        # The last step stays, until its neighbour is known.
        row = _trail_rows(state, count[records.TRAILED] - 1)
        count[records.TRAILED], count[records.FIRST_ROW] = 1, row
        if self._thread is None:
            from concurrent.futures import ThreadPoolExecutor

            self._thread = ThreadPoolExecutor(1)
        self._taking = self._thread.submit(self._monitor_steps_in_thread, problem, work, taken)

    def _monitor_steps_in_thread(self, *arguments: Any) -> None:
        self.search_trail_for_extremes(*arguments, last=False)
        packing.forget_last_packed()  # the phase may be over before this thread packs others

    def wait_for_steps(self) -> None:
        """Wait until the steps that were handed over are evaluated."""
        if self._taking is not None:
            error = self._taking.exception()  # Ctrl-C ends the waiting, not the evaluation
            self._taking = None
            if error is not None:
                raise error

    def take_vehicle_extremes(
        self, state: fleet.SampledState, vehicles: fleet.Quadrotors, gone: Bools, ticks: int
    ) -> None:
        """Take the extremes that a sampled flight keeps by itself, of a phase of some ticks so far.

        Vehicles ``gone`` (N,) were lost before the phase; those that are lost in it count up to then.
        """
        self.of_vehicles = {}
        rotors, left = ~(vehicles.point | gone), np.flatnonzero(~gone)
        for k, kind, sign in _SAMPLED:
            self._update_least(kind, sign * state.worst[left, k], state.worst_time[left, k], left)
        load, when = (x[left, fleet.LOAD] for x in (state.worst, state.worst_time))
        self._update_least(records.THRUST_MARGIN, vehicles.limit[left] - load, when, left)
        rows: dict[str, tuple[Floats, Floats]] = {}
        if rotors.any():
            peak = np.where(rotors[:, None], state.peak, -1.0)
            share = peak / vehicles.force[:, 1:]
            i, j = (int(k) for k in np.unravel_index(int(share.argmax()), share.shape))
            self.of_vehicles["rotor_force"] = Extremum(
                float(peak[i, j]), float(state.peak_time[i, j]), i, j
            )
            upright = np.where(rotors, state.worst[:, fleet.UPRIGHT], 1.0)
            angle = np.arccos(np.clip(upright, -1.0, 1.0))
            rows["tilt"] = angle, state.worst_time[:, fleet.UPRIGHT]
        # Where a flight grows beyond all bounds, its error is not known.
        error = np.where(gone, -1.0, np.nan_to_num(state.worst[:, fleet.ERROR], posinf=-1.0))
        if error.max() > 0.0:
            rows["tracking_error"] = error, state.worst_time[:, fleet.ERROR]
        share = np.where(vehicles.lost, 0.0, state.saturations / max(ticks, 1))
        rows["saturation"] = share, np.full(self.n, state.clock[fleet.TIME])
        for name, (values, times) in rows.items():
            i = int(values.argmax())
            self.of_vehicles[name] = Extremum(float(values[i]), float(times[i]), i, -1)

    def _avoidance_extremes(self) -> dict[str, Extremum]:
        """What avoidance in flight has recorded of the phase so far, by name."""
        arrays, extremes = self.avoidance, {}
        if arrays is None:
            return extremes
        ticks = max(int(arrays.count[avoidance.TICKS]), 1)
        for name, kind in (("barrier", avoidance.BARRIER), ("guard", avoidance.GUARD)):
            acted = arrays.acted[kind]
            i = int(acted.argmax())
            if acted[i]:
                first = float(arrays.first[kind].min())
                extremes[name] = Extremum(int(acted[i]) / ticks, first, i, -1)
        for name, kind in (
            ("guarantee", avoidance.PAIR),
            ("clearance_guarantee", avoidance.OBSTACLE),
        ):
            (value, t), who = arrays.margin[kind].tolist(), arrays.between[kind].tolist()
            if math.isfinite(value):
                extremes[name] = Extremum(value, t, *who)
            (t, value), who = arrays.lost[kind].tolist(), arrays.loser[kind].tolist()
            if math.isfinite(t):
                extremes[f"{name}_lost"] = Extremum(value, t, *who)
        return extremes

    def _update_least(self, kind: int, values: Floats, times: Floats, who: Ints) -> None:
        """Take the least of the agents' values into account; of equal ones, the first in time."""
        if len(who) and (value := float(values.min())) < self.worst[kind]:
            i = int(np.where(values == value, times, np.inf).argmin())
            self.worst[kind], self.when[kind], self.who[kind] = value, times[i], (who[i], -1)

    def extremes_so_far(self) -> dict[str, Extremum]:
        """Extremes of the phase under way, by name."""
        extremes = super().extremes_so_far()
        extremes.update(self.of_vehicles, **self._avoidance_extremes(), **self.of_layers)
        return extremes

    def end_phase(self) -> dict[str, Extremum]:
        """Extremes of the phase that ends, by name; start those of the next one."""
        extremes = super().end_phase()
        self.of_vehicles, self.avoidance, self.of_layers = {}, None, {}
        return extremes


def _half_steps_and_points(t: float, h: float, points: Floats) -> tuple[Floats, Floats]:
    """Starts and lengths (2, 2) [s], and control points (2, 5, n), of both halves of a step with points (5, n)."""
    knots = (records.KNOTS + [[0.0], [1.0]]) / 2.0
    clock = np.array([[t, 0.5 * h], [t + 0.5 * h, 0.5 * h]])
    return clock, records.FROM_KNOTS @ (records.bernstein_basis(knots) @ points)


def steps_in_world(clock: Floats, points: Floats, problem: Problem) -> tuple[Floats, Floats]:
    """Steps (S, 2) [s] and control points (S, N, 6, 5) of positions and velocities of a trail, in world axes.

    In the body formulation, steps are cut so short that their axes turn by less than `_TURN`, and curves of fourth
    degree go through five places of each.
    """
    n = len(problem.vehicles.m)
    if problem.body_formulation:
        first = 6 * n + len(problem.graph.edges)
        q = points[:, :, first : first + 4]
        turns = np.linalg.norm(np.diff(q, axis=1), axis=2).max(axis=1) / np.linalg.norm(
            q, axis=2
        ).min(axis=1)
        parts = int(max(1.0, np.ceil(8.0 * turns.max(initial=0.0) / _TURN)))
        shares = (np.arange(parts)[:, None] + records.KNOTS) / parts
        x = (records.bernstein_basis(shares.ravel()) @ points).reshape(-1, 5, points.shape[2])
        clock = np.repeat(clock, parts, axis=0)
        clock[:, 1] /= parts
        clock[:, 0] += clock[:, 1] * np.tile(np.arange(parts), len(points))
        q = x[..., first : first + 4]
        T = att.dcm_from_quaternion(q / np.linalg.norm(q, axis=2, keepdims=True))
        own = x[..., : 6 * n].reshape(*x.shape[:2], 2 * n, 3) @ T
        centres = x[..., first + 4 : first + 10].reshape(*x.shape[:2], 2, 3)
        own += np.repeat(centres, n, axis=2)
        points = records.FROM_KNOTS @ own.reshape(*x.shape[:2], 6 * n)
    both = points[..., : 6 * n].reshape(-1, 5, 2, n, 3)
    return clock, both.transpose(0, 3, 2, 4, 1).reshape(-1, n, 6, 5)


def _trail_rows(state: records.IntegratorState, steps: ArrayLike) -> Ints:
    """Rows (S,) of the trail that hold some of the steps in it (S,), which are numbered from 0."""
    return (state.count[records.FIRST_ROW] + np.asarray(steps)) % len(state.trail.clock)
