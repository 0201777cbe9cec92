import pickle

import pytest

from rigidfleet.errors import Finding, FlightError, MissionError, ResultError, RigidfleetError

MASS = Finding("fold.toml", "agents.mass", -1, "a mass must be positive", "give it in [kg]")
EDGE = Finding("fold.toml", "formations.line.edges[2]", [3, 3], "an edge joins two agents", "")


def test_finding_tells_where_what_and_remedy():
    """A finding reads: file, key, value, what is wrong; the remedy stands below."""
    assert str(MASS) == "fold.toml: agents.mass = -1: a mass must be positive\n    give it in [kg]"
    assert str(EDGE) == "fold.toml: formations.line.edges[2] = [3, 3]: an edge joins two agents"


def test_finding_leaves_out_what_it_does_not_know():
    """Without a file, a key or a value, no empty mark stands for it."""
    assert str(Finding("", "phases", None, "is missing", "")) == "phases: is missing"
    assert str(Finding("", "", None, "no such mission", "")) == "no such mission"


def test_finding_shortens_long_values_and_spells_as_toml():
    """A long value is cut to one line's length; true and false are written as in the file."""
    long = str(Finding("", "slots", [[0.0, 1.0, 2.0]] * 99, "too many", ""))
    assert "..." in long
    assert len(long) < 100
    assert str(Finding("", "agents.saturate", True, "no limit", "")).startswith(
        "agents.saturate = true:"
    )


def test_mission_error_carries_every_finding():
    """Everything wrong with a mission is shown at once and stays at hand one by one."""
    error = MissionError([MASS, EDGE])
    assert error.findings == (MASS, EDGE)
    assert str(error) == f"{MASS}\n{EDGE}"


def test_mission_error_crosses_processes():
    """A mission error comes back whole from a worker process."""
    error = pickle.loads(pickle.dumps(MissionError([MASS, EDGE])))
    assert error.findings == (MASS, EDGE)


def test_mission_error_needs_a_finding():
    """An error without a reason cannot be made."""
    with pytest.raises(ValueError, match="at least one finding"):
        MissionError([])


@pytest.mark.parametrize("kind", [MissionError, ResultError, FlightError])
def test_one_base(kind):
    """`except RigidfleetError` catches all that rigidfleet tells its user."""
    assert issubclass(kind, RigidfleetError)
