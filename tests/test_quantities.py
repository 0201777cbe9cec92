"""A quantity with its limit is one entry: whoever reads limits finds each one that a flight fails by."""

import json
import math
import re
import sqlite3
from contextlib import closing
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from sample_missions import three_points, three_quadrotors

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet._common.quantities import MOTIONS, QUANTITIES
from rigidfleet.assessment import Verdict, safety
from rigidfleet.assessment.checks import _quantity_check
from rigidfleet.assessment.measure import Measurements
from rigidfleet.cli import app as cli
from rigidfleet.errors import RigidfleetError
from rigidfleet.mission import json_schema
from rigidfleet.mission.schema import Limits
from rigidfleet.preflight.findings import Preflight
from rigidfleet.reporting import overlay, report_page
from rigidfleet.result import Result
from rigidfleet.simulation.flight import simulate
from rigidfleet.sweep import METRICS, Sweep, read
from rigidfleet.sweep.metrics import measure_metrics
from rigidfleet.sweep.record import RunRecord
from rigidfleet.sweep.store import FILE, Store

FLY = {"kind": "fly", "position": [8.0, 4.0, 9.0], "duration": 4.0}
POINTS = three_points({"blend": 3.0, "until": 3.5}, FLY)
ROTORS = three_quadrotors(FLY | {"duration": 3.0})
STACKED = {"radius": 0.25, "position": [[0, 0, 5], [0.1, 0, 8], [2, 3, 5]]}
BLOWN = {"wind": [3.0, 0, 0], "drag": 0.1}
UNEQUAL = {"wind": [1.5, 0, 0], "drag": [0.2, 0.0, 0.1]}
#: Of each limit: the quantity that fails a flight by it, the flight's mission, what a check is about, and in which
#: figure the limit is seen.
BROKEN: dict[str, tuple[str, dict[str, Any], str, str]] = {
    **{
        q.name: (q.name, POINTS | {"limits": {q.name: 0.2}}, q.name_in_words, "motion") for q in MOTIONS
    },
    "tilt_deg": ("tilt", ROTORS | {"limits": {"tilt_deg": 2.0}}, "tilt", "vehicles"),
    "separation": ("separation", POINTS | {"limits": {"separation": 5.0}}, "collision", "clearance"),
    "separation_altitude": (
        "separation_flying", POINTS | {"limits": {"separation": 5.0, "separation_altitude": 1.0}}, "collision",
        "clearance",
    ),
    "separation_allowance": (
        "separation_as_planned", POINTS | {"limits": {"separation_allowance": 0.0}, "disturbances": UNEQUAL},
        "collision", "clearance",
    ),
    "separation_below": (
        "separation_below", POINTS | {"limits": {"separation_below": 4.0}, "agents": POINTS["agents"] | STACKED},
        "downwash", "clearance",
    ),
    "geofence": (
        "geofence", POINTS | {"limits": {"geofence": {"min": [-1, -1, 0], "max": [5, 5, 7]}}}, "geofence",
        "operation",
    ),
    "people": (
        "people", POINTS | {"limits": {"people": 9.0}, "people": [{"polygon": [[14, 0], [18, 0], [18, 4]]}]}, "people",
        "clearance",
    ),
    "saturation": (
        "saturation",
        three_quadrotors(FLY | {"duration": 1.2}) | {"limits": {"saturation": 0.0}}, "rotors", "vehicles",
    ),
    "tracking_error": (
        "tracking_error", POINTS | {"limits": {"tracking_error": 0.01}, "disturbances": BLOWN}, "tracking error",
        "disturbance",
    ),
    "thrust_limit": (
        "thrust", POINTS | {"agents": POINTS["agents"] | {"thrust_limit": 10.5}}, "thrust", "inputs",
    ),
}  # fmt: skip


#: Keys of limits that nobody can judge by positions over time.
NOT_OF_CURVES = {
    "jerk", "horizontal_jerk", "vertical_jerk", "tilt_deg", "separation_allowance", "people", "saturation",
    "tracking_error",
}  # fmt: skip
#: Keys that `assess` has as an option of its own, or that are no numbers.
OTHERWISE = {"separation", "separation_altitude", "geofence"}


@cache
def flown(key: str) -> tuple[Result, Verdict, Preflight]:
    """A flight that fails by a limit, judged, and its mission, checked."""
    mission = rf.Mission.from_dict(BROKEN[key][1])
    result = simulate(mission)
    return result, rf.assess(result), rf.check(mission)


