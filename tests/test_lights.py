"""Lights: a word flown at night is read in every picture, from in front; animations and exports have its colours."""

import io
import json
import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from sample_flights import WORD, bitmap, swarm, word

from rigidfleet import plotting
from rigidfleet.interchange import FORMATS, export
from rigidfleet.result.lights import angles_facing_formation, light_colours, view_angles
from rigidfleet.web.replay import replay_page

AMBER = np.array([255, 176, 0]) / 255


@pytest.fixture(scope="module")
def flight():
    """65 vehicles that stand upright as FLY UP, and fade from white to amber within a second."""
    return word()


def image(figure):
    """A figure as it is drawn: (height, width, 3), from 0 to 1."""
    import matplotlib.image

    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100)
    data.seek(0)
    return matplotlib.image.imread(data)[..., :3]


def amber(picture):
    """Where a picture is amber: far more red than blue."""
    return picture[..., 0] - picture[..., 2] > 0.35


def test_lights_fade_with_the_blend(flight):
    """Light is white, turns amber while the formation is taken, and stays; each vehicle has its own."""
    shown = light_colours(flight, np.array([0.0, 0.25, 0.5, 1.0, 3.0]))
    share = np.array([0.0, 0.25, 0.5, 1.0, 1.0])[:, None, None]
    np.testing.assert_allclose(
        shown, np.broadcast_to(1 + share * (AMBER - 1), shown.shape), atol=1e-9
    )


def test_a_word_is_read_in_the_figure_of_formations(flight):
    """The picture of the formation, reduced to a cell a vehicle, is the word: not mirrored, upright, at night."""
    picture = image(plotting.formations(flight))
    assert bitmap(amber(picture)) == WORD
    rows, columns = np.nonzero(amber(picture))
    around = picture[rows.min() : rows.max(), columns.min() : columns.max()]
    assert np.median(around) < 0.1


@pytest.mark.parametrize("name", ["trajectory", "summary"])
def test_figures_of_paths_show_lights(flight, name):
    """Vehicles have their lights' colours, on dark walls, and no colours by number."""
    figure = getattr(plotting, name)(flight)
    dots = figure.findobj(lambda x: x.get_gid() == "lights")
    assert len(dots) == 2  # in space and from above
    last = dots[0].get_facecolor()[-flight.n_agents :, :3]
    np.testing.assert_allclose(last, np.broadcast_to(AMBER, last.shape), atol=1e-6)
    assert amber(image(figure)).sum() > 100
    words = " ".join(x.get_text() for x in figure.findobj() if hasattr(x, "get_text"))
    assert "agent 1" not in words.replace("agent 1 to", "")


def test_pictures_are_by_day_without_lights():
    """A flight whose formations have no colours has a light page and figure, and the colours of its agents."""
    made = swarm(4, 4.0)
    info = json.loads(replay_page(made).split('id="info">')[1].split("</script>")[0])
    assert "night" not in info
    assert "light" not in {column["name"] for column in info["columns"]}
    assert np.median(image(plotting.formations(made))) == 1.0


UPRIGHT = np.array([[0, 0, 0], [3, 0, 0], [0, 0, 2], [3, 0.2, 2], [1, 0, 1]], dtype=float)


@pytest.mark.parametrize(
    ("points", "azimuth", "steep"),
    [
        (UPRIGHT, -90, False),  # letters in x and z are read from the south
        (UPRIGHT[:, [1, 0, 2]], 0, False),  # in y and z: from the east, where y points right
        (UPRIGHT @ np.array([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0, 1]]), -53.13, False),
        (UPRIGHT[:, [0, 2, 1]], -90, True),  # lying: from above, y upwards
        (np.concatenate([np.eye(3), -np.eye(3)]), -90, False),  # no plane
        (UPRIGHT[:1], -90, False),
        (np.array([[0, 0, 0], [0, 1, 0], [0, 3, 0]]), 0, False),  # a row along y: from the east
        (np.array([[0, 0, 0], [0, 0, 1], [0, 0, 3]]), -90, False),  # a pole
    ],
)
def test_the_viewer_faces_the_plane(points, azimuth, steep):
    """A flat formation is seen along its normal, from the side on which x or y points to the right."""
    turn, elevation = np.degrees(view_angles(points))
    assert turn == pytest.approx(azimuth, abs=3)
    assert elevation == pytest.approx(90) if steep else 0 < elevation < 10


