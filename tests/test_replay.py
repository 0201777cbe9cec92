"""The page of a flight, as far as it can be judged without a browser (see tests/browser)."""

import base64
import json
import posixpath
import re
import zlib
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from sample_flights import CROWD, TENT, drifting, fenced, quadrotors, swarm
from test_doubt import logged

from rigidfleet.errors import ResultError
from rigidfleet.mission import Mission, load_mission
from rigidfleet.plotting import agent_colours, figure_names
from rigidfleet.simulation.as_logged import Doubts, judge_log
from rigidfleet.simulation.flight import simulate
from rigidfleet.web.replay import replay, replay_page
from rigidfleet.web.replay.pack import PackedColumn, pack_columns
from rigidfleet.web.replay.page import asset_text, bundle_module
from rigidfleet.web.replay.scene import thrust_directions

EIGHT = swarm(8, 90.0)


def parts(page: str) -> tuple[dict, dict[str, np.ndarray]]:
    """What a page tells of its flight, and its columns."""
    found = re.search(
        r'id="info">(.*?)</script>\s*<script type="text/plain" id="data">(.*?)</script>', page, re.S
    )
    assert found
    info = json.loads(found[1])
    return info, unpacked(info["columns"], found[2], info["count"])


def unpacked(described: list[dict], text: str, count: int) -> dict[str, np.ndarray]:
    """What `unpack` of the page makes of packed columns."""
    data = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    columns, start = {}, 0
    for column in described:
        n = count * column["width"]
        planes = data[start : start + 4 * n].reshape(4, n)
        twice = np.ascontiguousarray(planes.T).view("<i4").reshape(column["width"], count)
        whole = np.cumsum(np.cumsum(twice, axis=1, dtype=np.int32), axis=1, dtype=np.int32)
        values = np.where(whole == -(2**31), np.nan, whole * column["step"])
        columns[column["name"]] = values.T
        start += 4 * n
    assert start == len(data)
    return columns


# -- packing


def test_packed_values_return():
    """Packed values come back to half a step, NaN as NaN, and what is too large as large."""
    rng = np.random.default_rng(0)
    values = rng.normal(scale=50.0, size=(40, 3, 2))
    values[10:20, 1] = np.nan
    values[5, 0, 0] = np.inf
    described, text = pack_columns(
        {"a": PackedColumn(values, 0.01), "b": PackedColumn(values[:, 0, 1], 0.5)}
    )
    assert [(c["name"], c["width"]) for c in described] == [("a", 6), ("b", 1)]
    found = unpacked(described, text, 40)
    a = found["a"].reshape(values.shape)
    assert a[5, 0, 0] == pytest.approx(0.01 * (2**31 - 1))
    a[5, 0, 0] = np.inf
    np.testing.assert_allclose(a, values, atol=0.005 + 1e-9)
    np.testing.assert_allclose(found["b"][:, 0], values[:, 0, 1], atol=0.25)


# -- what the page holds


def test_alone():
    """Nothing in the page comes from elsewhere, and its policy allows nothing else."""
    page = replay_page(EIGHT)
    assert re.findall(r"https?://|//cdn|@import|\bsrc\s*=|\bimport\s*\(", page) == []
    assert "content=\"default-src 'none';" in page
    assert not re.search(r"\{\{ *(policy|title|style|info|data|script)\b", page)


@pytest.mark.parametrize("start", ["replay/replay.js", "live/live.js"])
def test_modules_become_one(start):
    """Each module stands once, after those that it imports, and none asks for another any more."""
    text = bundle_module(start)
    assert re.findall(r"^(?:import|export)\b.*", text, re.M) == []
    places = [text.index(line) for line in ("class Renderer", "class Scene", "class Player {")]
    assert places == sorted(places)
    assert text.count("class Recording") == 1


