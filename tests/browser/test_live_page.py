"""The live flight in a real browser: what the page's controls do, the flight does."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from chromium import Browser

from rigidfleet.mission import load_mission
from rigidfleet.web.live import session as sessions
from rigidfleet.web.live.server import Server
from rigidfleet.web.live.session import Session

pytestmark = pytest.mark.long

#: Colour of errors (`--alert` of the page).
ALERT = "rgb(176, 0, 32)"


#: Whether a vehicle was ever seen more than 0.1 m from its slot. The gust that a slow page asks about is gone.
MOVED = """
    const { recording } = replay;
    for (let t = recording.start; t <= recording.end; t += 0.05) {
      if (Math.hypot(...recording.at(t).slot) > 0.1) return true;
    }
    return false;
"""


@pytest.fixture
def session(monkeypatch) -> Iterator[Session]:
    """A flight, flown while the test lasts."""
    monkeypatch.setattr(sessions, "_PATIENCE", 60.0)  # a slow page may take long to load again
    session = Session(load_mission("narrow-passage"))
    thread = threading.Thread(target=session.run)
    thread.start()
    yield session
    session.stop()
    thread.join(60)
    assert not thread.is_alive()


@pytest.fixture
def page(session, browser) -> Iterator[Browser]:
    """The flight's page."""
    with Server(session) as server:
        browser.open(server.url)
        yield browser
        browser.driver.get("about:blank")


def until(condition, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_shows_the_flight(page, session):
    """The page loads without an error, asks nobody but its flight, and its time goes on."""
    t = page.run("return replay.time")
    page.wait(f"return replay.time > {t} + 1")
    assert page.text("#phase-name") in {"establish triangle", "holding triangle"}
    assert page.heard() == []
    assert {
        url.split("/")[2] for url in page.asked() if not url.startswith(("data:", "blob:"))
    } <= {page.run("return location.host")}


def test_pad_moves_the_target(page, session):
    """Pushed away from the eye, the pad moves the target away from the eye; let go, it rests."""
    from selenium.webdriver import ActionChains

    start = session.pilot.target.r.copy()
    pad = page.driver.find_element("css selector", "#pad")
    hold = ActionChains(page.driver).move_to_element(pad).click_and_hold().move_by_offset(0, -40)
    hold.perform()
    until(lambda: abs(session.pilot.target.r - start).max() > 0.5)
    ActionChains(page.driver).release().perform()
    until(lambda: not session.pilot.target.move.any())
    way = session.pilot.target.r - start
    forward = page.run("return replay.view()[0]")
    assert way[:2] @ forward > 0.9 * abs(way).max()
    assert way[2] == 0.0


def test_lever_and_keys_turn(page, session):
    """A lever turns the target until it is let go; so do keys."""
    yaw = session.pilot.target.euler[2]
    page.run(
        "const l = document.querySelector('[data-lever=yaw]'); l.value = 1; l.dispatchEvent(new Event('input'))"
    )
    until(lambda: session.pilot.target.euler[2] > yaw + 0.1)
    page.run("document.querySelector('[data-lever=yaw]').dispatchEvent(new Event('pointerup'))")
    until(lambda: not session.pilot.target.turn.any())
    yaw = session.pilot.target.euler[2]
    page.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'e', bubbles: true }))")
    until(lambda: session.pilot.target.euler[2] < yaw - 0.1)
    page.run("document.dispatchEvent(new KeyboardEvent('keyup', { key: 'e', bubbles: true }))")
    until(lambda: not session.pilot.target.turn.any())


def test_formation(page, session):
    """A formation's button has it taken once the one before is there; the page shows both."""
    session.paused = True  # the triangle is not there yet, however slow the page is
    page.click("[data-formation=line]")
    page.wait("return document.querySelector('[data-formation=line]').className === 'waiting'")
    session.paused = False
    page.wait(
        "return document.querySelector('[data-formation=line]').getAttribute('aria-pressed') === 'true'"
    )
    assert session.pilot.formation == "line"
    page.wait("return document.getElementById('phase-name').textContent.endsWith(' line')")
    assert page.text("#phases button:last-child") == "change to line"


def test_gust(page, session):
    """A gust from the left blows to the right of the picture, as strong as asked."""
    session.paused = True  # the gust has not passed when it is looked at
    page.run("document.getElementById('strength').value = '5'")
    page.run(
        "[...document.querySelectorAll('#fly button')].find((b) => b.textContent === 'the left').click()"
    )
    until(lambda: session.pilot.gusts)
    gust = session.pilot.gusts[0]
    left = page.run("return replay.view()[1]")
    assert gust.direction[:2] @ left == pytest.approx(-1.0)
    assert gust.strength == 5.0
    session.paused = False
    page.wait(MOVED)


def place_ball(page, session, x=180, y=120):
    """Add a ball by a click beside the middle of the picture, once the formation is there."""
    from selenium.webdriver import ActionChains

    page.wait("return !replay.recording.info.busy")
    page.click("#add-ball")
    page.wait("return document.getElementById('word').textContent.startsWith('Click')")
    view = page.driver.find_element("css selector", "#view")
    ActionChains(page.driver).move_to_element_with_offset(view, x, y).click().perform()
    page.wait("return replay.recording.info.balls.length === 1")
    page.wait("return !Number.isNaN(replay.scene.state.balls[0])")
    return session.pilot.balls[0]


