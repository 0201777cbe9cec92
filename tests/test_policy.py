"""What the pages that are written hold of users' words, and what they may do: web/policy.py, and all that uses it."""

import base64
import hashlib
import html.parser
import json
import re
from collections.abc import Callable
from importlib import resources

import pytest
from sample_flights import swarm

from rigidfleet import plotting
from rigidfleet.mission import Mission
from rigidfleet.reporting import report_page
from rigidfleet.result import PhaseRecord, Result
from rigidfleet.web.live.session import Session
from rigidfleet.web.policy import content_policy
from rigidfleet.web.replay import replay_page

#: What has been got through into pages elsewhere: ends of elements, handlers, comments, templates, odd lines.
HOSTILE = (
    "</script><script>window.hacked=1</script>",
    "<img src=x onerror=window.hacked=1>",
    "\"><svg onload='window.hacked=1'>",
    "</style></title></textarea><iframe src=javascript:hacked=1>",
    "<!--<script>",
    "]]>--><b>&amp;&#60;",
    "${window.hacked=1}`'\\u003cb",
    "{{ 7 * 7 }}{% raw %}{data}{policy}",
    "\u2028\u2029\u202e\ufeff<b>",
)


def mission(word: Callable[[str], str]) -> Mission:
    """Two vehicles, with `word` of each place where a mission holds a user's words."""
    return Mission.from_dict(
        {
            "schema_version": 1,
            "name": "words",
            "title": word("title"),
            "source": word("source"),
            "agents": {"mass": 1.0, "position": [[0, 0, 3], [4, 0, 3]], "thrust_limit": 20.0},
            "formations": {word("pair"): {"slots": [[-2, 0, 0], [2, 0, 0]]}},
            "obstacles": [
                {"kind": "ground", "name": word("ground")},
                {"kind": "box", "name": word("box"), "min": [9, 9, 0], "max": [10, 10, 5]},
            ],
            "phases": [
                {
                    "kind": "establish",
                    "name": word("first"),
                    "formation": word("pair"),
                    "until": 5.0,
                },
                {"kind": "fly", "name": word("second"), "position": [5, 0, 5], "until": 10.0},
            ],
        }
    )


def flight(word: Callable[[str], str]) -> Result:
    """Its flight, made up; words stand also where a result holds some that no mission checks."""
    target = {"time": 10.0, "position": [5.0, 0.0, 5.0]}
    pair = word("pair")
    phases = [
        PhaseRecord(word("first"), "establish", "tracking", pair, 0.0, 5.0),
        PhaseRecord(word("second"), "fly", "tracking", pair, 5.0, 10.0, None, target),
    ]
    return swarm(
        2,
        10.0,
        phases=phases,
        mission_text=mission(word).text,
        complete=False,
        ending=word("ending"),
        platform=word("platform"),
        versions={"rigidfleet": word("version"), "numpy": word("other")},
        created=word("created"),
    )


def live_page(word: Callable[[str], str]) -> str:
    return Session(mission(word)).html()


PAGES = {
    "replay": lambda word: replay_page(flight(word)),
    "report": lambda word: report_page(flight(word)),
    "comparison": lambda word: report_page(
        [flight(word)] * 2, labels=[word("label"), word("other label")]
    ),
    "live": live_page,
}


@pytest.fixture
def quick(monkeypatch):
    """Figures of a flight in no time."""

    def draw(result, folder, *, formats, names):
        for name in names:
            (folder / f"{name}.svg").write_text("<svg/>", encoding="utf-8")

    from pathlib import Path

    monkeypatch.setattr(plotting, "plot", lambda r, folder, **k: draw(r, Path(folder), **k))


