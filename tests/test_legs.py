"""The leg of a phase: what is planned before a flight is what the flight follows, and is planned once."""

import json
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from sample_missions import REQUIRED_KEYS

import rigidfleet as rf
from rigidfleet.cli.app import main
from rigidfleet.math import attitude
from rigidfleet.mission import Mission
from rigidfleet.mission.kinds import KINDS
from rigidfleet.planning import legs, timing
from rigidfleet.planning.derivatives import slot_derivatives
from rigidfleet.planning.legs import Leg, leg_of
from rigidfleet.planning.preview import preview_phases
from rigidfleet.planning.reference import copy_with
from rigidfleet.planning.timing import complete_times, legs_up_to
from rigidfleet.preflight.losses import planned_answer_to_loss
from rigidfleet.result import Result

STANDING = np.array([[0.0, -2, 1], [0, 2, 1], [3, -2, 1], [3, 2, 1]])
FRAME = np.array([[0.5, -2, -1.5], [0.5, 2, -1.5], [-0.5, -2, 1.5], [-0.5, 2, 1.5]])
FLAT = np.array([[-1.5, -2, 0], [-1.5, 2, 0], [1.5, -2, 0], [1.5, 2, 0]])
SHAPES = {"frame": FRAME, "wide": 1.4 * FRAME, "flat": FLAT}


def planned_legs(mission: Mission, result: Result) -> list[Leg]:
    """The leg of each phase that was flown, as the check plans it.

    A phase that settles ends when it does, and agents that distances have led are where they have come to: these alone
    are taken from the flight.
    """
    mission = complete_times(mission)
    first = mission.first_loss if mission.on_loss != "continue" else np.inf
    found = [planned.leg for planned in preview_phases(mission)[0]]
    sure = True
    for k, record in enumerate(result.phases):
        if record.t_start >= first:
            # One that settles ends before its planned end, at which another leg is under way.
            begun = [
                copy_with(leg, end=flown.t_end)
                for leg, flown in zip(found[: k - 1], result.phases, strict=False)
            ]
            plan = legs_up_to(mission, len(mission.phases), [*begun, found[k - 1]])
            return [*found[:k], *planned_answer_to_loss(mission, found[k - 1], plan).legs]
        if not sure:
            at = int(np.searchsorted(result.time, record.t_start))
            before = found[k - 1].state_at(record.t_start)
            if found[k - 1].phase.control != "tracking":
                q, flown = result.frame[at], {"r": result.position[at], "v": result.velocity[at]}
                frame = attitude.dcm_from_quaternion(q) if np.isfinite(q).all() else None
                before = copy_with(before, frame=frame, **flown)
            found[k:] = [leg_of(mission, mission.phases[k], before)]
        phase = mission.phases[k]
        sure = sure and phase.settle is None and phase.control == "tracking"
    return found


def compare(mission: Mission) -> Counter[str]:
    """See that the legs lead the slots as the flight has recorded them; returns how often each kind was compared."""
    result, kinds = rf.simulate(mission), Counter[str]()
    assert not result.ending
    assert result.slot_position is not None
    found = planned_legs(mission, result)
    # From where avoidance acts on, the reference is not as planned.
    late = np.zeros(len(result.time), dtype=bool)
    if result.clock_rate is not None and result.body_displacement is not None:
        late = (result.clock_rate != 1.0) | result.body_displacement.any(axis=1)
        late = np.maximum.accumulate(late)
    for k, record in enumerate(result.phases):
        if record.control != "tracking":
            continue
        some = (result.phase == k) & ~late
        if not some.any():
            continue
        leg = found[k]
        assert (leg.phase.name, leg.formation) == (record.name, record.formation)
        r = slot_derivatives(leg.reference, leg.motion, result.time[some], 1)[:, 0]
        recorded = result.slot_position[some]
        flying = np.isfinite(recorded)
        assert flying.any()
        assert np.abs(r - recorded)[flying].max() < 1e-9, record.name
        kinds[record.kind] += 1
    return kinds


#: The large one takes long, the next is drawn as long, and the last ends early, as its constraint is singular.
OTHERS = "show-1000", "moving-obstacles", "line-singular"
SHIPPED = [name for name in rf.mission_names() if name not in OTHERS]


@pytest.mark.parametrize(
    "name", [*SHIPPED, pytest.param("moving-obstacles", marks=pytest.mark.long)]
)
def test_a_shipped_mission_follows_the_legs_that_its_check_plans(name):
    """Where slots are tracked, the planned reference is the recorded one to 1e-9 m at every sample.

    Where distances alone have led before, from the recorded state on: up to there, `check` foresees an estimate.
    """
    compare(rf.load_mission(name))


