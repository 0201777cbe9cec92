"""A browser for all tests, and pages in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from chromium import Browser, started
from sample_flights import swarm


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Try the tests of this folder again: on a busy machine a browser may stall for a minute."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.flaky(reruns=2))


@pytest.fixture(scope="session")
def browser(tmp_path_factory) -> Iterator[Browser]:
    browser = started(tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.driver.quit()


@pytest.fixture(scope="session")
def show(browser, tmp_path_factory) -> Callable[..., Browser]:
    """Open the replay of a result; `where` is the part of the address after #."""
    from rigidfleet.web.replay import replay

    folder = tmp_path_factory.mktemp("pages")
    written: dict[int, tuple[Any, Path]] = {}  # with the result, whose id nobody else has meanwhile

    def shown(result: Any, where: str = "t=0") -> Browser:
        if id(result) not in written:
            written[id(result)] = result, folder / f"{len(written)}.html"
            replay(*written[id(result)])
        browser.open(f"{written[id(result)][1].as_uri()}#{where}")
        return browser

    return shown


@pytest.fixture(scope="session")
def eight() -> Any:
    """Eight vehicles for 90 s."""
    return swarm(8, 90.0)