def test_a_ball_is_put_drawn_and_removed(page, session):
    """A click puts a ball of the chosen size at the formation's height; it is drawn about, and removed."""
    from selenium.webdriver import ActionChains

    page.run(
        "const s = document.getElementById('radius'); s.value = '0.7'; s.dispatchEvent(new Event('input'))"
    )
    ball = place_ball(page, session)
    assert ball.radius == 0.7
    height = page.run("return replay.recording.at(replay.recording.end).cm[2]")
    assert ball.place[2] == pytest.approx(height, abs=0.05)
    at = "const b = replay.scene.state.balls; return replay.scene.renderer.project([b[0], b[1], b[2]])"
    x, y, _ = page.run(at)
    before = ball.place.copy()
    width, height = page.run("return [view.clientWidth, view.clientHeight]")
    view = page.driver.find_element("css selector", "#view")
    middle = round(x - width / 2), round(y - height / 2)
    press = ActionChains(page.driver).move_to_element_with_offset(view, *middle)
    press.click_and_hold().move_by_offset(60, 20).release().perform()
    until(lambda: abs(ball.place - before).max() > 0.3)
    until(lambda: not ball.velocity.any())
    assert ball.place[2] == pytest.approx(before[2], abs=1e-2)
    page.wait(f"const f = () => {{ {at} }}; const p = f(); return p && p[0] > {x} + 20")
    page.click("#remove-ball")
    until(lambda: not session.pilot.flying_balls)
    page.wait("return Number.isNaN(replay.scene.state.balls[0])")
    assert page.run("return document.getElementById('remove-ball').disabled")
    assert page.heard() == []


def test_a_refused_ball_says_why(page, session):
    """Where a ball would touch a vehicle it is refused; the page says why, until a command is taken."""
    session.paused = True
    page.wait("return replay.recording.info.paused")
    page.run("document.getElementById('radius').value = '5'")
    page.press("b")
    page.wait("return document.getElementById('word').textContent.startsWith('Click')")
    assert colour(page, "word") != ALERT  # what to do next is no error
    page.click("#view")
    page.wait("return document.getElementById('word').textContent.includes('at least 1 m away')")
    assert colour(page, "word") == ALERT
    assert session.pilot.balls == []
    page.click("#play")
    page.wait("return document.getElementById('word').hidden")


def colour(page, name):
    """Colour of an element's letters."""
    return page.run(f"return getComputedStyle(document.getElementById('{name}')).color")


def test_contact_ends_the_flight_in_words(page, session):
    """Whoever meets what ends the flight, in the page's own words."""
    session.pilot.flight.ending = "agent 3 met 'left' at 4.20 s"
    page.wait("return !document.getElementById('ending').hidden")
    assert page.text("#ending") == "Incomplete: agent 3 met 'left' at 4.20 s"
    assert colour(page, "ending") == ALERT


def test_held_off(page, session):
    """A target that is held off by the ground is said to be."""
    session.pilot.held_off = "ground"
    page.wait(
        "return document.getElementById('word').textContent === \"The target stays out of 'ground'\""
    )


def test_pause_and_speed(page, session):
    """The flight pauses and goes on, slower or faster."""
    page.click("#play")
    until(lambda: session.paused)
    page.wait("return document.getElementById('play').getAttribute('aria-label') === 'Play'")
    t = session.pilot.t
    time.sleep(0.3)
    assert session.pilot.t == t
    page.click("#play")
    until(lambda: session.pilot.t > t)
    page.run(
        "const s = document.getElementById('speed'); s.value = '0.25'; s.dispatchEvent(new Event('change'))"
    )
    until(lambda: session.speed == 0.25)


def test_space_after_a_click(page, session):
    """Space plays, whatever was clicked before: a formation's button is not pressed again."""
    from selenium.webdriver import ActionChains

    page.click("[data-formation=line]")
    page.wait(
        "return document.querySelector('[data-formation=line]').getAttribute('aria-pressed') === 'true'"
    )
    session.paused = True  # the change is not complete, however slow the page is
    page.click("[data-formation=triangle]")
    page.wait("return document.querySelector('[data-formation=triangle]').className === 'waiting'")
    page.click("[data-formation=line]")
    until(lambda: session.pilot.waiting is None)
    session.pilot.change_formation("triangle")
    page.wait("return document.getElementById('play').getAttribute('aria-label') === 'Play'")
    ActionChains(page.driver).send_keys(" ").perform()
    until(lambda: not session.paused)
    # Pressed again, the button would have cancelled it.
    assert "triangle" in {session.pilot.waiting, session.pilot.formation}


def test_keys_are_listed(page, session):
    """The list of keys has those that fly."""
    page.click("#keys")
    words = page.text("#help-list")
    assert "W A S D" in words
    assert "Q E" in words