def test_the_viewer_turns_with_the_formation():
    """A word that has turned by 90 deg, counter-clockwise, is looked at from where its front is then: the east."""
    made = word()
    turned = made.position @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    half = math.sqrt(0.5)
    attitude = np.tile([half, 0, 0, half], (len(made.time), 1))
    azimuth, _ = angles_facing_formation(replace(made, position=turned, attitude=attitude))
    assert math.degrees(azimuth) == pytest.approx(0.0, abs=1.0)


def test_the_page_has_lights(flight):
    """The replay is at night, seen from in front, and its samples have the colours."""
    from test_replay import parts

    info, columns = parts(replay_page(flight))
    assert info["night"]
    assert math.degrees(info["azimuth"]) == pytest.approx(-90, abs=0.1)
    time = info["start"] + info["step"] * np.arange(info["count"])
    shown = columns["light"].reshape(len(time), -1, 3)
    np.testing.assert_allclose(shown[:, 7], light_colours(flight, time)[:, 7], atol=1 / 255)


def test_gltf_shines(flight, tmp_path):
    """Emission is the colour at all times, in linear light, and the camera in front sees the word."""
    path = tmp_path / "word.glb"
    made = export(flight, path, "gltf")
    assert ", and lights; lost continuous" in str(made)
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    scene, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    assert scene["extensionsUsed"] == ["KHR_animation_pointer"]

    def array(index, width):
        given = scene["accessors"][index]
        begin = scene["bufferViews"][given["bufferView"]]["byteOffset"]
        return np.frombuffer(binary, "<f4", given["count"] * width, begin).reshape(-1, width)

    (animation,) = scene["animations"]
    for i in (0, 40):
        pointer = f"/materials/{i}/emissiveFactor"
        (channel,) = (
            x for x in animation["channels"]
            if pointer in str(x["target"].get("extensions", {}).get("KHR_animation_pointer"))
        )  # fmt: skip
        sampler = animation["samplers"][channel["sampler"]]
        times, values = array(sampler["input"], 1)[:, 0], array(sampler["output"], 3)
        assert (np.diff(times) > 0).all()
        assert scene["meshes"][scene["nodes"][i]["mesh"]]["primitives"][0]["material"] == i
        # sRGB's electro-optical curve of 255, 176, 0 (IEC 61966-2-1).
        linear = [1.0, ((176 / 255 + 0.055) / 1.055) ** 2.4, 0.0]
        assert values[0] == pytest.approx([1, 1, 1])
        for at in (1.01, 3.0):
            now = [np.interp(at, times, column) for column in values.T]
            assert now == pytest.approx(linear, abs=1e-3)
        assert scene["materials"][i]["emissiveFactor"] == pytest.approx(linear)
    # The camera looks along its own -z, with y up; x, y, z of glTF are x, z, -y of the mission.
    (camera,) = (node for node in scene["nodes"] if "camera" in node)
    turn = np.reshape(camera["matrix"], (4, 4))  # column by column
    places = flight.position[-1] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    seen = (places - turn[3, :3]) @ turn[:3, :3].T
    assert turn[:3, :3] @ turn[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turn[:3, :3]) == pytest.approx(1.0)
    assert (seen[:, 2] < 0).all()
    tan = math.tan(scene["cameras"][0]["perspective"]["yfov"] / 2)
    across, up = seen[:, 0] / -seen[:, 2] / tan, seen[:, 1] / -seen[:, 2] / tan
    assert max(abs(across).max(), abs(up).max()) < 1
    drawn = np.zeros((200, 200), dtype=bool)
    drawn[np.round(100 - 99 * up).astype(int), np.round(100 + 99 * across).astype(int)] = True
    assert bitmap(drawn) == WORD


@pytest.mark.parametrize("name", [name for name, made in FORMATS.items() if not made.package])
def test_exports_say_what_becomes_of_lights(flight, tmp_path, name):
    """A format without lights says that they are lost; a flight without lights says nothing of them."""
    said = str(export(flight, tmp_path / f"{name}.x", name))
    kept = name in ("skyc", "gltf")
    assert (", and lights; lost" in said) == kept
    assert ("lost lights, " in said) != kept
    assert "lights" not in str(export(word(lit=False), tmp_path / f"dark-{name}.x", name))