def test_modules_import_what_there_is():
    """What a module imports is exported by the other one, and used."""
    imports = 0
    for name in (
        "replay/recording.js",
        "replay/scene.js",
        "replay/player.js",
        "replay/replay.js",
        "live/live.js",
    ):
        text = asset_text(name)
        for names, target in re.findall(r'^import \{([^}]*)\} from "([^"]*)";$', text, re.M):
            other = asset_text(posixpath.normpath(f"{name}/../{target}"))
            for word in re.findall(r"\w+", names):
                imports += 1
                assert re.search(rf"^export .*\b{word}\b", other, re.M), f"{target} has no {word}"
                assert len(re.findall(rf"\b{word}\b", text)) > 1, f"{name} does not use {word}"
    assert imports > 20


def test_users_words_stay_words():
    """A name that looks like mark-up does not end the script it stands in."""
    page = replay_page(EIGHT)
    assert page.count("</script>") == 3
    assert parts(page)[0]["phases"][1]["name"] == '<round> & "round"</script>'


def test_same_flight_same_page():
    """The same flight makes the same page, byte for byte."""
    assert replay_page(EIGHT) == replay_page(swarm(8, 90.0))


@pytest.mark.parametrize(("n", "seconds", "megabytes"), [(8, 90.0, 0.3), (200, 60.0, 1.5)])
def test_small(n, seconds, megabytes):
    """90 s of eight vehicles take less than 0.3 MB, 60 s of 200 less than 1.5 MB."""
    assert len(replay_page(swarm(n, seconds))) < megabytes * 1e6


def test_colours_of_the_figures():
    """Vehicles have the colours of the figures."""
    assert parts(replay_page(EIGHT))[0]["colours"] == agent_colours(8)


def test_columns_are_the_flight():
    """Position, slot, attitude and tension at the page's even times are those of the result."""
    info, columns = parts(replay_page(EIGHT))
    t = info["start"] + info["step"] * np.arange(info["count"])
    assert t[0] == EIGHT.time[0]
    assert t[-1] == pytest.approx(EIGHT.time[-1])

    def at(values):
        flat = values.reshape(len(values), -1)
        return np.stack([np.interp(t, EIGHT.time, column) for column in flat.T], axis=1)

    position = at(EIGHT.position)
    np.testing.assert_allclose(columns["position"], position, atol=1e-3)
    np.testing.assert_allclose(
        columns["position"] + columns["slot"], at(EIGHT.slot_position), atol=1e-3
    )
    np.testing.assert_allclose(columns["attitude"], at(EIGHT.attitude), atol=1e-4)
    np.testing.assert_allclose(
        columns["tension"], -at(EIGHT.multiplier), atol=info["tension"] / 999
    )
    np.testing.assert_allclose(columns["thrust plot"], at(EIGHT.thrust), atol=1e-3)
    np.testing.assert_allclose(columns["separation plot"], at(EIGHT.separation[:, None]), atol=1e-3)
    error = np.abs(EIGHT.constraint).max(axis=1, keepdims=True)
    np.testing.assert_allclose(columns["error plot"], at(error), atol=2e-6)


def test_columns_of_quadrotors():
    """Vehicles have their own attitude, without jumps of sign, and each rotor its share of the limit."""
    result = quadrotors(3, 40.0)
    info, columns = parts(replay_page(result))
    assert info["rotors"] == [True] * 3
    assert "thrust" not in columns
    q = columns["turn"].reshape(-1, 3, 4)
    assert (np.abs(np.diff(q, axis=0)) < 0.01).all()
    k = np.searchsorted(result.time, info["start"] + info["step"] * np.arange(info["count"]) - 1e-9)
    assert result.vehicle_attitude is not None
    same = np.abs(np.sum(q * result.vehicle_attitude[k], axis=2))
    np.testing.assert_allclose(same, 1.0, atol=5e-3)
    shares = columns["rotors"].reshape(-1, 3, 4)[300]
    np.testing.assert_allclose(shares, [[0.5] * 4, [0.5, 1.0, 0.5, 0.5], [0.5] * 4], atol=0.005)
    assert columns["saturated"][300].tolist() == [0.0, 1.0, 0.0]
    assert [p["title"] for p in info["plots"]][:2] == ["Rotors, share of limit", "Tracking error"]
    np.testing.assert_allclose(columns["rotor plot"][300], [50.0, 100.0, 50.0], atol=0.05)


