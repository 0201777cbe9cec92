"""The closed loop of a problem as straight-line code, generated from the kernel's own source.

The kernel's functions run once in plain Python, with symbols in place of numbers, and all operations on
the symbols are recorded. The result has no loops, indices, branches, products with zero or repeated
computations. Whatever depends on masses and gains alone is computed before the flight.
`rigidfleet.kernel.engine.codegen` compiles the rest for eight flights at a time: eight flights of one problem
(`Trace`), or one of each of eight problems that differ in their numbers alone (`FlightTrace`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from types import FunctionType, SimpleNamespace
from typing import Any

import numpy as np
from numba.core.dispatcher import Dispatcher
from numpy.typing import NDArray

from rigidfleet._common.renamed import getattr_of_earlier_names
from rigidfleet.kernel import dynamics, gauge
from rigidfleet.kernel.problem import EXACT, ITERATED, Graph, Problem, workspace
from rigidfleet.typing import Floats, Ints

#: Sources of a symbol's value, in the order in which they become known: numbers of the problem;
#: numbers of the flight, of the moment (the same for all flights, or by flight), and of its state.
UNIFORM, FLIGHT, TIME, STATE = range(4)
INPUTS = {"uniform": UNIFORM, "before": FLIGHT, "time": TIME, "table": TIME, "y": STATE}
#: Places among the moment's numbers: blend and two derivatives; time since the reference's piece began; weights of
#: the gusts' and of the noise's splines.
BLEND, SINCE, GUST, NOISE, MOMENT = 0, 3, 4, 8, 12
#: Tables over time: pieces of the reference motion, gusts, noise of positions and of velocities.
MOTION, GUSTS, NOISE_R, NOISE_V = range(4)

#: Terms of the series of functions of an angle, and the square of the greatest angle; exact to 1e-15 up to it.
_TERMS, _WIDEST = 17, 16.0


class UnfitError(ValueError):
    """A branch or an operation that straight-line code cannot express."""


class Symbol:
    """An unknown number: the operation that computes it, and its arguments (symbols or numbers)."""

    __slots__ = ("arguments", "known", "operation", "serial", "trace")

    def __init__(self, trace: Trace, operation: str, arguments: tuple[Any, ...]) -> None:
        self.trace, self.operation, self.arguments = trace, operation, arguments
        self.serial = len(trace.made)
        knowledge = [x.known for x in arguments if isinstance(x, Symbol)]
        self.known = INPUTS[operation] if operation in INPUTS else max(knowledge, default=UNIFORM)

    def __add__(self, other: Any) -> Any:
        return self.trace.add(self, other)

    def __radd__(self, other: Any) -> Any:
        return self.trace.add(other, self)

    def __sub__(self, other: Any) -> Any:
        return self.trace.subtract(self, other)

    def __rsub__(self, other: Any) -> Any:
        return self.trace.subtract(other, self)

    def __mul__(self, other: Any) -> Any:
        return self.trace.multiply(self, other)

    def __rmul__(self, other: Any) -> Any:
        return self.trace.multiply(other, self)

    def __truediv__(self, other: Any) -> Any:
        return self.trace.multiply(self, self.trace.inverse(other))

    def __rtruediv__(self, other: Any) -> Any:
        return self.trace.multiply(other, self.trace.inverse(self))

    def __neg__(self) -> Any:
        return self.trace.subtract(0.0, self)

    def __gt__(self, other: Any) -> bool:
        """Whether it is positive: known for the problem's numbers, assumed for other symbols."""
        if other != 0.0:
            raise UnfitError("a comparison with a number other than zero")
        if self.operation == "uniform":
            return self.trace.known_positive(self)
        self.trace.positive.append(self)
        return True

    def __bool__(self) -> bool:
        raise UnfitError("a branch that depends on the state")