# -- missions drawn by a seed -----------------------------------------------------------------------------

#: Kinds that a drawn mission begins with, or has by a phase of another kind.
EVERYWHERE = ("establish", "takeoff")


class Draw:
    """A mission of four vehicles, drawn by a seed: phases of all kinds, times, transitions and losses."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.smooth = self.likely(0.7)
        self.body = not self.smooth and self.likely(0.2)
        self.place, self.shape = np.array([1.5, 0.0, 6.0]), "frame"
        self.formed = True  # whether vehicles are in the shape: each may have gone a way of its own
        self.phases: list[dict[str, Any]] = []
        if self.likely(0.4):
            self.add(kind="takeoff", height=6.0, **self.lasting(6.0))
        self.open = not self.smooth and self.likely(0.3)
        first: dict[str, Any] = {"kind": "establish", "formation": "frame"}
        if self.open:
            first["control"] = "open"
        ends: dict[str, Any] = {"blend": 6.0, "duration": 8.0}
        if self.likely(0.3):
            ends = {"blend": 6.0, "settle": {"tolerance": 0.01}}
        elif self.smooth and self.likely(0.5):
            ends = {"blend": "auto", "duration": "auto"}
        self.add(**first, **ends)
        if self.likely(0.3):
            self.add(kind="hold", settle={"tolerance": 0.01})
        self.fly()
        makers: list[Callable[[], None]] = [
            self.fly, self.turn, self.orbit, self.brake, self.reshape, self.hold, self.follow, self.go, self.land,
        ]  # fmt: skip
        makers += [
            partial(self.other, kind)
            for kind in KINDS
            if kind not in vars(Draw) and kind not in EVERYWHERE
        ]
        for make in self.rng.choice(np.array(makers, dtype=object), 4):
            make()

    def likely(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def add(self, **table: Any) -> None:
        self.phases.append(table)

    def lasting(self, time: float) -> dict[str, Any]:
        """A duration; automatic in some smooth missions."""
        return {"duration": "auto" if self.smooth and self.likely(0.5) else time}

    def rest(self) -> None:
        """Be at rest, for phases that begin so."""
        self.add(kind="brake", duration=5.0)
        self.fly(plain=True)

    def fly(self, plain: bool = False) -> None:
        before, self.place = self.place, self.rng.uniform([-6, -6, 6], [6, 6, 10]).round(2)
        table: dict[str, Any] = {"kind": "fly", "position": self.place.tolist()}
        if self.smooth and not plain and self.likely(0.4):
            point = 0.5 * (before + self.place) + [0.0, 0.0, 1.0]
            table["through"] = [{"position": point.tolist()}]
        if not plain and self.likely(0.3):
            table["velocity"] = "free" if self.smooth and self.likely(0.5) else [0.5, 0.2, 0.0]
        if not plain and self.likely(0.3):
            table["yaw_deg"] = 70.0
        if self.likely(0.3):
            table |= {"travel": 9.0, "duration": 10.0}
        else:
            table |= self.lasting(10.0)
        self.add(**table)

    def turn(self) -> None:
        self.add(kind="turn", yaw_deg=round(self.rng.uniform(-90, 90), 1), **self.lasting(6.0))

    def orbit(self) -> None:
        yaw = "along" if self.likely(0.5) else "fixed"
        self.add(
            kind="orbit",
            centre=[0, 0, 8],
            radius=5.0,
            rate_deg_s=10.0,
            duration=20.0,
            blend=9.0,
            yaw=yaw,
        )

    def brake(self) -> None:
        self.add(kind="brake", duration=5.0, **({"travel": 4.0} if self.likely(0.5) else {}))

    def hold(self) -> None:
        self.add(kind="hold", duration=3.0)

    def reshape(self) -> None:
        if self.body:  # by distances alone, it might flip
            return
        names = [name for name in SHAPES if name != self.shape]
        self.shape = str(self.rng.choice(names))
        table: dict[str, Any] = {"kind": "reshape", "formation": self.shape} | self.lasting(8.0)
        table["blend"] = "auto" if table["duration"] == "auto" else 7.0
        ways = ["straight", "layers", "auto"] + ["ways"] * (self.smooth and table["duration"] == "auto")  # fmt: skip
        if self.smooth and self.formed and self.likely(0.6):
            table["transition"] = str(self.rng.choice(ways))
        elif self.likely(0.3):
            table["alignment"] = "none"
        if self.smooth and "transition" not in table and self.likely(0.3):
            self.place = self.place + [0.5, 0.0, 0.5]
            table["position"] = self.place.tolist()
        self.add(**table)
        self.formed = True

    def follow(self) -> None:
        self.fly(plain=True)
        self.add(kind="turn", yaw_deg=0.0, duration=6.0)
        own, starts = SHAPES[self.shape], [self.place]
        if self.formed and self.likely(0.6):
            starts, self.formed = list(self.place + own - own.mean(axis=0)), False
        bend = self.rng.uniform(-0.05, 0.05, 3)
        degree = int(self.rng.spawn(1)[0].choice([0, 2, 3, 5, 7]))  # 0: it stays
        rows = []
        for start in starts:
            curve = np.zeros((4, degree + 1))
            curve[:3, -1] = bend / 8.0 ** (degree - 2)
            curve[:3, 0] = start
            rows.append([[8.0, *curve.ravel().tolist()]])
        self.add(kind="follow", trajectories=rows)
        self.rest()

    def other(self, kind: str) -> None:
        """A phase of a kind without a method of its own, from rest."""
        self.rest()
        ends = (
            self.lasting(9.0) if KINDS[kind].model_construct().has_least_time else {"duration": 9.0}
        )
        self.add(kind=kind, **REQUIRED_KEYS[kind], **ends)
        self.fly(plain=True)

    def go(self) -> None:
        if not self.formed or self.likely(0.7):
            return
        self.rest()
        self.fly(plain=True)
        self.phases[-1] |= {"kind": "go"}
        self.phases[-1].pop("travel", None)

    def land(self) -> None:
        self.rest()
        self.formed = False
        self.add(
            kind="land", **({"agents": [1, 2]} if self.likely(0.4) else {}), **self.lasting(30.0)
        )
        stagger = {"stagger": 3.0, "by": "vehicles"} if self.likely(0.4) else {}
        self.add(kind="takeoff", height=8.0, duration=12.0, **stagger)
        self.fly(plain=True)

    def mission(self, *, lossless: bool = False) -> Mission:
        data: dict[str, Any] = {
            "schema_version": 1, "name": "drawn", "output_step": 0.1,
            "agents": {"mass": 1.0, "radius": 0.2, "position": STANDING.tolist()},
            "formations": {name: {"slots": x.tolist()} for name, x in SHAPES.items()},
            "obstacles": [{"kind": "ground"}], "limits": {"speed": 5.0, "acceleration": 3.0},
            "phases": self.phases,
        }  # fmt: skip
        if self.smooth:
            data["smoothness"] = "jerk"
        elif self.body:
            data["architecture"] = "body"
        if self.likely(0.4) and not (self.body or self.open or lossless):
            lost = {
                "agent": int(self.rng.integers(1, 5)),
                "time": round(self.rng.uniform(10, 40), 2),
            }
            does = str(self.rng.choice(["hold", "land"]))
            data["disturbances"] = {"lost": [lost], "on_loss": does} | (
                {"hold_until": lost["time"] + 30.0}
                if does == "hold"
                else {"landing_formation": "flat"}
            )
        return Mission.from_dict(data)


@pytest.mark.parametrize("seed", range(4))
def test_a_drawn_mission_follows_the_legs_that_its_check_plans(seed):
    """The planned reference of a drawn mission is the recorded one to 1e-9 m at every sample of tracked slots."""
    assert compare(Draw(seed).mission())


def test_a_loss_after_a_phase_that_settles_early_follows_the_legs_planned_from_there():
    """A formation that has settled before its planned end slows down from where it is when an agent is lost."""
    draw = Draw(0)
    draw.smooth, draw.phases = True, [
        {"kind": "establish", "formation": "frame", "blend": 6.0, "settle": {"tolerance": 0.01}},
        {"kind": "fly", "position": [6, 1, 9], "duration": 10.0},
    ]  # fmt: skip
    lost = {"lost": [{"agent": 3, "time": 9.0}], "on_loss": "hold"}
    mission = Mission.from_dict(draw.mission(lossless=True).to_dict() | {"disturbances": lost})
    assert preview_phases(mission)[0][0].leg.end > 9.0
    assert compare(mission)["follow"] == 1  # along the plan, as the ground is in the way of a brake


@pytest.mark.long
def test_two_hundred_drawn_missions_follow_the_legs_that_their_checks_plan():
    """So it is in 200 drawn missions, which have phases of all kinds, automatic times, transitions and losses."""
    kinds: Counter[str] = Counter()
    missions = [Draw(seed).mission() for seed in range(200)]
    for mission in missions:
        kinds += compare(mission)
    # Four phases a mission are drawn: the more kinds there are, the rarer is each.
    assert min(kinds[kind] for kind, model in KINDS.items() if not model.replaced) > 550 / len(
        KINDS
    )
    written = Counter(p.kind for mission in missions for p in mission.phases)
    assert min(written.values()) > 10
    assert set(written) == set(KINDS)
    assert sum(bool(p.auto_keys) for mission in missions for p in mission.phases) > 100
    assert sum(not p.flown_as_written for mission in missions for p in mission.phases) > 20
    assert sum(mission.on_loss != "continue" for mission in missions) > 40


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(k, marks=pytest.mark.long) for k in range(6, 60))]
)
def test_a_drawn_mission_is_timed_once_and_checked_alike_by_all(seed, tmp_path, capsys):
    """Times that are known stay, and the command, `check` and the check of what it has checked say the same."""
    mission = Draw(seed).mission()
    timed = complete_times(mission)
    assert [phase.model_dump() for phase in complete_times(timed).phases] == [
        phase.model_dump() for phase in timed.phases
    ]
    once = rf.check(mission)
    again = rf.check(once.mission)
    assert [str(x) for x in once.remarks] == [str(x) for x in again.remarks]
    path = tmp_path / "drawn.toml"
    path.write_text(mission.text)
    assert main(["check", str(path), "--json"]) == (0 if once.passed else 1)
    assert json.loads(capsys.readouterr().out)["passed"] == once.passed


SHORT: dict[str, tuple[list[Any], Any]] = {
    "begins slowly": ([0.05], "auto"),
    "begins at rest": ([0.0, 0.1], "auto"),
    "stays": ([], "auto"),
    "stays for its time": ([], 5.0),
    "begins at a speed": ([0.1], 5.0),
}


@pytest.mark.parametrize("name", SHORT)
def test_short_trajectories_are_judged_alike_before_and_in_flight(name):
    """Of trajectories of few coefficients, check and flight say the same: they pass, or why they cannot be flown."""
    rates, duration = SHORT[name]
    curve = [
        5.0,
        1.5,
        *rates,
        0,
        *(0 for _ in rates),
        5,
        *(0 for _ in rates),
        0,
        *(0 for _ in rates),
    ]
    phases = [
        {"kind": "establish", "formation": "pair", "duration": 5.0},
        {"kind": "follow", "trajectories": [[curve]], "duration": duration},
        {"kind": "fly", "position": [4, 0, 5], "duration": "auto"},
    ]
    mission = Mission.from_dict(
        {
            "schema_version": 1, "name": "short", "smoothness": "jerk", "limits": {"speed": 3.0, "acceleration": 2.0},
            "agents": {"mass": 1.0, "radius": 0.2, "position": [[0, 0, 5], [3, 0, 5]]},
            "formations": {"pair": {"slots": [[0, 0, 0], [3, 0, 0]]}}, "phases": phases,
        }
    )  # fmt: skip
    says = []
    for judge in (lambda: rf.check(mission), lambda: rf.assess(rf.simulate(mission))):
        try:
            says.append(str(judge().passed))
        except rf.MissionError as error:
            says.append(str(error))
    assert says[0] == says[1]


#: Agent 1 is lost on its way down, while the centre of mass would have to be led after it.
LANDS_ALONE = {
    "schema_version": 1, "name": "alone", "smoothness": "jerk", "obstacles": [{"kind": "ground"}],
    "agents": {"mass": 1.0, "radius": 0.2, "position": [[0, 0, 5], [3, 0, 5]]},
    "formations": {"pair": {"slots": [[0, 0, 0], [3, 0, 0]]}},
    "limits": {"speed": 3.0, "acceleration": 2.0, "separation": 0.3},
    "phases": [
        {"kind": "establish", "formation": "pair", "duration": 5.0},
        {"kind": "land", "agents": [1], "duration": "auto"},
        {"kind": "fly", "position": [8, 0, 6], "duration": "auto"},
    ],
    "disturbances": {"lost": [{"agent": 1, "time": 6.0}], "on_loss": "land", "landing_formation": "pair"},
}  # fmt: skip


def test_what_a_loss_keeps_from_being_flown_does_not_fail_a_check():
    """Of vehicles that are lost no limit is asked, and of phases that are abandoned there are notes."""
    mission = Mission.from_dict(LANDS_ALONE)
    assert rf.check(mission).passed
    for seed in (3027, 3067, 3081, 3096, 3117):
        mission = Draw(seed).mission()
        ahead = rf.check(mission)
        verdict = rf.assess(rf.simulate(mission))
        assert ahead.passed == verdict.passed, (seed, ahead.remarks, verdict.summary)


# -- once a phase -----------------------------------------------------------------------------------------


def calls(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Counts, from now on, of the calls that make what a phase departs from."""
    count: Counter[str] = Counter()
    places = (
        (legs, "depart"),
        (legs, "_attach_frame"),
        (legs, "shift_and_rotvec"),
        (timing, "depart"),
    )
    for module, name in places:
        function = getattr(module, name)

        def counted(*arguments: Any, _function: Any = function, _name: str = name) -> Any:
            count[_name] += 1
            return _function(*arguments)

        monkeypatch.setattr(module, name, counted)
    return count