def curves(limits: dict[str, Any], *, cubic: bool = True) -> Result:
    """Three curves that others made, one below another, which no limit of `BROKEN` allows."""
    t = np.linspace(0.0, 10.0, 101)
    x = np.stack([4.0 * np.sin(t), 3.0 * np.cos(t), 5.0 + 3.0 * np.sin(2.0 * t)], axis=1)
    starts = np.array(STACKED["position"])
    return rf.trajectories(t, x[:, None] + starts, cubic=cubic, radius=0.25, limits=limits)


def limits_in_help_of_assess(capsys: pytest.CaptureFixture[str]) -> set[str]:
    """The keys of limits that `rigidfleet assess --help` offers."""
    cli.main(["assess", "--help"])
    words = " ".join(re.findall(r"[\w.,:=]+", capsys.readouterr().out))
    (offered,) = re.findall(r"KEY=VALUE, may be repeated: ([\w, ]+)\.", words)
    return set(offered.split(", "))


def test_every_limit_is_one_of_a_quantity():
    """Each key of [limits] is that of an entry, or says where another one holds; each entry's key exists."""
    keys = {
        q.key.removeprefix("limits.") for q in QUANTITIES.values() if q.key.startswith("limits")
    }
    assert keys | {"separation_altitude"} == set(Limits.model_fields)
    assert set(BROKEN) == set(Limits.model_fields) | {"thrust_limit"}
    assert {q.key for q in QUANTITIES.values()} - {f"limits.{key}" for key in keys} == {
        "",
        "agents.thrust_limit",
    }


@pytest.mark.parametrize("key", BROKEN)
def test_a_limit_that_a_flight_fails_by_is_in_all_readers(key, capsys):
    """Verdict, check, sweep, safety page and help have it, with a value beyond it."""
    name, _, topic, _ = BROKEN[key]
    result, verdict, before = flown(key)
    q = QUANTITIES[name]
    check = max((c for c in verdict.checks if c.check == name), key=lambda c: q.rank(c.worst))
    assert not check.passed
    assert check.worst is not None
    assert check.limit is not None
    assert check.worst < check.limit if q.at_least else check.worst > check.limit
    assert any(remark.topic == topic and remark.level == "fails" for remark in before.remarks), (
        before.remarks
    )
    factor = 0.01 if q.unit == "%" else 1.0
    assert measure_metrics(result, verdict)[name] == pytest.approx(factor * check.worst)
    assert METRICS[name].text == q.text
    (row,) = [row for row in safety(result, verdict) if row.quantity == q.name_in_words]
    assert not row.passed
    assert row.margin == pytest.approx(-abs(check.worst - check.limit))
    words = json_schema()["$defs"]["Limits"]["properties"]
    assert key == "thrust_limit" or words[key]["description"]
    offered = Limits.model_fields.keys() - NOT_OF_CURVES - OTHERWISE
    assert (key in limits_in_help_of_assess(capsys)) == (key in offered)


@pytest.mark.parametrize("key", [key for key in BROKEN if QUANTITIES[BROKEN[key][0]].order])
def test_a_check_lists_the_planned_motion_with_its_limit(key):
    """Console, notebook and JSON have each motion that is limited: planned, beyond its limit, as it is flown."""
    name = BROKEN[key][0]
    _, verdict, before = flown(key)
    q = QUANTITIES[name]
    (check,) = [c for c in verdict.checks if c.check == name]
    entry = json.loads(json.dumps(before.data()))["paths"][name]
    ((_, worst), *_, (unit, limit)) = entry.items()
    in_keys = {"m/s": "m_s", "m/s^2": "m_s2", "m/s^3": "m_s3", "deg": "deg", "N": "n"}
    assert unit == f"limit_{in_keys[q.unit]}"
    assert limit == check.limit < worst
    assert worst == pytest.approx(check.worst, rel=0.1)  # as it is flown, but for errors of control
    (row,) = [words for heading, words in before.describe() if heading == q.name_in_words]
    shown = q.unit.replace("^2", "²").replace("^3", "³")
    assert f"limit <= {limit:g} {shown}," in row
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", before._repr_html_())
    k = cells.index(q.name_in_words)
    assert cells[k + 2] == f"&lt;= {limit:g} {shown}"


def test_a_check_lists_the_separation_with_its_limit():
    """In JSON, too."""
    assert flown("separation")[2].data()["paths"]["separation"]["limit_m"] == 5.0


