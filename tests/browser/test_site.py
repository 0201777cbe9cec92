"""What the site's own script does in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest

pytestmark = pytest.mark.long

SCRIPT = Path(__file__).parents[2] / "docs" / "search.js"


def test_searches_from_a_file(browser, tmp_path):
    """On a page opened as a file, what the theme's search asks of a worker is answered, and in order."""
    worker = "let n = 0; addEventListener('message', ({ data }) => postMessage([data, n++]));"
    (tmp_path / "worker.js").write_text(worker)
    page = (
        f"<!doctype html><body><script src='{SCRIPT.as_uri()}'></script><script>window.found = [];"
        "const worker = new Worker(new URL('worker.js', location.href));"
        "worker.addEventListener('message', ({ data }) => found.push(data));"
        "for (const word of ['index', 'one', 'two']) worker.postMessage(word);</script>"
    )
    (tmp_path / "page.html").write_text(page)
    browser.open((tmp_path / "page.html").as_uri(), ready="window.found?.length === 3")
    assert browser.run("return found") == [["index", 0], ["one", 1], ["two", 2]]
    browser.run("worker.postMessage('three')")
    browser.wait("return found.length === 4")
    assert browser.heard() == []