#: Phases of which three change the shape, and three have automatic times.
ONCE: list[dict[str, Any]] = [
    {"kind": "establish", "formation": "frame", "duration": "auto", "blend": "auto"},
    {"kind": "fly", "position": [4, 2, 8], "through": [{"position": [3, 0, 7]}], "duration": "auto"},
    {"kind": "reshape", "formation": "wide", "duration": 8.0},
    {"kind": "orbit", "centre": [0, 0, 8], "radius": 5.0, "rate_deg_s": 10.0, "duration": 20.0, "blend": "auto"},
    {"kind": "brake", "duration": 5.0},
    {"kind": "reshape", "formation": "frame", "duration": 8.0},
]  # fmt: skip


def test_a_phase_departs_once(monkeypatch):
    """A preview, a flight and a search of automatic times each attach the frame and align the slots once a phase.

    So does a check, which judges the legs that the times follow from; it compares two other assignments beside.

    Up to the last automatic time there are four phases, of which two change the shape. Before legs were made once, the
    search attached the frame 20 times for them, and aligned slots 6 times; a preview and a flight did so once a phase,
    each by code of its own.
    """
    draw = Draw(0)
    draw.smooth, draw.phases = True, ONCE
    written = draw.mission(lossless=True)
    once = Counter({"depart": 6, "_attach_frame": 6, "shift_and_rotvec": 3})
    count = calls(monkeypatch)
    mission = complete_times(written)
    # Up to the last automatic time.
    assert count == {"depart": 4, "_attach_frame": 4, "shift_and_rotvec": 2}
    count.clear()
    preview_phases(mission)
    assert count == once
    count.clear()
    rf.simulate(mission)
    assert count == once
    count.clear()
    rf.check(written)
    compared = {"depart": 2, "_attach_frame": 2, "shift_and_rotvec": 2}  # other assignments
    assert count == once + Counter(compared)