def test_points_among_quadrotors_lean_into_their_thrust():
    """In a mixed fleet points keep the picture of points; all others turn as they flew."""
    result = quadrotors(3, 10.0)
    data = result.mission.to_dict()
    data["vehicles"]["point"] = {"model": "point", "mass": 1.0}
    data["agents"]["vehicle"] = ["quadrotor", "point", "quadrotor"]
    info, columns = parts(replay_page(replace(result, mission_text=Mission.from_dict(data).text)))
    assert info["rotors"] == [True, False, True]
    assert {"turn", "thrust"} <= set(columns)
    assert columns["rotors"].reshape(-1, 3, 4)[50, 1].tolist() == [0.0] * 4
    assert np.isnan(columns["rotor plot"][:, 1]).all()


def test_jumps_stay_where_they_are():
    """A slot that jumps at a switch of phases is the old one before it, and the new one from there on."""
    result = swarm(4, 10.0)
    second = result.phase == 1
    result.slot_position[second] += [0.0, 0.0, 2.0]
    result.slot_position[~second, 0] = np.nan
    info, columns = parts(replay_page(result))
    t = info["start"] + info["step"] * np.arange(info["count"])
    rise = (columns["position"] + columns["slot"]).reshape(-1, 4, 3)[:, 1, 2] - 12.0
    np.testing.assert_allclose(rise[t < 5.0 - 1e-9], 0.0, atol=2e-3)
    np.testing.assert_allclose(rise[t > 5.0 + 1e-9], 2.0, atol=2e-3)
    missing = np.isnan(columns["slot"][:, 0])
    assert missing[t < 5.0 - 1e-9].all()
    assert not missing[t > 5.0 + 1e-9].any()


def test_samples_no_denser_than_seen():
    """A result of 1000 samples a second is thinned to 30; a sparse one stays as sparse."""
    dense = swarm(2, 4.0)
    fine = np.linspace(0, 4.0, 4001)
    resampled = {}
    for name in vars(dense):
        value = getattr(dense, name)
        if isinstance(value, np.ndarray) and len(value) == len(dense.time):
            resampled[name] = value[np.searchsorted(dense.time, fine).clip(0, len(dense.time) - 1)]
    resampled["time"] = fine
    assert parts(replay_page(swarm(2, 4.0, **resampled)))[0]["step"] == pytest.approx(1 / 30)
    assert parts(replay_page(dense))[0]["step"] == pytest.approx(0.05)


# -- choices


def test_thrust_directions():
    """A vehicle points along its thrust; without one, or with noise, upwards."""
    force = np.array([[3.0, 0.0, 4.0], [0.0, 0.0, 0.0], [1e-9, -1e-9, -1e-9], [0.0, 0.0, -9.0]])
    up = thrust_directions(force, np.ones(4))
    expected = [[0.6, 0.0, 0.8], [0, 0, 1], [0, 0, 1], [0, 0, -1]]
    np.testing.assert_allclose(up, expected, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0)


@pytest.mark.parametrize(
    ("share", "tension", "beyond"),
    [(1e-9, 0.04905, False), (0.5, 4.905, False), (50.0, 19.62, True)],
)
def test_tension_scale(share, tension, beyond):
    """Full colour stands for the greatest tension, but for no less than 0.5 % and no more than twice the weight."""
    multiplier = np.zeros_like(EIGHT.multiplier)
    multiplier[7, 3] = -share * 9.81
    info, _ = parts(replay_page(swarm(8, 90.0, multiplier=multiplier)))
    assert info["tension"] == pytest.approx(tension)
    assert info["beyond"] is beyond
    assert ("No edge carries a force above" in info["note"]) is (share < 0.005)