class Trace:
    """The recorded operations of the kernel on the numbers of one problem.

    The edges are reordered so that the factor of A has little fill; states, outputs
    and distances keep their order.

    Parameters
    ----------
    problem : an open-loop flight with a distance reference

    Attributes
    ----------
    made : symbols by their operation and arguments
    outputs : (n,) the derivative of the state, symbols or numbers
    gauge : (5N + 2m,) forces to watch, or none
    coordinates : number of coordinates of positions; their derivatives are velocities
    positive : symbols assumed positive; if one is not, the state has no derivative

    Raises
    ------
    UnfitError
        The problem has branches that depend on the state.
    """

    def __init__(self, problem: Problem) -> None:
        if problem.law.solver not in (ITERATED, EXACT):
            raise UnfitError("a law that continues if its matrix has no factor")
        self.made: dict[tuple[Any, ...], Symbol] = {}
        self.positive: list[Symbol] = []
        n, m = len(problem.vehicles.m), len(problem.graph.edges)
        order = elimination_order(problem.graph.edges)
        states = np.arange(6 * n + m)
        states[6 * n :] += order - np.arange(m)
        work = workspace(n, m, solver=problem.law.solver)
        w = type(work)(*(np.full(x.shape, 0.0, dtype=object) for x in work))
        y = np.array([self.symbol("y", q) for q in states.tolist()], dtype=object)
        dy = np.full(len(y), 0.0, dtype=object)
        p = self._with_symbols(problem)
        reference = p.reference._replace(d0=p.reference.d0[order], d1=p.reference.d1[order])
        p = p._replace(graph=_reorder_edges(p.graph, order), reference=reference)
        self._as_plain_python(dynamics.closed_loop)(0.0, y, dy, p, w)
        self.outputs: list[Any] = dy[np.argsort(states)].tolist()
        self.coordinates = 3 * n
        if any(self.outputs[q] is not y[3 * n + q] for q in range(3 * n)):
            raise UnfitError("a derivative of a position that is not the velocity")
        self.gauge: list[Any] = self._watched_forces(p, w, order)

    def _with_symbols(self, problem: Problem) -> Problem:
        """The problem with symbols in place of its numbers."""
        _, self._values, which = code_structure(problem)
        self._numbers = iter(which.tolist())
        p = _drop_unused_parts(problem)
        p = p._replace(**{name: self._symbols_of(getattr(p, name)) for name in _PARTS})
        before = [self.symbol("before", k) for k in range(len(problem.graph.edges))]
        return p._replace(reference=p.reference._replace(d0=np.array(before, dtype=object)))

    def _watched_forces(self, p: Problem, w: Any, order: Ints) -> list[Any]:
        """Forces to watch, see `gauge.write_watched_forces`: none."""
        return []

    def known_positive(self, x: Symbol) -> bool:
        """Whether a number of the problem is positive; `code_structure` distinguishes those that are not."""
        return bool(self._values[x.arguments[0]] > 0.0)

    def symbol(self, operation: str, *arguments: Any) -> Symbol:
        """Return the one symbol of an operation on arguments."""
        key = operation, *((x.serial,) if isinstance(x, Symbol) else x for x in arguments)
        if key not in self.made:
            self.made[key] = Symbol(self, operation, arguments)
        return self.made[key]

    def add(self, a: Any, b: Any) -> Any:
        """Return a + b."""
        if _equals_number(a, 0.0):
            return b
        if _equals_number(b, 0.0):
            return a
        return self.symbol("add", a, b)

    def subtract(self, a: Any, b: Any) -> Any:
        """Return a - b."""
        if a is b:
            return 0.0
        if _equals_number(b, 0.0):
            return a
        if not _equals_number(a, 0.0):
            return self.symbol("sub", a, b)
        return b.arguments[0] if b.operation == "neg" else self.symbol("neg", b)

    def multiply(self, a: Any, b: Any) -> Any:
        """Return a b."""
        for x, y in ((a, b), (b, a)):
            if _equals_number(x, 0.0):
                return 0.0
            if _equals_number(x, 1.0):
                return y
            if _equals_number(x, -1.0):
                return self.subtract(0.0, y)
        # So that x y and y x are the same symbol.
        swap = isinstance(b, Symbol) and (not isinstance(a, Symbol) or b.serial < a.serial)
        return self.symbol("mul", b, a) if swap else self.symbol("mul", a, b)

    def inverse(self, x: Any) -> Any:
        """Return 1 / x."""
        if not isinstance(x, Symbol):
            return 1.0 / x
        if x.operation == "root":
            return x.arguments[1]
        return self.symbol("inverse", x)

    def root(self, x: Any) -> Any:
        """Return the root of x."""
        if not isinstance(x, Symbol):
            return math.sqrt(x)
        return self.symbol("root", x, self.symbol("inverse_root", x))

    def _series(self, square: Any, first: int, derivative: int = 0) -> Any:
        """Sum of (-x)^k / (2 k + first)!, or its derivative; x is the square of an angle, at most that of `_WIDEST`."""
        weights = [(-1.0) ** k / math.factorial(2 * k + first) for k in range(_TERMS)]
        weights = [k * w for k, w in enumerate(weights)][1:] if derivative else weights
        total = weights[-1]
        for weight in weights[-2::-1]:
            total = total * square + weight
        return total

    def _angle_square(self, x: Any) -> Any:
        """The square of an angle [rad], which must not be too wide for the series."""
        xx = x * x
        self._add_narrow_angle_condition(xx)
        return xx

    def _add_narrow_angle_condition(self, square: Any) -> None:
        if isinstance(square, Symbol):
            self.positive.append(self.subtract(_WIDEST, square))

    def _sine(self, x: Any) -> Any:
        return x * self._series(self._angle_square(x), 1) if isinstance(x, Symbol) else math.sin(x)

    def _cosine(self, x: Any) -> Any:
        return self._series(self._angle_square(x), 0) if isinstance(x, Symbol) else math.cos(x)

    def _rate_factors(self, xx: Any, s: Any) -> tuple[Any, ...]:
        """As `control.rate_factors`, without its branch."""
        self._add_narrow_angle_condition(xx)
        a, b = self._series(xx, 2), self._series(xx, 3)
        twice = s + s
        return a, b, twice * self._series(xx, 2, 1), twice * self._series(xx, 3, 1)

    def _symbols_of(self, x: Any) -> Any:
        """Replace numbers by symbols, equal numbers by the same one; 0 and 1 stay numbers."""
        if isinstance(x, tuple):
            return type(x)(*map(self._symbols_of, x))
        if isinstance(x, np.ndarray):
            plain = [self._symbols_of(value) for value in x.ravel().tolist()]
            return np.array(plain, dtype=object).reshape(x.shape)
        if not isinstance(x, float):
            return x
        index = next(self._numbers)
        return x if x in (0.0, 1.0) else self.symbol("uniform", index)

    def _as_plain_python(self, function: Dispatcher) -> Callable[..., Any]:
        """The function, and all that it calls, as plain Python functions with mathematics for symbols."""
        some = lambda operation, plain: (  # noqa: E731
            lambda a, b: self.symbol(operation, a, b) if _has_symbol(a, b) else plain(a, b)
        )
        mathematics = SimpleNamespace(
            sqrt=self.root, sin=self._sine, cos=self._cosine, nan=math.nan, inf=math.inf
        )
        time = lambda *places: [self.symbol("time", k) for k in places]  # noqa: E731
        instead = {
            "math": mathematics,
            "max": some("max", max),
            "min": some("min", min),
            "septic": lambda *_: time(BLEND, BLEND + 1, BLEND + 2),
            "piece_at": lambda *_: (0, *time(SINCE), 0.0),
            # The step of a table has been replaced by the place of its weights.
            "spline_weights": lambda _, k, __: (0, *time(*range(k, k + 4))),
            "rate_factors": self._rate_factors,
            "where_positive": lambda x, a, b: self.symbol("where_positive", x, a, b),
            "is_known_positive": lambda _: False,  # not known
        }
        worlds: dict[int, dict[str, Any]] = {}

        def rebuild_in_python(function: Dispatcher) -> FunctionType:
            source = function.py_func.__globals__
            if id(source) not in worlds:
                world = worlds[id(source)] = dict(source)
                calls = {k: v for k, v in source.items() if isinstance(v, Dispatcher)}
                world.update({k: rebuild_in_python(v) for k, v in calls.items()})
                world.update(instead)
            return FunctionType(function.py_func.__code__, worlds[id(source)])

        return rebuild_in_python(function)


