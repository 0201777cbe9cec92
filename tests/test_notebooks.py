"""The notebooks run from top to bottom, as notebooks do, and show what they say."""

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = ROOT / "examples" / "notebooks"


@pytest.fixture
def shell() -> Iterator[Any]:
    """What runs the cells of a notebook; it keeps no history."""
    from IPython.core.interactiveshell import InteractiveShell
    from traitlets.config import Config

    yield InteractiveShell.instance(config=Config({"HistoryManager": {"enabled": False}}))
    InteractiveShell.clear_instance()


def cells(path: Path) -> list[str]:
    """The code of a notebook, cell by cell."""
    spec = importlib.util.spec_from_file_location("notebook", ROOT / "docs" / "notebook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    import sys

    sys.modules["notebook"] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return [cell.text for cell in module.cells(path.read_text("utf-8")) if not cell.words]


def ran(shell: Any, code: str) -> tuple[str, list[dict[str, Any]]]:
    """What a cell prints, and what it shows: texts and pictures by their kind."""
    from IPython.utils.capture import capture_output

    with shell.display_trap, capture_output() as caught:  # outside of a cell, the trap comes first
        done = shell.run_cell(code)
    done.raise_error()
    # A thing that shows itself leaves an empty output behind.
    return caught.stdout, [output.data for output in caught.outputs if output.data]


@pytest.mark.long
@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.py")), ids=lambda path: path.stem)
def test_notebook(path, tmp_path, monkeypatch, shell):
    """Every cell runs, figures are shown without a magic line, and what is said to hold does."""
    monkeypatch.chdir(tmp_path)
    out, shown = "", []
    for code in cells(path):
        assert not code.startswith("%")
        printed, outputs = ran(shell, code)
        drawn = code.splitlines()[-1].startswith("plotting.")
        assert any("image/png" in data for data in outputs) == drawn, code
        out += printed
        shown += outputs
    names = shell.user_ns
    assert len([data for data in shown if "image/png" in data]) >= 2
    assert any("srcdoc" in data.get("text/html", "") for data in shown)
    if path.stem == "reproduce_the_paper":
        assert out.count("Passed") == 4  # triangle, waypoint, passage, mended cube
        assert "no cube" in out
        foretold, flown = 6.0 + 1.618 / names["p"], names["printed"].phases[-1].t_end
        assert flown == pytest.approx(foretold, abs=0.01)
    else:
        assert path.stem == "own_formation"
        assert names["verdict"].passed
        assert names["found"].rank < names["found"].needed == len(names["tempting"])
        assert names["chosen"].rank == names["chosen"].needed
        assert (tmp_path / "arrow.html").exists()
        assert len([data for data in shown if "<table>" in data.get("text/html", "")]) == 3


def test_cells_show_what_they_end_with(shell, monkeypatch):
    """Figures are pictures, several one below the other; mission, result and verdict tables; a replay is a frame."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    ran(shell, "import rigidfleet as rf\nfrom sample_flights import swarm\nflight = swarm(3, 4.0)")
    for code, kind, count in (
        ("rf.plot(flight, names=['cm', 'distances'])", "image/png", 2),
        ("rf.plot(flight, names=['cm'])[0]", "image/png", 1),
        ("flight", "text/html", 1),
        ("flight.mission", "text/html", 1),
        ("rf.assess(flight)", "text/html", 1),
        ("rf.check(flight.mission)", "text/html", 1),
        ("rf.replay(flight)", "text/html", 1),
    ):
        printed, outputs = ran(shell, code)
        assert not printed
        assert [kind in data for data in outputs] == [True] * count, code
        assert all(len(data["text/plain"]) < 120 for data in outputs)


def test_cells_are_marked():
    """Each notebook begins with words, and all of it lies in cells that editors know."""
    paths = sorted(NOTEBOOKS.glob("*.py"))
    assert len(paths) >= 2
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        assert lines[0] == "# %% [markdown]"
        assert lines[1].startswith("# # ")
        assert {line for line in lines if line.startswith("# %%")} == {"# %%", "# %% [markdown]"}
