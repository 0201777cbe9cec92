"""What MkDocs does besides: figures of the paper, notebooks, formulas without scripts, links into the repository.

Everything is made while the site is built, and the finished site asks nothing of any other host; that is
checked at the end.
"""

from __future__ import annotations

import html
import posixpath
import re
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import ziamath
from mkdocs.config.config_options import ExtraScriptValue
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))

import notebook  # noqa: E402

#: Pages made from files elsewhere in the repository.
COPIES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
#: Where links lead whose targets have no page of their own.
PLACES = {"README.md": "index.md", "examples": "examples/quickstart.md"}


# -- pages that are made -----------------------------------------------------------------------------


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add pages that are not files of the documents: copies, sources of examples, notebooks, figures."""

    def add(uri: str, content: str | bytes) -> None:
        files.append(File.generated(config, uri, content=content))

    for source, uri in COPIES.items():
        add(uri, (ROOT / source).read_text(encoding="utf-8"))
    languages = {".py": "python", ".toml": "toml"}
    for path in sorted(p for p in (ROOT / "examples").iterdir() if p.suffix in languages):
        text = path.read_text(encoding="utf-8")
        title = path.stem.replace("_", " ").capitalize()
        add(
            _page_of(f"examples/{path.name}"),
            f'# {title}\n\n```{languages[path.suffix]} title="examples/{path.name}"\n{text}```\n',
        )
    for path in sorted((ROOT / "examples" / "notebooks").glob("*.py")):
        pictures: dict[str, bytes] = {}
        uri = _page_of(f"examples/notebooks/{path.name}")
        add(uri, notebook.page(path, pictures))
        for name, content in pictures.items():
            add(posixpath.join(posixpath.dirname(uri), name), content)
    for name, content in _paper_figures().items():
        add(f"figures/{name}", content)
    return files


def _page_of(source: str) -> str:
    return posixpath.splitext(source)[0] + ".md"


@cache
def _paper_figures() -> dict[str, bytes]:
    """Every figure of the paper that a mission draws: file name and SVG."""
    import rigidfleet as rf
    from rigidfleet import plotting

    found: dict[str, bytes] = {}
    flown: dict[str, Any] = {}
    for row in _figure_rows():
        for mission in row["missions"]:
            for name in row["figures"]:
                file = f"{mission}-{name}.svg"
                if file not in found:
                    if mission not in flown:
                        flown[mission] = rf.simulate(rf.load_mission(mission))
                    found[file] = notebook.svg(getattr(plotting, name)(flown[mission]))
    return found


def _figure_rows() -> list[dict[str, Any]]:
    """The table of figures in paper.md."""
    text = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    section = text.split("\n## Figures\n")[1].split("\n## ")[0]
    rows = []
    for line in re.findall(r"^\|( \d.*)\|$", section, re.MULTILINE):
        number, what, mission, figure, _ = (cell.strip() for cell in line.split("|"))
        rows.append(
            {
                "number": number,
                "what": what,
                "missions": re.findall(r"`([\w-]+)`", mission),
                "figures": re.findall(r"`(\w+)`", figure) if mission else [],
                "words": figure,
            }
        )
    return rows


def _figures_page() -> str:
    """The paper's figures, each beside the command that makes it."""
    import rigidfleet.mission as missions

    parts = []
    for row in _figure_rows():
        parts.append(f"## Fig. {row['number']}: {row['what']}")
        if not row["figures"]:
            picture = re.search(r"\((images/[\w-]+\.svg)\)", row["words"])
            parts.append(f"![{row['what']}]({picture[1]})" if picture else row["words"])
            continue
        for mission in row["missions"]:
            title = tomllib.loads(missions.mission_text(mission))["title"]
            more = "" if {*row["figures"]} <= {"summary", "trajectory"} else " --figures all"
            parts.append(f"*{title}.*\n\n```sh\nrigidfleet run {mission}{more}\n```")
            for name in row["figures"]:
                parts.append(
                    f"![{name} of {mission}](figures/{mission}-{name}.svg)\n"
                    f'<span class="caption">flights/{mission}/figures/{name}.png</span>'
                )
    return "\n\n".join(parts)


