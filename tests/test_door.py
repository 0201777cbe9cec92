"""What comes in means what its maker meant, is refused for the true cause, or is doubted in a note.

`door.py` writes mutants of flights that are known, whose meaning it knows, too.
"""

from collections.abc import Sequence

import door
import pytest

#: Mutants of each operator: of the quick test, and of the long one.
FEW, MANY = 2, 112


def explained(cases: Sequence[door.Case]) -> str:
    """Cases in a line each, with the command that shows one."""
    return "\n".join(
        f"python tests/door.py --show {c.key}: {c.operator}, {c.mutant.variant}: {c.grade}"
        for c in cases
    )


def check(cases: Sequence[door.Case]) -> None:
    """Fail if a mutant is misread, or too many that keep the meaning are refused."""
    bad = door.faults(cases)
    assert not bad, explained(bad)
    refused = [c for c in cases if c.mutant.keeps and c.grade != "same"]
    assert door.kept_share(cases) >= door.KEPT, explained(refused)


def test_originals_are_accepted() -> None:
    """Verdict, least distance and greatest speed of known flights are those of splines of another library."""
    assert door.misread(1, 16) == []


@pytest.mark.parametrize("operator", door.OPERATORS)
def test_few_mutants(operator: str) -> None:
    """Mutants that keep the meaning are read as their original; the others are judged, refused or noted."""
    first = list(door.OPERATORS).index(operator)
    cases = [door.case(1, first + k * len(door.OPERATORS)) for k in range(FEW)]
    assert door.faults(cases) == [], explained(door.faults(cases))


@pytest.mark.long
def test_many_mutants() -> None:
    """Of 2,000 mutants 95 % of those that keep the meaning are read; none is misread, none passes in silence."""
    assert door.misread(2) == []
    cases = [door.case(2, key) for key in range(MANY * len(door.OPERATORS))]
    assert min(row["all"] for row in door.summary(cases).values()) >= 100
    check(cases)
