"""The replay in a real browser: what is on the page is the flight, and the controls control."""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from threading import Thread
from typing import Any

import numpy as np
import pytest
from chromium import started
from sample_flights import WORD, bitmap, drifting, fenced, quadrotors, swarm, word
from test_policy import HOSTILE, flight

from rigidfleet.math import attitude as att
from rigidfleet.mission import Mission
from rigidfleet.reporting import report
from rigidfleet.web.replay import replay, replay_page

pytestmark = pytest.mark.long

# Draw at a time and read back the colour of the pixel where a point of the world is.
PIXEL = """
const [time, point] = arguments, { scene } = replay, { renderer } = scene, { gl, canvas } = renderer;
renderer.scale = 1;
scene.camera.shown = null;
scene.draw(time, 10);
const [x, y] = renderer.project(point), px = new Uint8Array(4), ratio = canvas.width / canvas.clientWidth;
gl.readPixels(Math.round(x * ratio), canvas.height - Math.round(y * ratio), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, px);
return Array.from(px);
"""


def at(result, name: str, t: float) -> np.ndarray:
    """An array of a result at a time."""
    values = getattr(result, name)
    flat = values.reshape(len(values), -1)
    found = [np.interp(t, result.time, column) for column in flat.T]
    return np.array(found).reshape(values.shape[1:])


def flown_by(page, seconds: float) -> float:
    """Time that the flight goes on by in seconds of the page, 20 pictures in each, however slow the machine is."""
    page.run(
        "window.requestAnimationFrame = () => 0"
    )  # from now on only the test asks for pictures
    return page.run(
        "const from = replay.time;"
        "for (let k = 0; k < 20 * arguments[0]; k++) replay.frame(replay.last + 50);"
        "return replay.time - from",
        seconds,
    )


# -- the page


def test_alone(show, eight):
    """The page loads without an error, and asks nothing of any network."""
    page = show(eight)
    time.sleep(0.5)
    assert page.heard() == []
    assert [url for url in page.asked() if not url.startswith(("data:", "blob:"))] == []


def test_may_not_ask(show, eight):
    """The page could not reach a network if it tried: its own policy forbids it."""
    page = show(eight)
    refused = page.driver.execute_async_script(
        "const done = arguments[0]; fetch('http://127.0.0.1:9/').then(() => done('sent'), (e) => done(e.name))"
    )
    assert refused == "TypeError"
    assert any("Content Security Policy" in line for line in page.heard())


def test_may_not_make_scripts(show, eight):
    """Nothing that a page is told becomes a script: neither mark-up made of text, nor an element, nor a handler."""
    page = show(eight)
    for deed in (
        "document.body.innerHTML = '<img src=x onerror=window.hacked=1>'",
        "const s = document.createElement('script'); s.textContent = 'window.hacked = 1'; document.body.append(s)",
        "document.body.setAttribute('onclick', 'window.hacked = 1'); document.body.click()",
        "const f = document.createElement('iframe'); f.srcdoc = '<script>parent.hacked = 1</script>';"
        "document.body.append(f)",
        "setTimeout('window.hacked = 1', 0)",
    ):
        page.run(f"try {{ {deed} }} catch (error) {{ window.refused = String(error) }}")
        time.sleep(0.1)
        assert page.run("return window.hacked === undefined"), deed
        assert page.heard() != [] or page.run("return Boolean(window.refused)"), deed
    assert page.run("return document.images.length") == 0


@pytest.mark.parametrize("hostile", [*HOSTILE])
def test_hostile_words(show, hostile):
    """Whatever stands in a mission, the page shows it as it stands, and does nothing else."""
    page = show(flight(lambda place: f"{place} {hostile}"), "t=6&camera=overview")
    assert page.run("return window.hacked === undefined")
    assert page.heard() == []
    assert page.text("#title") == f"title {hostile}"
    assert page.text("#phase-name") == f"second {hostile}"
    assert page.text("#phases button") == f"first {hostile}"
    assert page.run("return document.getElementById('ending').title") == f"ending {hostile}"
    assert page.run("return document.querySelectorAll('img, iframe, b').length") == 0


@pytest.mark.parametrize("several", [False, True])
def test_hostile_report(browser, tmp_path, several):
    """A report of hostile words draws all its pictures and colours, and its policy refuses none of its own parts."""
    words = " ".join(HOSTILE)
    result = flight(lambda place: f"{place} {words}")
    report([result] * 2 if several else result, tmp_path / "report.html")
    browser.open((tmp_path / "report.html").as_uri(), ready="document.readyState === 'complete'")
    assert browser.run("return window.hacked === undefined")
    assert browser.heard() == []
    assert browser.run("return [...document.images].every((i) => i.naturalWidth > 0)")
    assert words in browser.text("main")
    colour = "return getComputedStyle(document.querySelector('.swatch rect')).fill"
    assert browser.run(colour) == "rgb(0, 114, 178)"
    assert (
        browser.run("return document.querySelector('.swatch').getBoundingClientRect().width") == 11
    )