@pytest.mark.parametrize("name", ["hill-search", "narrow-passage-found", "change-of-picture"])
def test_a_check_departs_once_a_phase_with_transitions_and_ways(monkeypatch, capsys, name):
    """The legs that transitions, ways and times are planned by are those that the command judges.

    Each of the two other assignments that a check compares takes the first formation once more, if it is compared.
    """
    mission = complete_times(rf.load_mission(name))
    others = rf.check(name).assignments.keys() - {"as it is", mission.assignment}
    count = calls(monkeypatch)
    main(["check", name, "--json"])
    assert count["depart"] == len(mission.phases) + len(others)


def test_ways_of_agents_depart_once_a_phase(monkeypatch):
    """Bent ways, and those to the own places, which ask for the state before them, take it from the legs so far."""
    draw = Draw(0)
    draw.smooth, draw.phases = True, [
        {"kind": "takeoff", "height": 6.0, "duration": "auto"},
        {"kind": "establish", "formation": "frame", "duration": "auto", "blend": "auto"},
        {"kind": "reshape", "formation": "wide", "transition": "ways", "duration": "auto"},
        {"kind": "land", "places": "own", "duration": "auto"},
    ]  # fmt: skip
    data = draw.mission(lossless=True).to_dict()
    data["agents"]["position"] = (STANDING - [0.0, 0.0, 0.75]).tolist()
    count = calls(monkeypatch)
    mission = rf.check(Mission.from_dict(data)).mission
    assert len(mission.phases) > 4
    assert count["depart"] == len(mission.phases) + 2