# -- Markdown ----------------------------------------------------------------------------------------


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links to files of the repository lead to their pages; the figures of the paper are filled in."""
    if "<!-- figures of the paper -->" in markdown:
        markdown = markdown.replace("<!-- figures of the paper -->", _figures_page())
    # "[x, y, z] [m]" is no link.
    markdown = re.sub(
        r"^\|.*\|$", lambda m: m[0].replace("] [", "] \\["), markdown, flags=re.MULTILINE
    )
    here = page.file.src_uri
    source = {uri: path for path, uri in COPIES.items()}.get(here, f"docs/{here}")
    if here.startswith("examples/"):
        source = here

    def relink(match: re.Match[str]) -> str:
        words, (target, _, place) = match[1], match[2].partition("#")
        if not target or re.match(r"[a-z]+:", target) or target.startswith(("images/", "figures/")):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        uri = _uri(path)
        if uri is None:
            return match[0]
        if words == posixpath.basename(path) and path.endswith(".md"):
            words = _title(path)
        link = posixpath.relpath(uri, posixpath.dirname(here) or ".")
        return f"[{words}]({link}{'#' + place if place else ''})"

    return re.sub(r"\[([^\[\]]*)\]\(([^)\s]+)\)", relink, markdown)


@cache
def _title(path: str) -> str:
    """Heading of a page of the repository, which the site calls it by."""
    text = (ROOT / path).read_text(encoding="utf-8")
    return text.splitlines()[0].removeprefix("# ")


def _uri(path: str) -> str | None:
    """Place on the site of a file of the repository; None where it has none."""
    if path in PLACES:
        return PLACES[path]
    if path in COPIES:
        return COPIES[path]
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    return (
        _page_of(path) if path.startswith("examples/") and path.endswith((".py", ".toml")) else None
    )


# -- formulas ----------------------------------------------------------------------------------------


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Formulas as outlines, drawn here: no script, no font, no other host. Each letter once a page."""
    letters: dict[str, str] = {}

    def draw(match: re.Match[str]) -> str:
        block = match[1] == "div"
        tex = html.unescape(match[2]).strip()[2:-2].strip()
        return _formula(tex, letters, block=block)

    content = re.sub(
        r'<(div|span) class="arithmatex">(.*?)</\1>', draw, content, flags=re.DOTALL
    )  # fmt: skip
    if letters:
        shapes = "".join(letters.values())
        content = f'<svg class="letters" aria-hidden="true">{shapes}</svg>{content}'
    return content


def _formula(tex: str, letters: dict[str, str], *, block: bool) -> str:
    """A formula of TeX as SVG on the line of its text; its letters go into `letters`."""
    drawn = ziamath.Latex(tex, size=_SIZE, inline=not block, color="currentColor")
    svg = drawn.svg()

    def keep(match: re.Match[str]) -> str:
        letters.setdefault(match[1], match[0])
        return ""

    svg = re.sub(r'<symbol id="([^"]+)"[^>]*?(?:/>|>.*?</symbol>)', keep, svg, flags=re.DOTALL)
    box = re.search(r'viewBox="(\S+) (\S+) (\S+) (\S+)"', svg)
    _, top, width, height = (float(x) for x in box.groups()) if box else (0.0, 0.0, 0.0, 0.0)
    if not 0 < height < 100 * _SIZE:
        raise PluginError(f"the formula {tex} cannot be drawn")
    w, h, y = (x / _EM for x in (width, height, -(top + height)))  # the baseline is at 0
    style = f"width:{w:.3f}em;height:{h:.3f}em;vertical-align:{y:.3f}em"
    svg = re.sub(r'^<svg ([^>]*?)width="[^"]*" height="[^"]*"', rf'<svg \1style="{style}"', svg)
    svg = svg.replace("<svg ", f'<svg class="tex" role="img" aria-label="{html.escape(tex)}" ', 1)
    return f'<div class="formula">{svg}</div>' if block else svg


#: Size of a formula's letters as drawn, and what of it is an em of the text: STIX is a small face.
_SIZE, _EM = 24.0, 20.0


# -- the finished site -------------------------------------------------------------------------------


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Let pages that are opened as files search: the browser gives those no workers (see search.js)."""
    config.extra["polyfills"] = [ExtraScriptValue("search.js")]
    return config


def on_post_build(config: MkDocsConfig) -> None:
    """Write the index of the search as a script; fail if a page would load something from another host."""
    found = Path(config.site_dir) / "search" / "search_index.json"
    found.with_suffix(".js").write_text(
        f"var __index = {found.read_text(encoding='utf-8')}", encoding="utf-8"
    )
    loads = re.compile(
        r'<(?:script|img|iframe|source|video|audio|embed)\b[^>]*?\bsrc="((?:https?:)?//[^"]+)"'
        r'|<link\b(?![^>]*rel="canonical")[^>]*?\bhref="((?:https?:)?//[^"]+)"'
    )
    for path in Path(config.site_dir).rglob("*.html"):
        if found := loads.search(path.read_text(encoding="utf-8")):
            raise PluginError(f"{path.name} loads {found[1] or found[2]}")