def test_words(show, eight):
    """Name, title, phase and time are on the screen; a user's words are words, not mark-up."""
    page = show(eight, "t=60")
    assert page.text("#name") == "swarm"
    assert page.text("#title") == "8 vehicles, one sheet"
    assert page.text("#phase-name") == '<round> & "round"</script>'
    assert page.text("#number") == "2/2"
    assert page.text("#time") == "60.0 s"
    assert page.driver.title == "swarm – rigidfleet"
    assert page.run("return document.querySelectorAll('#phases button').length") == 2


def test_state_is_the_flight(show, eight):
    """At any time, positions, slots, attitude and tension on the page are those of the result."""
    page = show(eight)
    for t in (0.0, 12.34, 44.99, 45.0, 71.717, 90.0):
        state = page.run(
            "const s = replay.recording.at(arguments[0]);"
            "return Object.fromEntries(Object.entries(s).map(([k, v]) => [k, v.length ? Array.from(v) : v]))",
            t,
        )
        r = at(eight, "position", t)
        np.testing.assert_allclose(np.reshape(state["position"], (-1, 3)), r, atol=2e-3)
        slots = r + np.reshape(state["slot"], (-1, 3))
        np.testing.assert_allclose(slots, at(eight, "slot_position", t), atol=2e-3)
        np.testing.assert_allclose(state["cm"], at(eight, "cm", t), atol=2e-3)
        np.testing.assert_allclose(state["attitude"], at(eight, "attitude", t), atol=2e-3)
        np.testing.assert_allclose(state["tension"], -at(eight, "multiplier", t), atol=5e-3)
        force = at(eight, "input_force", t)
        up = force / np.linalg.norm(force, axis=1, keepdims=True)
        np.testing.assert_allclose(np.reshape(state["thrust"], (-1, 3)), up, atol=5e-3)