def test_look_back(page, session):
    """The slider looks back while the flight goes on; Live returns to the present."""
    page.wait("return replay.recording.end > replay.recording.start + 2")
    page.run(
        "const s = document.getElementById('scrub'); s.value = s.min; s.dispatchEvent(new Event('input'))"
    )
    t = session.pilot.t
    until(lambda: session.pilot.t > t + 0.5)
    assert page.run("return replay.time - replay.recording.start") < 0.1
    page.wait("return document.getElementById('whole').textContent.endsWith('ago')")
    page.click("#now")
    page.wait("return replay.recording.end - replay.time < 0.5")


def test_plots(page, session):
    """Thrust, constraint error and clearance are drawn as they come."""
    titles = page.run("return [...document.querySelectorAll('.plot h2')].map((h) => h.textContent)")
    assert titles == ["Greatest thrust", "Constraint error", "Separation", "Clearance"]
    picture = "return document.querySelector('.plot canvas').toDataURL()"
    before = page.run(picture)
    page.wait(f"return document.querySelector('.plot canvas').toDataURL() !== '{before}'")
    assert page.text(".plot output").endswith(" N")


def test_again(page, session):
    """A flight can be begun anew."""
    page.wait("return replay.recording.end > 2")
    page.run("window.before = true")
    page.click("#again")
    page.wait("return Boolean(window.replay) && !window.before")
    assert session.flights == 2


def test_end(page, session):
    """The flight ends when asked, and the page says so; what was flown can still be looked at."""
    page.wait("return replay.recording.end > 1")
    page.click("#end")
    page.wait(
        "return document.getElementById('ending').textContent.startsWith('The flight has ended')"
    )
    assert session.stopped.is_set()
    assert colour(page, "ending") != ALERT  # a flight that was ended and saved is a success
    assert page.run("return document.getElementById('fly').hidden")
    page.run(
        "const s = document.getElementById('scrub'); s.value = s.min; s.dispatchEvent(new Event('input'))"
    )
    page.wait("return replay.scene.state.time === replay.recording.start")


def test_end_says_where(browser):
    """At its end the page says where the flight is saved."""
    session = Session(
        load_mission("narrow-passage"), lambda result: "It is saved in <b>flights</b>/x.nc."
    )
    thread = threading.Thread(target=session.run)
    thread.start()
    with Server(session) as server:
        browser.open(server.url)
        browser.wait("return replay.recording.end > 1")
        browser.click("#end")
        browser.wait("return document.getElementById('ending').textContent.includes('It is saved')")
        assert browser.text("#ending").endswith("It is saved in <b>flights</b>/x.nc.")
        browser.driver.get("about:blank")
    thread.join(60)


def test_quadrotors(browser):
    """Quadrotors fly by hand: they and their rotors are drawn and plotted; gusts and changes of formation work."""
    session = Session(load_mission("passage-quadrotors"))
    thread = threading.Thread(target=session.run)
    thread.start()
    try:
        with Server(session) as server:
            browser.open(server.url)
            browser.wait("return replay.recording.end > 1")
            titles = browser.run(
                "return [...document.querySelectorAll('.plot h2')].map((h) => h.textContent)"
            )
            assert titles[:2] == ["Rotors, share of limit", "Tracking error"]
            drawn = (
                "replay.scene.draw(replay.time, 0); const { turned, small, noses } = replay.scene.places;"
                "return [turned.count + small.count, noses.count]"
            )
            assert browser.run(drawn) == [3, 3]
            browser.click("[data-formation=line]")
            until(lambda: session.pilot.formation == "line")
            browser.run(
                "[...document.querySelectorAll('#fly button')].find((b) => b.textContent === 'behind').click()"
            )
            browser.wait(MOVED)
            assert session.pilot.flight.ending == ""
            assert browser.heard() == []
            browser.driver.get("about:blank")
    finally:
        session.stop()
        thread.join(60)


def test_tab_closed(session, browser, monkeypatch):
    """When the last page is closed, the flight ends."""
    monkeypatch.setattr(sessions, "_PATIENCE", 0.5)
    with Server(session) as server:
        browser.open(server.url)
        browser.driver.get("about:blank")
        until(session.stopped.is_set)


def test_narrow_pages_keep_the_flight_in_sight(page):
    """On a telephone the controls lie below the vehicles, without overlap; the panel takes their place."""
    box = (
        "(id => { const b = document.getElementById(id).getBoundingClientRect();"
        " return [b.left, b.top, b.right, b.bottom] })"
    )
    page.driver.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": 400, "height": 800, "deviceScaleFactor": 1, "mobile": True},
    )
    try:
        page.wait("return innerWidth === 400")
        page.wait(f"return {box}('fly')[3] < {box}('bar')[1]")
        _, top, right, _ = page.run(f"return {box}('fly')")
        assert top > 400
        assert right <= 400
        middle = "const { camera } = replay.scene; return innerHeight * (1 - camera.centre[1]) / 2"
        assert page.run(middle) < top
        page.click("#more")
        assert page.run("return document.getElementById('fly').offsetHeight") == 0
        assert page.run(f"return {box}('panel')[3]") < page.run(f"return {box}('bar')[1]")
    finally:
        page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
