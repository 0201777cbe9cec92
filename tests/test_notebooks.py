"""The notebooks run from top to bottom, as scripts, and show what they say."""

import runpy
from pathlib import Path

import pytest

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


@pytest.mark.long
@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.py")), ids=lambda path: path.stem)
def test_notebook(path, tmp_path, monkeypatch, capsys):
    """Every cell runs, and what is said to hold does."""
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(path))
    out = capsys.readouterr().out
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


def test_cells_are_marked():
    """Each notebook begins with words, and all of it lies in cells that editors know."""
    paths = sorted(NOTEBOOKS.glob("*.py"))
    assert len(paths) >= 2
    for path in paths:
        lines = path.read_text(encoding="utf-8").splitlines()
        assert lines[0] == "# %% [markdown]"
        assert lines[1].startswith("# # ")
        assert {line for line in lines if line.startswith("# %%")} == {"# %%", "# %% [markdown]"}