#: Numbers in which the problems of eight flights may differ, and arrays of numbers. Those of the last lines are left
#: out of the code where they are zero in all.
_NUMBERS = (
    "vehicles.M", "vehicles.mean", "vehicles.g", "control.k1", "control.k2", "law.alpha",
    "law.beta", "law.gamma", "law.mu", "law.k_def",
)  # fmt: skip
_ARRAYS = (
    "vehicles.m", "vehicles.inverse", "vehicles.thrust_limit", "graph.weight", "graph.diagonal", "reference.d0",
    "reference.d1", "reference.p0", "motion.T1", "control.force", "disturbance.m", "disturbance.inverse",
    "disturbance.drag", "disturbance.wind",
    "reference.dp", "reference.turn",
)  # fmt: skip
#: Places of the slots' turn among the `varying_numbers`.
TURN = slice(-3, None)
_MAY_BE_ZERO = {*_NUMBERS[-4:], *_ARRAYS[-2:]}
_numbers_of, _arrays_of = attrgetter(*_NUMBERS), attrgetter(*_ARRAYS)


def varying_numbers(problems: Iterable[Problem]) -> Floats:
    """The numbers (U, B) in which B problems of one graph may differ, in the order of `FlightTrace`."""
    rows = [
        np.concatenate([_numbers_of(p), *[x if x.ndim == 1 else x.ravel() for x in _arrays_of(p)]])
        for p in problems
    ]
    return np.array(rows).T