@pytest.fixture
def served(tmp_path, eight) -> Iterator[str]:
    """Address of a page that loads the modules as they stand, not put together into one."""
    with resources.as_file(resources.files("rigidfleet.web")) as web:
        shutil.copytree(web, tmp_path, ignore=shutil.ignore_patterns("*.py*"), dirs_exist_ok=True)
    text = re.sub(r"<meta http-equiv=[^>]*>", "", replay_page(eight))
    script = '<script type="module" src="replay/replay.js"></script>'
    text = re.sub(r'<script type="module">.*?</script>', script, text, flags=re.DOTALL)
    (tmp_path / "index.html").write_text(text, encoding="utf-8")

    class Silent(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None: ...

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Silent, directory=tmp_path)) as server:
        thread = Thread(target=server.serve_forever, args=(0.1,), daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


def test_modules_stand_alone(browser, served):
    """Each module imports what it uses: the page flies without their being put together."""
    browser.open(f"{served}#t=10")
    before = browser.run("return replay.time")
    browser.click("#play")
    browser.wait(f"return replay.time > {before} + 0.3")
    browser.press("1")
    browser.press("3")
    time.sleep(0.3)
    assert browser.heard() == []


def test_rotations(browser, served):
    """Axes and quaternions on the page follow the package's conventions."""
    browser.open(f"{served}#t=0")
    rng = np.random.default_rng(3)
    q = rng.normal(size=(20, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    axes, back = browser.driver.execute_async_script(
        "const [q, done] = arguments;"
        "Promise.all(['recording', 'gl'].map((name) => import(`./replay/${name}.js`))).then(([recording, gl]) => {"
        "  const axes = q.map(recording.bodyAxes);"
        "  done([axes, axes.map((a) => gl.quaternion(...a))]);"
        "});",
        q.tolist(),
    )
    np.testing.assert_allclose(axes, att.dcm_from_quaternion(q), atol=1e-12)
    # The rotation that takes the world's axes to the body's, up to its sign.
    turned = np.abs(np.sum(np.array(back) * q, axis=1))
    np.testing.assert_allclose(turned, 1.0, atol=1e-12)


# -- the controls


def test_plays_by_itself(show, eight):
    """Opened without more, the flight plays, as fast as it flew."""
    page = show(eight, "")
    assert flown_by(page, 1.5) == pytest.approx(1.5)
    assert page.run("return document.getElementById('play').getAttribute('aria-label')") == "Pause"


def test_pause_and_play(show, eight):
    """The button and the space bar pause and go on."""
    page = show(eight, "")
    page.click("#play")
    t = page.run("return replay.time")
    time.sleep(0.3)
    assert page.run("return replay.time") == t
    page.run("document.activeElement.blur()")
    page.press(" ")
    page.wait(f"return replay.time > {t}")
    page.press(" ")
    assert page.run("return replay.playing") is False


@pytest.mark.parametrize("clicked", ["#more", "[data-mode=top]", "[data-show=edges]", "#play"])
def test_space_after_a_click(show, eight, clicked):
    """Space plays and pauses, whatever was clicked before: what was clicked is not pressed again."""
    from selenium.webdriver import ActionChains

    page = show(eight)
    look = (
        "return [getComputedStyle(document.getElementById('panel')).display, replay.scene.camera.mode,"
        "replay.scene.show.edges]"
    )
    page.click(clicked)
    before, playing = page.run(look), page.run("return replay.playing")
    ActionChains(page.driver).send_keys(" ").perform()
    assert page.run("return replay.playing") is not playing
    assert page.run(look) == before


def test_keys_reach_everything(show, eight):
    """What is reached by the Tab key is pressed by space, as everywhere."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    page = show(eight)
    page.run("document.getElementById('speed').focus()")
    for _ in range(9):
        if page.run("return document.activeElement.dataset.mode") == "top":
            break
        ActionChains(page.driver).send_keys(Keys.TAB).perform()
    assert page.run("return document.activeElement.dataset.mode") == "top"
    ActionChains(page.driver).send_keys(" ").perform()
    assert page.run("return [replay.scene.camera.mode, replay.playing]") == ["top", False]


def test_keys_are_listed(show, eight):
    """A button and the ? key list the keys; each that is listed does something, and Escape closes the list."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    page = show(eight)
    page.click("#keys")
    assert page.run("return document.getElementById('help').open")
    words = page.text("#help-list")
    for key in ("space", "← →", "[ ]", "Home End", "− +", "1 2 3", "p", "?"):
        assert key in words
    ActionChains(page.driver).send_keys(Keys.ESCAPE).perform()
    assert not page.run("return document.getElementById('help').open")
    ActionChains(page.driver).send_keys("?").perform()
    assert page.run("return document.getElementById('help').open")


def test_ends(show, eight):
    """At its end the flight stops; played again, it begins anew."""
    page = show(eight, "t=89.9")
    page.click("#play")
    page.wait("return !replay.playing")
    assert page.run("return replay.time") == 90.0
    page.click("#play")
    page.wait("return replay.playing && replay.time > 0 && replay.time < 20")


def test_scrub(show, eight):
    """The slider goes to any time, and the picture with it."""
    page = show(eight)
    pictures = page.run("return replay.pictures")
    page.run(
        "const s = document.getElementById('scrub'); s.value = 33.3; s.dispatchEvent(new Event('input'))"
    )
    page.wait(
        f"return replay.pictures > {pictures} && document.getElementById('time').textContent === '33.3 s'"
    )
    assert page.run("return replay.scene.state.time") == pytest.approx(33.3)


def test_slider_follows(show, eight):
    """While the flight plays, the slider and the marks in the plots move along."""
    page = show(eight, "")
    place = "return [Number(document.getElementById('scrub').value), document.querySelector('.cursor').style.transform]"
    before = page.run(place)
    page.wait("return replay.time > 1.5")
    after = page.run(place)
    assert after[0] > before[0]
    assert after[1] != before[1]


def test_speed(show, eight):
    """At eight times the speed, eight seconds are flown in one."""
    page = show(eight, "")
    page.run(
        "const s = document.getElementById('speed'); s.value = '8'; s.dispatchEvent(new Event('change'))"
    )
    assert flown_by(page, 1.5) == pytest.approx(12.0)
    page.press("-")
    assert page.run("return replay.speed") == 4


def test_keys(show, eight):
    """Arrows step by a second, with Shift by a tenth; brackets go from phase to phase."""
    from selenium.webdriver.common.keys import Keys

    page = show(eight, "t=10")
    page.press(Keys.ARROW_RIGHT)
    assert page.run("return replay.time") == pytest.approx(11)
    page.press(Keys.SHIFT + Keys.ARROW_LEFT + Keys.NULL)
    assert page.run("return replay.time") == pytest.approx(10.9)
    page.press("]")
    assert page.run("return replay.time") == pytest.approx(45)
    page.press("[")
    assert page.run("return replay.time") == 0
    page.press(Keys.END)
    assert page.run("return replay.time") == 90


def test_phase_and_plot(show, eight):
    """A click on a phase goes to its start, a click in a plot to that time."""
    page = show(eight)
    page.click("#phases button:nth-child(2)")
    page.wait("return document.getElementById('number').textContent === '2/2'")
    assert page.run("return replay.time") == 45
    page.click(".plot .area")  # its middle
    assert page.run("return replay.time") == pytest.approx(45, abs=1)


def test_address(show, eight):
    """An address names a moment, a speed and a camera."""
    page = show(eight, "t=52&camera=top&speed=2")
    assert page.run("return [replay.time, replay.speed, replay.scene.camera.mode]") == [
        52,
        2,
        "top",
    ]
    assert page.run("return replay.playing") is False


# -- the picture


def test_follows(show, eight):
    """The camera keeps the centre of mass in the middle of what the panels leave free, and all in sight."""
    page = show(eight, "t=0&camera=follow")
    for t in (0.0, 30.0, 60.0, 90.0):
        page.run(
            "replay.seek(arguments[0]); replay.scene.camera.shown = null; replay.scene.draw(arguments[0], 10)",
            t,
        )
        middle = page.run("return replay.scene.renderer.project(replay.scene.state.cm)")
        free = page.run(
            "return [document.getElementById('panel').offsetLeft, document.getElementById('bar').offsetTop]"
        )
        assert middle[:2] == pytest.approx([free[0] / 2, free[1] / 2], abs=12)
        for r in at(eight, "position", t):
            x, y, _ = page.run("return replay.scene.renderer.project(arguments[0])", r.tolist())
            assert 0 < x < free[0]
            assert 0 < y < free[1]


@pytest.mark.parametrize("size", [(1400, 900), (400, 800), (420, 520)])
def test_opens_on_the_overview(show, eight, size):
    """A flight opens on all of itself with the obstacles near it, on a wide screen and, below its head, a small one."""
    page = show(eight, "")
    device = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", device)
    try:
        page.wait(f"return document.documentElement.clientWidth === {size[0]}")
        page.run("replay.resize(); replay.scene.camera.shown = null; replay.scene.draw(0, 10)")
        assert page.run("return replay.scene.camera.mode") == "overview"
        free = page.run(
            "const p = document.getElementById('panel'), b = document.getElementById('bar');"
            "return [p.offsetWidth ? p.offsetLeft : innerWidth, b.offsetTop]"
        )
        head = page.run(
            "const { offsetTop, offsetHeight } = document.getElementById('head'); return offsetTop + offsetHeight"
        )
        above = head if size[0] < 760 else 0
        hall = [[x, y, z] for x in (-8.0, 8.0) for y in (45.0, 60.0) for z in (0.0, 9.0)]
        flown = eight.position[::100].reshape(-1, 3).tolist()
        places = page.run(
            "return arguments[0].map((p) => replay.scene.renderer.project(p))", hall + flown
        )
        x, y, _ = np.array(places).T
        assert 0 < x.min() < x.max() < free[0]
        assert above < y.min() < y.max() < free[1]
        # And it fills what is free, in one direction at least.
        assert max(np.ptp(x) / free[0], np.ptp(y) / (free[1] - above)) > 0.8
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_north_is_up(show, eight):
    """From above, north is up and east to the right, whatever the flight's direction; the compass says so."""
    page = show(eight, "t=30&camera=top")
    cm, north, east = page.run(
        "const p = Array.from(replay.scene.state.cm);"
        "const see = (v) => replay.scene.renderer.project(p.map((x, i) => x + v[i]));"
        "return [see([0, 0, 0]), see([0, 3, 0]), see([3, 0, 0])]"
    )
    assert north[0] == pytest.approx(cm[0], abs=0.5)
    assert north[1] < cm[1] - 20
    assert east[1] == pytest.approx(cm[1], abs=0.5)
    assert east[0] > cm[0] + 20
    turned = "return document.getElementById('compass').style.transform"
    assert page.run(turned).startswith("rotate(0") or "e-17" in page.run(turned)


def test_numbers_beside_the_curves(show, eight):
    """No number stands on a curve; below, round times stand where their moments are."""
    page = show(eight)
    overlaps = page.run(
        "const box = (e) => e.getBoundingClientRect();"
        "return [...document.querySelectorAll('.plot')].flatMap((p) => [...p.querySelectorAll('.scale span')]"
        ".filter((s) => s.textContent && box(s).right > box(p.querySelector('canvas')).left))"
        ".length"
    )
    assert overlaps == 0
    assert page.run(
        "return [...document.querySelectorAll('.plot .scale span')].every((s) => s.textContent)"
    )
    ticks = page.run(
        "const area = document.querySelector('.plot .area').getBoundingClientRect();"
        "return [...document.querySelectorAll('#moments span')].map((s) => [s.textContent,"
        "(document.getElementById('moments').getBoundingClientRect().left + parseFloat(s.style.left) / 100 *"
        "document.getElementById('moments').clientWidth - area.left) / area.width])"
    )
    assert [words for words, _ in ticks] == ["0", "20", "40", "60", "80 s"]
    np.testing.assert_allclose([x for _, x in ticks], np.arange(0, 90, 20) / 90, atol=0.01)
    # The slider's own axis: at a time that is written, its knob stands over the word.
    assert "50" in page.text("#times")


def test_limits_of_each(show):
    """Where limits differ, each vehicle's is drawn in its colour, and passing its own one is an alarm."""
    result = swarm(3, 10.0)
    data = result.mission.to_dict()
    data["agents"]["thrust_limit"] = [11.0, 12.5, 14.0]
    result = swarm(3, 10.0, mission_text=Mission.from_dict(data).text)
    page = show(result)
    rows = page.run(
        "const plot = replay.plots[0]; return plot.limits.map(({ value, colour }) => [value, colour])"
    )
    assert [value for value, _ in rows] == [11.0, 12.5, 14.0]
    assert len({colour for _, colour in rows}) == 3
    # Dashes of each colour are on the canvas.
    pixels = page.run(
        "const c = document.querySelector('.plot canvas'), seen = {};"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "for (let k = 0; k < d.length; k += 4) {"
        "  const key = [d[k], d[k + 1], d[k + 2]].join();"
        "  seen[key] = (seen[key] ?? 0) + 1;"
        "}"
        "return seen"
    )
    for _, colour in rows:
        near = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        found = sum(
            count
            for key, count in pixels.items()
            if np.abs(np.array(key.split(","), int) - near).max() < 60
        )
        assert found > 40, colour
    alarm = (
        "const plot = replay.plots[0]; plot.point(0, { [plot.plot.column]: arguments[0] });"
        "return plot.value.style.color"
    )
    assert page.run(alarm, [10.9, 12.4, 13.9]) == ""
    assert page.run(alarm, [11.1, 9.0, 9.0]) != ""
    assert page.run(alarm, [9.0, 9.0, 14.1]) != ""


def test_cameras(show, eight):
    """The overview holds the whole flight; from above, height does not show."""
    page = show(eight, "t=30&camera=overview")
    free = page.run(
        "return [document.getElementById('panel').offsetLeft, document.getElementById('bar').offsetTop]"
    )
    for r in eight.position[::100].reshape(-1, 3):
        x, y, _ = page.run("return replay.scene.renderer.project(arguments[0])", r.tolist())
        assert 0 < x < free[0]
        assert 0 < y < free[1]
    page = show(eight, "t=30&camera=top")
    low, high = page.run(
        "const [x, y, z] = replay.scene.state.cm, see = (h) => replay.scene.renderer.project([x, y, h]);"
        "return [see(z), see(z - 5)]"
    )
    assert low[:2] == pytest.approx(high[:2], abs=25)


def test_turn_and_zoom(show, eight):
    """Dragging turns, the wheel zooms, and the right button moves the view."""
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    page = show(eight)
    view = page.driver.find_element("css selector", "#view")
    look = "const c = replay.scene.camera; return [c.azimuth, c.elevation, c.zoom, ...c.pan]"
    before = page.run(look)
    # From a place that no panel covers.
    drag = ActionChains(page.driver).move_to_element_with_offset(view, -100, 0)
    drag.click_and_hold().move_by_offset(80, 30).release().perform()
    turned = page.run(look)
    assert turned[0] < before[0]
    assert turned[1] > before[1]
    ActionChains(page.driver).scroll_from_origin(
        ScrollOrigin.from_element(view, -100, 0), 0, -300
    ).perform()
    page.wait("return replay.scene.camera.zoom < 0.9")
    ActionChains(page.driver).key_down("\ue008").click_and_hold().move_by_offset(
        40, 0
    ).release().key_up("\ue008").perform()
    assert page.run(look)[3:] != [0, 0, 0]
    page.click("[data-mode=overview]")
    assert page.run(look) == before


def test_edges_show_tension(show, eight):
    """An edge is red where it pulls and grey where it idles; blue where it pushes."""
    page = show(eight)
    page.run("for (const k in replay.scene.show) replay.scene.show[k] = k === 'edges'")
    k, e = np.unravel_index(np.argmax(-eight.multiplier), eight.multiplier.shape)
    i, j = eight.edges[e]
    t = float(eight.time[k])
    middle = at(eight, "position", t)[[i, j]].mean(axis=0).tolist()
    red, _, blue, _ = page.run(PIXEL, t, middle)
    assert red > blue + 60
    page.run(
        "const { tension } = replay.recording.columns; tension.forEach((v, k) => (tension[k] = -Math.abs(v)))"
    )
    red, _, blue, _ = page.run(PIXEL, t, middle)
    assert blue > red + 60
    page.run("replay.recording.columns.tension.fill(0)")
    red, _, blue, _ = page.run(PIXEL, t, middle)
    assert abs(blue - red) < 50


def test_vehicles_in_their_colours(show, eight):
    """A vehicle has its colour from the figures, and tilts as its thrust does."""
    page = show(eight)
    places = page.run(
        "replay.scene.camera.zoom = 0.4; replay.scene.camera.shown = null; replay.scene.draw(5, 10);"
        "const p = replay.scene.places.vehicles; return [p.count, Array.from(p.data.slice(0, 12 * p.count)),"
        "Array.from(p.words.slice(0, 12 * p.count))]"
    )
    count, data, words = places
    assert count == 8
    data, words = np.reshape(data, (8, 12)), np.reshape(words, (8, 12))
    first = int(words[0, 3])
    assert [first & 255, first >> 8 & 255, first >> 16 & 255] == pytest.approx(
        [0x00, 0x72, 0xB2], abs=1
    )
    force = at(eight, "input_force", 5.0)
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    # The body's z axis in the world: the last row of its attitude, world to body.
    T = att.dcm_from_quaternion(data[:, 7:11])
    np.testing.assert_allclose(T[:, 2], up, atol=5e-3)


def test_quadrotors_turn_as_they_flew(show):
    """Vehicles with rotors have their own tilt and yaw, not those of the formation, and an arrow ahead."""
    result = quadrotors(4, 20.0)
    assert result.vehicle_attitude is not None
    page = show(result)
    for t in (2.0, 13.0):
        count, drawn, noses = page.run(
            "replay.scene.camera.zoom = 0.4; replay.scene.camera.shown = null; replay.scene.draw(arguments[0], 10);"
            "const p = replay.scene.places.turned;"
            "const q = Array.from({ length: p.count }, (_, k) => Array.from(p.data.slice(12 * k + 7, 12 * k + 11)));"
            "return [p.count, q, replay.scene.places.noses.count]",
            t,
        )
        assert count == noses == 4
        assert result.vehicle_attitude is not None
        flown = result.vehicle_attitude[np.searchsorted(result.time, t)]
        np.testing.assert_allclose(np.abs(np.sum(np.array(drawn) * flown, axis=1)), 1.0, atol=1e-3)


def test_rotor_at_its_limit_is_red(show):
    """The rotor at its limit, and no other, is red, where it is on its vehicle; the panel names the vehicle."""
    result = quadrotors(4, 20.0)
    assert result.vehicle_attitude is not None
    page = show(result, "t=2")
    # Colours of all discs: four of each vehicle, in the order of the columns.
    discs = (
        "replay.scene.camera.zoom = 0.4; replay.scene.camera.shown = null; replay.scene.draw(arguments[0], 10);"
        "const p = replay.scene.places.discs; return Array.from({ length: p.count }, (_, k) =>"
        " [p.words[12 * k + 3] & 255, p.words[12 * k + 3] >> 8 & 255, ...p.data.slice(12 * k, 12 * k + 3)])"
    )
    calm, busy = np.array(page.run(discs, 2.0)), np.array(page.run(discs, 7.0))
    assert len(calm) == len(busy) == 16
    red = (busy[:, 0] > 200) & (busy[:, 1] < 30)
    assert np.flatnonzero(red).tolist() == [5]
    assert not ((calm[:, 0] > 200) & (calm[:, 1] < 30)).any()
    k = np.searchsorted(result.time, 7.0)
    assert result.vehicle_attitude is not None
    away = att.dcm_from_quaternion(result.vehicle_attitude[k, 1]) @ (
        busy[5, 2:] - result.position[k, 1]
    )
    assert away[0] > 0.01  # front, in the vehicle's own axes
    assert away[1] < -0.01  # right
    page.run("replay.seek(7)")
    page.wait(
        "return document.getElementById('notes').textContent.includes('Agent 2 cannot give all')"
    )
    page.run("replay.seek(2)")
    page.wait("return !document.getElementById('notes').textContent.includes('cannot give')")


def test_ghosts(show, eight):
    """A slot shows as a ghost where its vehicle is not, and only there."""
    page = show(eight)
    ghosts = (
        "replay.scene.draw(arguments[0], 10); const { ghosts, smallGhosts } = replay.scene.places;"
        "return ghosts.count + smallGhosts.count"
    )
    assert page.run(ghosts, 10.0) > 0
    page.run("replay.recording.columns.slot.fill(0)")
    assert page.run(ghosts, 10.0) == 0
    page.run("replay.recording.columns.slot.fill(NaN)")
    assert page.run(ghosts, 10.0) == 0


def test_box_in_the_way(show, eight):
    """A box between the eye and the vehicles becomes a veil."""
    page = show(eight, "t=10")
    solid = "replay.scene.draw(10, 10); return replay.scene.fade[0]"
    assert page.run(solid) == 1
    page.run(
        "const s = replay.scene, at = Array.from(s.camera.eye, (x, i) => (x + s.state.cm[i]) / 2);"
        "s.info.boxes[0] = { min: at.map((x) => x - 1), max: at.map((x) => x + 1) }"
    )
    page.run(solid)
    assert page.run(solid) < 0.3


def test_switches(show, eight):
    """What is switched off is not drawn."""
    page = show(eight, "t=30")
    count = "replay.scene.draw(30, 10); return replay.scene.lines.world.count"
    everything = page.run(count)
    for name in ("edges", "trails", "axes"):
        page.click(f"[data-show={name}]")
        less = page.run(count)
        assert less < everything, name
        everything = less
    assert page.run("return document.querySelectorAll('#labels span:not([hidden])').length") > 0
    page.click("[data-show=names]")
    page.wait("return document.querySelectorAll('#labels span:not([hidden])').length === 0")


def test_panel(show, eight):
    """The panel can be put away; the picture then takes its place."""
    page = show(eight)
    middle = (
        "replay.scene.draw(0, 10); return replay.scene.renderer.project(replay.scene.state.cm)[0]"
    )
    before = page.run(middle)
    page.click("#more")
    assert page.run("return document.getElementById('panel').offsetWidth") == 0
    assert page.run(middle) > before + 80
    page.click("#more")


# -- unusual flights


@pytest.mark.parametrize(
    "flight",
    [
        pytest.param({"n": 1}, id="one vehicle"),
        pytest.param({"n": 4, "seconds": 0.2}, id="short"),
        pytest.param(
            {"n": 3, "complete": False, "ending": "the flight <b>stopped</b>: far"}, id="incomplete"
        ),
        pytest.param({"n": 700}, id="hundreds"),
    ],
)
def test_unusual(show, flight):
    """One vehicle, a tenth of a second, a flight that stopped, hundreds: each is shown without an error."""
    result = swarm(flight.pop("n"), flight.pop("seconds", 10.0), **flight)
    page = show(result, "")
    page.wait("return replay.pictures > 0 && replay.time > 0")
    assert page.heard() == []
    if not result.complete:
        assert page.text("#ending") == "Incomplete: the flight <b>stopped</b>"


def test_no_webgl(tmp_path, eight):
    """Where a browser cannot draw, the page says so and what to do."""
    browser = started(tmp_path / "chromium", "--disable-3d-apis")
    try:
        replay(eight, tmp_path / "page.html")
        browser.driver.get((tmp_path / "page.html").as_uri())
        browser.wait("return !document.getElementById('notice').hidden")
        assert "WebGL 2" in browser.text("#notice")
    finally:
        browser.driver.quit()


def test_hundreds(show):
    """200 vehicles are drawn picture after picture, without any graphics card."""
    page = show(swarm(200, 60.0), "t=20")
    page.run("replay.scene.renderer.effort = 0.5; replay.play(true)")
    pictures = page.run("return replay.pictures")
    page.wait(f"return replay.pictures > {pictures} + 10", 60)


def test_without_a_graphics_card(show, eight):
    """The page knows that it is drawn in software, and does without what then takes long."""
    page = show(eight)
    assert page.run("return replay.scene.renderer.software")
    assert not page.run("return replay.scene.renderer.gl.getContextAttributes().antialias")
    assert page.run("return getComputedStyle(document.getElementById('bar')).boxShadow") == "none"


def test_a_crowd_is_dots_while_it_moves(show):
    """400 vehicles are dots while the picture moves, and have their shapes when it rests."""
    page = show(swarm(400, 1.0), "t=0.5")
    page.wait("return replay.scene.renderer.scale === 1 && !replay.stale")
    assert (
        page.run("return replay.scene.places.small.count + replay.scene.places.vehicles.count")
        == 400
    )
    moving = "const s = replay.scene; s.renderer.scale = 0.5; s.draw(0.5, 0); return s.places.small.count"
    assert page.run(moving) == 0
    assert page.run("return replay.scene.swarm.count") == 400
    assert page.heard() == []


def test_a_swarm(show):
    """Thousands are dots, except those near the eye; the page has no more columns than it draws."""
    page = show(swarm(3001, 0.5), "t=0.2")
    assert "Vehicles are dots" in page.text("#notes")
    assert not {"slot", "thrust"} & set(page.run("return Object.keys(replay.recording.widths)"))
    colours = """
        const { renderer, camera } = replay.scene, { gl } = renderer, pixel = new Uint8Array(4);
        replay.frame = () => {};
        replay.scene.draw(0.2, 0);
        const [x, y] = renderer.project(replay.scene.state.position.subarray(0, 3));
        const s = renderer.canvas.width / renderer.canvas.clientWidth;
        gl.readPixels(x * s, renderer.canvas.height - y * s, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
        return [Array.from(pixel).slice(0, 3), replay.scene.colours[0].map((c) => 255 * c)];
    """
    drawn, own = page.run(colours)
    assert np.abs(np.array(drawn) - own).max() < 60  # light and haze change it a little
    assert page.run("return replay.scene.places.vehicles.count") == 0
    page.run(
        "replay.scene.camera.zoom = 0.03; replay.scene.camera.shown = null; replay.scene.draw(0.2, 0)"
    )
    assert page.run("return replay.scene.places.vehicles.count") > 0


def test_an_obstacle_comes_and_goes(show):
    """An obstacle that appears and vanishes is drawn while it is there, with its way; the overview shows it."""
    flown = swarm(4, 10.0)
    data = flown.mission.to_dict()
    ball: dict[str, Any] = {"kind": "sphere", "radius": 1.0, "appears": 3.0, "vanishes": 7.0}
    ball |= {"waypoints": [[0.0, 9.0, 12.0], [8.0, 9.0, 12.0]], "times": [3.0, 7.0]}
    far = {
        "kind": "sphere",
        "centre": [900.0, 0.0, 12.0],
        "radius": 1.0,
        "velocity": [50.0, 0.0, 0.0],
    }
    data["obstacles"] = [ball, far]
    page = show(replace(flown, mission_text=Mission.from_dict(data).text))
    drawn = """
        replay.scene.draw(arguments[0], 0);
        const { solid } = replay.scene.solids[0];
        return Array.from(solid.data.subarray(0, 3 * solid.count));
    """
    page.run("replay.frame = () => {}")
    assert page.run(drawn, 2.9) == []
    np.testing.assert_allclose(page.run(drawn, 5.0), [4.0, 9.0, 12.0], atol=1e-3)
    assert page.run(drawn, 7.1) == []
    sight = np.array(page.run("return replay.recording.info.sight"))
    assert sight[:, 0].max() < 50.0
    np.testing.assert_allclose([sight[:, 0].min(), sight[:, 0].max()], [-1.0, 9.0], atol=0.2)


def test_in_a_cell_of_a_notebook(browser, eight, tmp_path):
    """In a sandboxed frame that is hidden at first, the flight is seen as soon as the frame is."""
    frame = replay(eight)._repr_html_().replace('height="600"', 'height="100%"')
    page = tmp_path / "cell.html"
    page.write_text(f'<!doctype html><div id="cell" style="display: none">{frame}</div>', "utf-8")
    browser.driver.get(page.as_uri())
    time.sleep(1.0)
    cell = "document.querySelector('#cell').style.cssText = 'display: block; height: 600px'"
    browser.run(cell)
    browser.driver.switch_to.frame(0)
    try:
        browser.wait("return Boolean(window.replay)")
        seen = "return window.replay.scene.camera.shown?.distance"
        browser.wait(f"{seen.replace('return', 'return 0 <')} && {seen[7:]} < 1e4")
        assert browser.run("return window.origin") == "null"
        assert not [words for words in browser.heard() if "SEVERE" in words]
    finally:
        browser.driver.switch_to.default_content()


def test_a_word_is_read_at_night(show):
    """The picture, reduced to a cell a vehicle, is the word that is flown: upright, not mirrored, on a dark sky."""
    page = show(word(), "t=2.5")
    page.wait("return replay.scene.renderer.scale === 1 && !replay.stale")
    wide, high, pixels = page.run(
        """
        const { renderer } = replay.scene, { gl, canvas } = renderer;
        replay.scene.camera.shown = null;
        replay.scene.draw(2.5, 10);
        const data = new Uint8Array(4 * canvas.width * canvas.height);
        gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, data);
        const amber = [];
        for (let k = 0; k < data.length; k += 4) if (data[k] > 150 && data[k] - data[k + 2] > 80) amber.push(k / 4);
        return [canvas.width, canvas.height, amber];
        """
    )
    bright = np.zeros((high, wide), dtype=bool)
    bright.reshape(-1)[pixels] = True
    assert bitmap(bright[::-1]) == WORD
    sky = page.run(PIXEL, 2.5, [0.0, 0.0, 60.0])
    assert max(sky[:3]) < 40
    assert page.run("return document.documentElement.classList.contains('night')")
    assert page.heard() == []


# -- beside fences, and logs


def test_fences_people_and_falls_are_drawn(show, eight):
    """A border of people is purple, a wall of a tent reddish, and where a vehicle falls there is an amber cross."""
    flight = fenced(eight)
    page = show(flight)
    r, v = at(flight, "position", 20.0)[0], at(flight, "velocity", 20.0)[0]
    tau = (v[2] + np.sqrt(v[2] ** 2 + 2.0 * 9.81 * r[2])) / 9.81
    border, cross = [25.0, 11.0, 0.0], [*(r + tau * v)[:2].tolist(), 0.0]
    wall = [-25.0, 3.3, 4.7]
    tint = {}
    for on in (True, False):
        page.run(f"replay.scene.show.areas = {str(on).lower()}")
        red, green, blue, _ = page.run(PIXEL, 20.0, border)
        assert (blue - green > 50) == on
        red, _, blue, _ = page.run(PIXEL, 20.0, cross)
        assert (red - blue > 80) == on
        red, _, blue, _ = page.run(PIXEL, 20.0, wall)
        tint[on] = red - blue
    assert tint[True] > tint[False] + 5
    assert page.run("return document.querySelector('[data-show=areas]').checked")
    assert "where vehicles fall" in page.text("#notes")


def test_a_log_is_drawn_over_its_plan(show):
    """Who is surely off its slot has a red disc, its plan is a dark line beside its trail, and its halo may be seen."""
    flight = drifting(4, 2, 20.0, 40.0, 1.5, 0.4)
    page = show(flight, "t=30&camera=top")
    count = "replay.scene.draw(arguments[0], 10); return replay.scene.places[arguments[1]].count"
    assert [page.run(count, t, "discs") for t in (10.0, 30.0, 50.0)] == [0, 1, 0]
    assert page.run(count, 30.0, "ballVeils") == 4
    page.run(
        "for (const name of ['slots', 'edges', 'names', 'axes']) replay.scene.show[name] = false"
    )
    planned = at(flight, "slot_position", 28.5)[2].tolist()
    dark = page.run(PIXEL, 30.0, planned)
    page.run("replay.scene.show.trails = false")
    assert np.subtract(page.run(PIXEL, 30.0, planned), dark)[:3].min() > 30
    beside = (at(flight, "position", 30.0)[2] + [0.0, 0.45, 0.0]).tolist()
    halo = page.run(PIXEL, 30.0, beside)
    page.run("replay.recording.columns.doubt.fill(0)")
    assert np.abs(np.subtract(halo, page.run(PIXEL, 30.0, beside))).max() > 15


def test_drifts_are_on_the_timeline(show, eight):
    """A mark above the slider says who was off its slot and when; a click goes there. Other flights have no marks."""
    page = show(drifting(4, 2, 20.0, 40.0, 1.5, 0.4), "t=0")
    title = page.run("return document.querySelector('#drifts button').title")
    assert title.startswith("Agent 3 is off its slot (20.0 to 40.0 s)")
    mark, line = (
        page.run(
            f"const b = document.querySelector('{x}').getBoundingClientRect(); return [b.left, b.right]"
        )
        for x in ("#drifts button", "#drifts")
    )
    shares = np.subtract(mark, line[0]) / (line[1] - line[0])
    np.testing.assert_allclose(shares, [1 / 3, 2 / 3], atol=0.01)
    page.click("#drifts button")
    page.wait("return /Agent 3 off the plan/.test(document.querySelector('#notes').textContent)")
    assert 20.0 <= page.run("return replay.time") <= 40.0
    assert show(eight).run("return document.querySelector('#drifts').hidden")