@pytest.mark.parametrize("cubic", [True, False])
@pytest.mark.parametrize("key", Limits.model_fields)
def test_a_limit_of_curves_is_judged_or_refused(key, cubic):
    """Each limit fails a curve that breaks it, or is refused with the reason; none is passed by silently."""
    limits = BROKEN[key][1]["limits"]
    if key in NOT_OF_CURVES:
        with pytest.raises(RigidfleetError, match=key):
            curves(limits, cubic=cubic)
        return
    verdict = rf.assess(curves(limits, cubic=cubic))
    (check,) = [c for c in verdict.checks if c.check == BROKEN[key][0]]
    assert not check.passed
    assert not verdict.passed
    assert check.judged


def test_a_quantity_of_curves_that_nobody_measures_does_not_pass():
    """A limit that was let through without anything that measures it fails, and says why."""
    q = replace(QUANTITIES["constraint_force"], key="limits.speed")
    (check,) = _quantity_check(Measurements(curves({"speed": 99.0})), q)
    assert not check.passed
    assert "positions over time do not show it" in check.message


@pytest.mark.parametrize("key", ["speed", "thrust_limit", "tracking_error", "separation"])
def test_figures_of_several_flights_have_the_limits(key):
    """Where flights lie over each other, each limit that one of them has is drawn, once."""
    result, verdict, _ = flown(key)
    (check,) = [c for c in verdict.checks if c.check == BROKEN[key][0]]
    picture = overlay.svg_of_time_curves([result, result], ["one", "two"]).decode()
    assert picture.count(f"limit {check.limit:g} {check.unit}") == 1


@pytest.mark.long
@pytest.mark.parametrize("key", BROKEN)
def test_a_limit_that_a_flight_fails_by_is_on_page_and_figure(key):
    """The report has the failed check and the row of the safety page, and a figure the limit's line."""
    name, _, _, figure = BROKEN[key]
    result, verdict, _ = flown(key)
    q = QUANTITIES[name]
    page = report_page(result)
    check = max((c for c in verdict.checks if c.check == name), key=lambda c: q.rank(c.worst))
    rows = re.findall(rf'<tr class="fails"><td class="words">{q.name_in_words}\b', page)
    assert len(rows) >= 2  # of the safety page and of all checks
    (picture,) = plotting.plot(result, names=[figure])
    drawn = " ".join(text.get_text() for text in picture.findobj(Text))
    unit = q.unit.replace("^2", "²").replace("^3", "³")
    words = {
        "geofence": "geofence 7 m",
        "separation_flying": "limit 5 m from z = 1 m on",
        "separation_as_planned": "as planned, less 0 m",
        "thrust": "limit 10.5 N",
        "saturation": "limit 0 % of a phase",
    }
    assert words.get(name, f"limit {check.limit:g} {unit}") in drawn.replace(
        "\N{NO-BREAK SPACE}", " "
    )


def test_jerk_is_that_of_the_slots():
    """By direction, too, the jerk that is judged is the greatest of the third derivative of what is tracked."""
    result, verdict, _ = flown("jerk")
    jerk = np.asarray(result.slot_jerk)
    (check,) = [c for c in verdict.checks if c.check == "jerk"]
    assert check.worst == pytest.approx(np.linalg.norm(jerk, axis=2).max(), rel=1e-12)
    assert check.at_samples
    for key, size in (
        ("horizontal_jerk", np.hypot(jerk[..., 0], jerk[..., 1])),
        ("vertical_jerk", np.abs(jerk[..., 2])),
    ):
        (check,) = [c for c in flown(key)[1].checks if c.check == key]
        assert check.worst == pytest.approx(size.max(), rel=1e-12)


def test_automatic_times_keep_jerks_by_direction():
    """Up and down, the third derivative of the slots then reaches its limit and no more; over the ground, it may."""
    phases = [POINTS["phases"][0] | {"blend": 9.0, "until": 10.0}, FLY | {"duration": "auto"}]
    limits = {"vertical_jerk": 0.5, "speed": 9.0}
    mission = rf.Mission.from_dict(POINTS | {"phases": phases, "limits": limits})
    result = simulate(mission)
    rows = result.samples(1)
    jerk = np.abs(np.asarray(result.slot_jerk)[rows])
    assert jerk[..., 2].max() == pytest.approx(0.5, rel=0.03)
    assert jerk[..., 2].max() <= 0.5
    assert jerk[..., 0].max() > 0.5
    assert rf.assess(result).passed