class FlightTrace(Trace):
    """The recorded operations of the kernel on eight problems, which differ in their numbers alone.

    Numbers differ from flight to flight; so do the tables over time, of which the code reads the rows of the moment.

    Parameters
    ----------
    problem : one of them
    values : (U, B) `varying_numbers` of all of them
    moves : for each component of the reference motion, whether it is not zero in all of them

    Raises
    ------
    UnfitError
        The problem has branches that depend on the state.
    """

    def __init__(self, problem: Problem, values: Floats, moves: Sequence[bool]) -> None:
        self._values, self._moves = values, moves
        super().__init__(problem)

    def known_positive(self, x: Symbol) -> bool:
        """Whether a number is positive: in all problems, or in none (`flight_code_structure`)."""
        return bool((self._values[x.arguments[0]] > 0.0).all())

    def _with_symbols(self, problem: Problem) -> Problem:
        parts: dict[str, dict[str, Any]] = {}
        there = _nonzero_by_name(problem, self._values)
        for name, index, x in _named_numbers(problem):
            zero = not there.get(name, True)
            made = [0.0 if zero else self.symbol("uniform", index + k) for k in range(np.size(x))]
            part, field = name.split(".")
            array = np.array(made, dtype=object).reshape(np.shape(x))
            parts.setdefault(part, {})[field] = array if np.ndim(x) else array.item()
        motion = self._table_symbols(MOTION, (1, 6, 6))
        motion[:, [not moving for moving in self._moves]] = 0.0
        parts["motion"]["coefficients"] = motion
        for name, which in (("gust", GUSTS), ("noise_r", NOISE_R), ("noise_v", NOISE_V)):
            rows, *shape = getattr(problem.disturbance, name).shape
            parts["disturbance"][name] = self._table_symbols(which, (4 if rows else 0, *shape))
        parts["disturbance"] |= {"gust_step": GUST, "noise_step": NOISE}
        return problem._replace(
            **{part: getattr(problem, part)._replace(**fields) for part, fields in parts.items()}
        )

    def _table_symbols(self, which: int, shape: tuple[int, ...]) -> Any:
        """Rows of a table at the moment."""
        made = [self.symbol("table", which, k) for k in range(math.prod(shape))]
        return np.array(made, dtype=object).reshape(shape)

    def _watched_forces(self, p: Problem, w: Any, order: Ints) -> list[Any]:
        n, m = len(p.vehicles.m), len(order)
        values = np.full(5 * n + 2 * m, 0.0, dtype=object)
        self._as_plain_python(gauge.write_watched_forces)(p, w, values)
        places = np.arange(len(values))
        places[3 * n : 3 * n + 2 * m] = np.concatenate([3 * n + order, 3 * n + m + order])
        return values[np.argsort(places)].tolist()


