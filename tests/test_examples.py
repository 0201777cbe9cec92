"""The examples run, and show what their text says they show."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from rigidfleet import assess

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def example(request: pytest.FixtureRequest) -> Iterator[ModuleType]:
    """An example as a module."""
    name = f"example_{request.param}"
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{request.param}.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules[name]


def test_each_is_run():
    """No example is left without a test."""
    text = Path(__file__).read_text(encoding="utf-8")
    names = {path.stem for path in EXAMPLES.glob("*.py")}
    assert len(names) >= 4
    assert all(f'["{name}"]' in text for name in names)


@pytest.mark.long
@pytest.mark.parametrize("example", ["quickstart"], indirect=True)
def test_quickstart(example, tmp_path, capsys):
    """Four lines fly the narrow passage, pass the verdict and draw it."""
    result = example.main(tmp_path)
    assert result.complete
    assert "Passed" in capsys.readouterr().out
    assert list(tmp_path.glob("*.png"))


@pytest.mark.parametrize("example", ["own_controller"], indirect=True)
def test_own_controller(example):
    """A steady wind leaves the built-in law off by wind / (m k1), the PID nowhere."""
    misses = example.main()
    offset = float((example.WIND @ example.WIND) ** 0.5) / 2.0
    assert misses["built-in law"] == pytest.approx(offset, rel=1e-3)
    assert misses["own PID"] < 1e-3


@pytest.mark.parametrize("example", ["own_formation"], indirect=True)
def test_own_formation(example, capsys):
    """Five unequal vehicles fly a mission made in Python, and pass their verdict."""
    result = example.main()
    assert result.complete
    assert "Passed" in capsys.readouterr().out


@pytest.mark.parametrize("example", ["follow_a_file"], indirect=True)
def test_follow_a_file(example, capsys):
    """With the duration that check names, the mission passes; the result holds the trajectories."""
    example.main()
    printed = capsys.readouterr().out
    assert "the least duration of this phase is" in printed
    assert "Passed: all" in printed
    assert "kept in the result: True" in printed


@pytest.mark.parametrize("example", ["gusts"], indirect=True)
def test_gusts(example):
    """Idle in calm air, f_C holds the distances in gusts: all but wholly if it is told of them, by
    its feedback alone to less than half of what tracking leaves.
    """
    numbers = example.main()
    told, alone, blind = (numbers[f"gusts{s}"] for s in ("", ", tracking alone", ", f_C on board"))
    assert numbers["calm"]["f_C"] < 1e-9
    assert told["f_C"] == pytest.approx(0.47, abs=0.02)
    assert blind["f_C"] == pytest.approx(0.44, abs=0.02)
    assert told["pair"] < 1e-5
    assert alone["pair"] == pytest.approx(0.26, abs=0.01)
    assert blind["pair"] == pytest.approx(0.082, abs=0.005)
    # What all agents feel alike, f_C cannot answer.
    assert told["slot"] > 0.7 * alone["slot"]


@pytest.mark.parametrize("example", ["step_by_step"], indirect=True)
def test_step_by_step(example, capsys):
    """A target is changed on the way, and the flight passes: the one it left is no waypoint any more."""
    result = example.main()
    assert "half way" in capsys.readouterr().out
    assert result.complete
    assert [phase.kind for phase in result.phases] == ["establish", "fly", "fly"]
    assert result.phases[1].target is None
    assert assess(result).passed


@pytest.mark.parametrize("example", ["own_distributed_law"], indirect=True)
def test_own_distributed_law(example, tmp_path):
    """A squall takes one vehicle: whoever hears of it waits, with three in ten messages lost as well as with all."""
    errors = example.main(tmp_path)
    assert errors["each alone", 0.3] > 1.0
    for name in ("consensus", "gradient", "built-in"):
        assert errors[name, 0.3] < 0.5 * errors["each alone", 0.3]
        assert errors[name, 0.3] == pytest.approx(errors[name, 0.0], rel=0.15)
    assert (tmp_path / "own-laws.png").stat().st_size > 10_000