def test_too_many_edges(monkeypatch):
    """Of too many edges the shortest are drawn, and the page says so."""
    monkeypatch.setattr(import_module("rigidfleet.web.replay"), "EDGES", 10)
    info, columns = parts(replay_page(EIGHT))
    assert len(info["edges"]) == columns["tension"].shape[1] == 10
    assert "10 shortest of 17 edges" in info["note"]
    straight = {
        (int(i), int(j)) for (i, j), d in zip(EIGHT.edges, EIGHT.distance[0], strict=True) if d < 4
    }
    assert {tuple(e) for e in info["edges"]} <= straight


def test_nothing_known():
    """One vehicle, one sample, nothing but positions: there is still a page."""
    one = swarm(1, 10.0)
    first = {
        name: value[:1]
        for name, value in vars(one).items()
        if isinstance(value, np.ndarray) and len(value) == len(one.time)
    }
    for name in ("slot_position", "attitude", "attitude_reference", "cm_reference"):
        first[name] = np.full_like(first[name], np.nan)
    first["separation"] = np.array([np.inf])
    info, columns = parts(replay_page(swarm(1, 10.0, **first, phases=one.phases[:1])))
    assert info["count"] == 1
    assert info["step"] == 0.0
    assert np.isnan(columns["slot"]).all()
    assert [plot["column"] for plot in info["plots"]] == ["thrust plot", "clearance plot"]


def test_incomplete():
    """A flight that stopped says why."""
    assert (
        parts(replay_page(swarm(2, 4.0, complete=False, ending="too steep")))[0]["ending"]
        == "too steep"
    )


# -- beside fences, and logs


def test_fences_people_and_falls_are_on_the_page():
    """The page has rings and heights; without drag, vehicles fall by the parabola. Other pages have none of it."""
    info, columns = parts(replay_page(fenced(EIGHT)))
    kinds = {area["name"]: (area["kind"], area["hatched"]) for area in info["areas"]}
    expected = {"tent": ("fence", True), "field": ("soft", False), "crowd": ("people", True)}
    assert kinds == expected
    rings = {area["name"]: area["rings"] for area in info["areas"]}
    assert (rings["tent"], rings["crowd"]) == ([TENT], [CROWD])
    assert [area["heights"] for area in info["areas"]] == [[None, 8.0], [None, None], [0.0, 2.0]]
    r, v, g = EIGHT.position, EIGHT.velocity, EIGHT.mission.gravity
    tau = (v[..., 2] + np.sqrt(v[..., 2] ** 2 + 2.0 * g * r[..., 2])) / g
    lands = (r + tau[..., None] * v)[..., :2]
    time = info["start"] + info["step"] * np.arange(info["count"])
    k = np.abs(EIGHT.time - time[400]).argmin()
    np.testing.assert_allclose(columns["fall"][400].reshape(-1, 2), lands[k], atol=0.05)
    plain, none = parts(replay_page(EIGHT))
    assert plain["areas"] == []
    assert not {"fall", "doubt"} & {*none}


def test_the_overview_shows_people_near_the_flight():
    """A crowd that is beside the flight is in sight, and not what is kilometres away."""
    sight = np.array(parts(replay_page(fenced(EIGHT)))[0]["sight"])
    assert sight[:, 0].max() >= 40.0
    assert np.abs(sight).max() < 500.0


def test_drifts_of_a_log_are_on_the_page():
    """Who is off its slot from when to when, what is in doubt and what is surely off are on a log's page; no thrust."""
    info, columns = parts(replay_page(drifting(4, 2, 20.0, 30.0, 1.5, 0.2)))
    (drift,) = info["drifts"]
    assert drift["who"] == 2
    assert [drift["start"], drift["end"]] == pytest.approx([20.0, 30.0], abs=0.051)
    assert drift["worst"] == pytest.approx(1.5)
    np.testing.assert_allclose(columns["doubt"], 0.2, atol=1e-3)
    assert info["plots"][0]["column"] == "off plot"
    k = round(25.0 / info["step"])
    np.testing.assert_allclose(columns["off plot"][k], [1.5, 1.3, 1.7], atol=1e-3)
    assert np.isfinite(columns["tension"]).all()  # edges are drawn, without a force
    assert not info["forces"]
    hidden = parts(replay_page(drifting(4, 2, 20.0, 30.0, 0.1, 0.2)))[0]
    assert hidden["drifts"] == []  # it may be in its slot