def _named_numbers(problem: Problem) -> Iterator[tuple[str, int, Any]]:
    """Name, place among `varying_numbers` and value of each number, and of each array of numbers."""
    index = 0
    values = (*_numbers_of(problem), *_arrays_of(problem))
    for name, x in zip((*_NUMBERS, *_ARRAYS), values, strict=True):
        yield name, index, x
        index += np.size(x)


def _nonzero_by_name(problem: Problem, values: Floats) -> dict[str, bool]:
    """Whether numbers that may be zero are not zero in all of eight problems."""
    return {
        name: bool(values[index : index + np.size(x)].any())
        for name, index, x in _named_numbers(problem)
        if name in _MAY_BE_ZERO
    }


def flight_code_structure(problem: Problem, values: Floats, moves: Sequence[bool]) -> bytes:
    """Everything that the code of a `FlightTrace` depends on.

    Raises
    ------
    UnfitError
        Some of the problems damp deformations, others do not, which is a branch of the law.
    """
    graph, law, disturbance = problem.graph, problem.law, problem.disturbance
    damps = values[_NUMBERS.index("law.k_def")].astype(bool)
    if damps.any() and not damps.all():
        raise UnfitError("problems that take different branches")
    there = [*_nonzero_by_name(problem, values).values(), *moves]
    kinds = law.solver, law.iterations, problem.reference.kind, problem.control.kind
    tables = [len(x) > 0 for x in (disturbance.gust, disturbance.noise_r, disturbance.noise_v)]
    pairs = graph.edges.tobytes(), graph.pairs.tobytes()
    flags = disturbance.active, bool(problem.vehicles.saturate)
    return repr(("flight", len(problem.vehicles.m), pairs, kinds, tables, flags, there)).encode()


class Code:
    """Straight-line code of a trace: its computations in order.

    Attributes
    ----------
    outputs : (n,) symbols or numbers
    gauge : (5N + 2m,) symbols or numbers, or none
    coordinates : number of coordinates of positions, whose derivatives, the first outputs, are velocities
    positive : symbols that have to be positive
    before : symbols that depend on the problem's numbers alone
    inputs : (U,) those of them that are needed in flight
    moment : symbols that depend on the time, but not on the state
    known : (T,) those of them, and sources, that lines for the state need
    lines : symbols computed for each state
    last : symbols for the gauge alone

    Lists of symbols to compute hold each of them after its arguments.
    """

    def __init__(self, trace: Trace) -> None:
        self.outputs, self.coordinates = trace.outputs, trace.coordinates
        self.gauge = trace.gauge
        self.positive = [x for x in trace.positive if x.known > UNIFORM]
        self._seen: set[int] = set()
        needed = self._collect_new_symbols([*self.positive, *self.outputs])
        last = self._collect_new_symbols(self.gauge)
        self.before = [x for x in needed + last if x.known == UNIFORM]
        self.moment = _operations_among(x for x in needed + last if UNIFORM < x.known < STATE)
        self.lines = _operations_among(x for x in needed if x.known == STATE)
        self.last = _operations_among(x for x in last if x.known == STATE)
        of_state = [x for line in self.lines + self.last for x in line.arguments]
        of_state += self.outputs + self.gauge + self.positive
        self.known = _distinct_symbols(of_state, range(FLIGHT, STATE))
        used = of_state + [x for line in self.moment for x in line.arguments]
        self.inputs = _distinct_symbols(used, range(UNIFORM, FLIGHT))

    def _collect_new_symbols(self, wanted: Sequence[Any]) -> list[Symbol]:
        """Everything new that symbols need, each after its arguments; without recursion, because chains are long."""
        symbols, stack = [], list(wanted[::-1])
        while stack:
            x = stack.pop()
            if not isinstance(x, Symbol) or x.serial in self._seen:
                continue
            missing = [
                a for a in x.arguments if isinstance(a, Symbol) and a.serial not in self._seen
            ]
            if missing:
                stack += [x, *missing]
                continue
            self._seen.add(x.serial)
            symbols.append(x)
        return symbols