class Parts(html.parser.HTMLParser):
    """Elements of a page with the names of their attributes, its policy, texts of styles and scripts, and words."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, ...]] = []
        self.attributes: list[tuple[str, str]] = []
        self.policy: dict[str, str] = {}
        self.inside: dict[str, list[str]] = {"style": [], "script": [], "data": []}
        self.words: list[str] = []
        self.open = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.elements.append((tag, *sorted(given)))
        self.attributes += [(name, value or "") for name, value in attrs]
        if given.get("http-equiv") == "Content-Security-Policy":
            assert not any(self.inside.values())  # it stands before what it governs
            for rule in (given["content"] or "").split("; "):
                what, _, who = rule.partition(" ")
                assert what not in self.policy
                self.policy[what] = who
        self.open = "data" if tag == "script" and given.get("type") != "module" else tag
        if self.open in self.inside:
            self.inside[self.open].append("")

    def handle_endtag(self, tag):
        self.open = ""

    def handle_data(self, data):
        if self.open in self.inside:
            self.inside[self.open][-1] += data
        else:
            self.words.append(data)


def digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@pytest.mark.parametrize("page", PAGES)
def test_policy_names_what_is_there(page, quick):
    """A page runs the one script and takes the one style that it holds, by their digests, and nothing else."""
    parts = Parts(PAGES[page](str))
    has_script = page in ("replay", "live")
    assert [digest(text) for text in parts.inside["style"]] == [parts.policy["style-src"]]
    scripts = [digest(text) for text in parts.inside["script"]]
    assert scripts == ([parts.policy["script-src"]] if has_script else [])
    assert parts.policy["default-src"] == parts.policy["base-uri"] == "'none'"
    assert parts.policy["form-action"] == "'none'"
    assert parts.policy["img-src"] == "data:"
    assert parts.policy.get("connect-src", "'none'") == ("'self'" if page == "live" else "'none'")
    assert "unsafe" not in str(parts.policy)
    if has_script:
        assert parts.policy["require-trusted-types-for"] == "'script'"
    # No attribute is a style, a handler, or an address elsewhere: the policy would refuse it.
    for name, value in parts.attributes:
        assert name != "style"
        assert not name.startswith("on")
        assert name not in ("src", "href") or value.startswith("data:")


@pytest.mark.parametrize(
    ("page", "hostile"),
    [(page, words) for page in ("replay", "live") for words in HOSTILE]
    # Figures take their time: all at once.
    + [(page, " ".join(HOSTILE)) for page in ("report", "comparison")],
)
def test_words_are_words(page, hostile, quick):
    """Whatever users write, a page has the same elements, attributes, scripts and policy as with calm words."""
    calm = Parts(PAGES[page](str))
    found = Parts(PAGES[page](lambda place: f"{place} {hostile}"))
    assert found.elements == calm.elements
    assert found.policy == calm.policy
    assert found.inside["script"] == calm.inside["script"]
    assert found.inside["style"] == calm.inside["style"]
    if page in ("replay", "live"):
        info = json.loads(found.inside["data"][0])
        assert info["title"] == f"title {hostile}"
        assert [box["name"] for box in info["boxes"]] == [f"box {hostile}"]
        if page == "replay":
            assert info["phases"][0]["name"] == f"first {hostile}"
            assert info["ending"] == f"ending {hostile}"
        else:
            assert info["formations"] == [f"pair {hostile}"]
    elif page == "report":
        words = "".join(found.words)
        for place in ("title", "source", "first", "second", "ending"):
            assert f"{place} {hostile}" in words, place


def test_events_are_lines():
    """No word of a user can end an event of the live flight's stream and begin another."""
    session = Session(mission(lambda place: f'{place}\u2028\u0085"event: end</script>'))
    message = session.add_page().get()
    assert message is not None
    event = message.decode()
    assert re.fullmatch(r"event: story\ndata: [^\n\r]*\n\n", event)
    assert event.isascii()


def test_scripts_make_no_mark_up():
    """No script of ours makes mark-up or code out of text, nor holds what would end or hide it in a page."""
    for package in ("replay", "live"):
        for file in resources.files(f"rigidfleet.web.{package}").iterdir():
            if file.name.endswith((".js", ".css")):
                text = file.read_text(encoding="utf-8")
                sinks = r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\b|new Function|</|<!--"
                assert not re.findall(sinks, text), file.name


def test_policy_is_of_the_text():
    """Another style or script is another policy."""
    one = content_policy(style="a{}", script="1")
    assert digest("a{}") in one
    assert digest("1") in one
    assert content_policy(style="b{}", script="1") != one != content_policy(style="a{}", script="2")
    assert "script-src" not in content_policy(style="a{}")