def test_the_tilt_of_points_is_that_of_the_thrust_that_slots_need():
    """Points fail by limits.tilt_deg as check says: the angle of slot's acceleration plus gravity from the vertical."""
    mission = rf.Mission.from_dict(POINTS | {"limits": {"tilt_deg": 2.0}})
    result = simulate(mission)
    (check,) = [c for c in rf.assess(result).checks if c.check == "tilt"]
    force = np.asarray(result.slot_acceleration) + [0.0, 0.0, 9.81]
    angle = np.degrees(np.arctan2(np.hypot(force[..., 0], force[..., 1]), force[..., 2]))
    assert check.worst == pytest.approx(np.nanmax(angle), rel=1e-9)
    assert not check.passed
    before = rf.check(mission)
    assert not before.passed
    assert before.worst["tilt"][0] == pytest.approx(np.nanmax(angle), rel=1e-3)


def test_a_collision_with_a_lost_vehicle_is_judged_without_its_first_contact():
    """A record of an earlier version names no first contact: the first sample at which they touch counts."""
    agents = {"mass": 1.0, "radius": 0.25, "position": [[0, 0, 5], [0.1, 0, 2]]}
    mission = rf.Mission.from_dict(
        {
            "schema_version": 1, "name": "falls", "agents": agents,
            "disturbances": {"lost": [{"agent": 1, "time": 0.2}]},
            "phases": [{"kind": "hold", "control": "open", "until": 1.5}],
        }
    )  # fmt: skip
    result = simulate(mission)
    for phase in result.phases:
        phase.extremes.pop("lost_first", None)
    (check,) = [c for c in rf.assess(result).checks if c.check == "lost"]
    assert not check.passed
    apart = np.linalg.norm(np.diff(result.position, axis=1)[:, 0], axis=1) - 0.5
    assert check.first is not None
    assert check.first.when == result.time[np.argmax(apart <= 0.0)]


def test_metrics_of_a_calm_flight_are_those_of_its_checks():
    """What has no limit is a metric, too: the greatest speed of a flight is the one of its samples, or more."""
    result = simulate(rf.Mission.from_dict(POINTS))
    values = measure_metrics(result, rf.assess(result))
    assert values["speed"] >= np.linalg.norm(result.velocity, axis=2).max()
    assert math.isnan(values["jerk"])
    assert set(values) == set(METRICS)


def test_a_store_of_an_earlier_version_is_read_and_goes_on(tmp_path):
    """A metric that it lacks is not known of its runs; more runs have it, and keep what was there."""
    sweep = Sweep.of(rf.Mission.from_dict(POINTS), ["agents.radius.* *= uniform(0.1, 1)"], runs=2)
    codes = [
        tuple(c.variation.encode(v) for c, v in zip(sweep.columns, sweep.values(k), strict=True))
        for k in (0, 1)
    ]
    rows = [
        RunRecord(k, True, "", "", codes[k], {name: float(k + 1) for name in METRICS}, 0.1)
        for k in (0, 1)
    ]
    with Store(tmp_path, sweep, "", replace=False) as store:
        store.add_records(rows[:1])
    with closing(sqlite3.connect(tmp_path / FILE)) as db:
        db.execute("ALTER TABLE runs DROP COLUMN vertical_jerk")
    table = read(tmp_path)
    assert np.isnan(table.metrics["vertical_jerk"]).tolist() == [True]
    assert table.metrics["speed"].tolist() == [1.0]
    with Store(tmp_path, sweep, "", replace=False) as store:
        store.add_records(rows[1:])
    table = read(tmp_path)
    np.testing.assert_array_equal(table.metrics["vertical_jerk"], [np.nan, 2.0])
    assert table.metrics["steps"].tolist() == [1.0, 2.0]


def test_the_safety_table_measures_no_distances_again(monkeypatch):
    """What the verdict has measured between vehicles is not measured a second time for the table."""
    flight = rf.simulate("narrow-passage")
    verdict = rf.assess(flight)
    rows = {row.quantity: row for row in safety(flight, verdict)}
    monkeypatch.setattr("rigidfleet.math.proximity.closeness", None)
    again = {row.quantity: row for row in safety(flight, verdict)}
    assert again == rows
    z = flight.position[..., 2]
    assert rows["lowest"].worst is not None
    assert rows["lowest"].worst.value == pytest.approx(z.min(), abs=1e-4)
    assert rows["lowest"].worst.value <= z.min()
    assert verdict.by_name["clearance"].limit == rows["clearance"].limit == 0.0