def _operations_among(symbols: Iterable[Symbol]) -> list[Symbol]:
    """Those that are no sources, in the order in which the kernel computes them."""
    return sorted((x for x in symbols if x.operation not in INPUTS), key=lambda x: x.serial)


def _distinct_symbols(values: Iterable[Any], knowledge: range) -> list[Symbol]:
    """The different symbols among values of which so much is known."""
    symbols = (x for x in values if isinstance(x, Symbol) and x.known in knowledge)
    return list({x.serial: x for x in symbols}.values())


def code_structure(problem: Problem) -> tuple[bytes, Floats, Ints]:
    """Everything that straight-line code depends on: problems with equal structures share the code.

    Returns the structure; the distinct numbers of the problem, in the order of their first appearance;
    and for each number, in the order of `Trace`, the index of its distinct number.
    """
    numbers: list[Floats] = []
    others: list[Any] = [problem.has_frame, problem.body_formulation, problem.external]
    used = _drop_unused_parts(problem)
    for name in _PARTS:
        _separate_numbers(getattr(used, name), numbers, others)
    # By a dictionary: for some hundred numbers, sorting arrays takes several times as long.
    rank: dict[float, int] = {}
    which = [rank.setdefault(x, len(rank)) for x in np.concatenate(numbers).tolist()]
    kinds = [0 if x == 0.0 else 1 if x == 1.0 else 2 if x > 0.0 else 3 for x in rank]
    values, places = np.array(list(rank)), np.array(which, dtype=np.int64)
    return repr((others, which, kinds)).encode(), values, places


def elimination_order(edges: NDArray[np.integer]) -> Ints:
    """Order (m,) of edges (m, 2) in which to factor J M^-1 J^T: least degree first."""
    at: dict[int, set[int]] = {}
    for k, ends in enumerate(edges.tolist()):
        for agent in ends:
            at.setdefault(agent, set()).add(k)
    near = {k: set().union(*(at[i] for i in ends)) - {k} for k, ends in enumerate(edges.tolist())}
    order = []
    while near:
        k = min(near, key=lambda k: (len(near[k]), k))
        order.append(k)
        neighbours = near.pop(k)
        for l in neighbours:
            near[l] = (near[l] | neighbours) - {k, l}
    return np.array(order, dtype=np.int64)


def _reorder_edges(graph: Graph, order: Ints) -> Graph:
    pairs = np.sort(np.argsort(order)[graph.pairs.astype(np.int64)], axis=1)[:, ::-1]
    return graph._replace(edges=graph.edges[order], pairs=pairs, diagonal=graph.diagonal[order])


# Parts of a problem that open-loop flights with a distance reference use.
_PARTS = ("vehicles", "graph", "law", "reference", "control", "disturbance")


def _drop_unused_parts(problem: Problem) -> Problem:
    """The problem without the parts that such flights do not use, which the tracer could not handle."""
    none: Any = None
    slots = ("t0", "T_b", "d0", "p0", "dp", "turn", "knots", "ways")
    reference = problem.reference._replace(**dict.fromkeys(slots, none))
    fields = ("active", "inverse")
    disturbance = problem.disturbance
    disturbance = disturbance._replace(**{f: none for f in disturbance._fields if f not in fields})
    return problem._replace(
        reference=reference, disturbance=disturbance, motion=none, feedback=none
    )


def _separate_numbers(x: Any, numbers: list[Floats], others: list[Any]) -> None:
    """List the real numbers of a part, and separately everything else, including the shapes of arrays."""
    if isinstance(x, tuple):
        for field in x:
            _separate_numbers(field, numbers, others)
    elif isinstance(x, np.ndarray) and x.dtype == np.float64:
        numbers.append(x.ravel())
        others.append(x.shape)
    elif isinstance(x, float):
        numbers.append(np.array([x]))
    else:
        others.append(x.tolist() if isinstance(x, np.ndarray) else x)


def _equals_number(x: Any, number: float) -> bool:
    return not isinstance(x, Symbol) and x == number


def _has_symbol(*values: Any) -> bool:
    return any(isinstance(x, Symbol) for x in values)


__getattr__ = getattr_of_earlier_names(
    __name__,
    flight_structure="flight_code_structure",
    structure="code_structure",
    numbers="varying_numbers",
)
