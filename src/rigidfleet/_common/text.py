"""Words that messages of several modules share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def agent_names(indices: Iterable[int]) -> str:
    """Agents, counted from 0, as messages name them, counted from 1: "agent 1", "agents 1, 2 and 3"."""
    numbers = [str(i + 1) for i in indices]
    if len(numbers) == 1:
        return f"agent {numbers[0]}"
    return f"agents {', '.join(numbers[:-1])} and {numbers[-1]}"


def first_few(things: Sequence[object], most: int = 5, between: str = ", ") -> str:
    """The first of some things, and how many more there are: "a, b and 1,000 more"."""
    more = f" and {len(things) - most:,} more" if len(things) > most else ""
    return between.join(map(str, things[:most])) + more


def all_hold_in_words(count: int) -> str:
    """That all checks hold: "all 4 checks hold", "both checks hold", "the only check holds"."""
    few = {1: "the only check holds", 2: "both checks hold"}
    return few.get(count, f"all {count} checks hold")


def percent_text(share: float) -> str:
    """A share in per cent, to two digits below 10 %: "0.25 %", "57 %", "100 %"."""
    value = 100 * share
    return f"{value:.2g} %" if value < 10 else f"{value:.0f} %"