def test_a_log_that_is_judged_has_its_plan_on_the_page():
    """The result of a log against a plan, as it is judged, has its drift on the page."""
    plan = simulate(load_mission("two-agents"))
    t = np.arange(0.0, plan.time[-1], 0.04)
    places = [
        np.stack([np.interp(t, plan.time, plan.position[:, i, a]) for a in range(3)], axis=1)
        for i in range(2)
    ]
    bump = np.where((t > 5.0) & (t < 10.0), 0.8 * np.sin(0.2 * np.pi * t) ** 2, 0.0)
    places[1][:, 2] += bump
    noise = 0.003 * np.random.default_rng(0).standard_normal((2, len(t), 3))
    result, _ = judge_log(logged([t, t], [*(places + noise)]), plan, Doubts(0.003, 0.0))
    info = parts(replay_page(result))[0]
    assert {drift["who"] for drift in info["drifts"]} == {1}
    longest = max(info["drifts"], key=lambda drift: drift["end"] - drift["start"])
    # Without a limit, unusual is twice the median of what vehicles are off on average: here, of one of the two.
    assert info["off"] == pytest.approx(bump.mean(), abs=0.01)
    expected = t[bump > info["off"]][[0, -1]]
    assert [longest["start"], longest["end"]] == pytest.approx(expected, abs=0.15)
    assert [longest["worst"], longest["at"]] == pytest.approx([0.8, 7.5], abs=0.1)


def test_a_log_of_vehicles_with_rotors_shows_nothing_of_rotors():
    """A log says where vehicles are: neither attitudes nor rotors of its plan are shown as if measured."""
    plan = quadrotors(3, 10.0)
    shown = {"turn", "rotors", "saturated", "rotor plot"}
    info, columns = parts(replay_page(plan))
    assert shown <= {*columns}
    assert "rotors" in info
    random = np.random.default_rng(0)
    places = plan.position + 0.003 * random.standard_normal(plan.position.shape)
    log = logged([plan.time] * 3, [*places.swapaxes(0, 1)])
    result, _ = judge_log(log, plan, Doubts(0.003, 0.0))
    info, columns = parts(replay_page(result))
    assert not shown & {*columns}
    assert "rotors" not in info
    assert {"off plot", "doubt"} <= {*columns}
    assert not {"rotors", "vehicles"} & {*figure_names(result)}


# -- the file


@pytest.mark.filterwarnings("error")
def test_one_vehicle_left():
    """Nothing is near it, and nobody is warned of that."""
    data = load_mission("two-agents").to_dict()
    data["disturbances"] = {"lost": [{"agent": 1, "time": 1.5}]}
    assert len(replay(simulate(Mission.from_dict(data))).html) > 10_000


def test_file(tmp_path):
    """`replay` writes the page, in place of an older file."""
    path = tmp_path / "flight.html"
    path.write_text("old")
    replay(EIGHT, path)
    assert path.read_text(encoding="utf-8") == replay_page(EIGHT)
    assert list(tmp_path.iterdir()) == [path]


def test_no_such_folder(tmp_path):
    """A file that cannot be written is an error that names it."""
    with pytest.raises(ResultError, match="there is no folder"):
        replay(EIGHT, tmp_path / "missing" / "flight.html")


def test_thrust_of_many_is_its_least_and_greatest():
    """Of twelve vehicles each has a line of thrust; of more, the plot has the least and the greatest of all."""
    few, many = swarm(12, 3.0), swarm(13, 3.0)
    assert parts(replay_page(few))[1]["thrust plot"].shape[1] == 12
    column = parts(replay_page(many))[1]["thrust plot"]
    ends = np.sort(many.thrust[0])[[0, -1]]
    np.testing.assert_allclose(column[0], ends, atol=1e-3)
