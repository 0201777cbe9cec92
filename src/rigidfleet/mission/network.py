"""Rules of the network between vehicles."""

from __future__ import annotations

from typing import Any

from rigidfleet.mission.losses import agent_number_rules, loss_time_rules
from rigidfleet.mission.rules import Breach, Breaches, Draft
from rigidfleet.mission.schema import Network
from rigidfleet.mission.vehicles import NOT_SAMPLED


def with_network(data: dict[str, Any]) -> dict[str, Any]:
    """Plain data of a mission with [network] in the place of [disturbances.links]; the same data if it has none.

    Vehicles with the earlier table heard all others, not only their neighbours.
    """
    match data:
        case {"disturbances": {"links": dict(links), **others}} if "network" not in data:
            network = {{"dropped": "loss"}.get(key, key): value for key, value in links.items()}
            return data | {"disturbances": others, "network": network}
    return data


def network_rules(m: Draft) -> Breaches:
    """Vehicles with sampled control hear each other, and what they compute is by neighbours."""
    net: Network | None = m.network
    if net is None:
        return
    if not m.flies_vehicles:
        yield Breach((), *NOT_SAMPLED, None)
    if net.burst is not None and not net.loss:
        yield Breach("burst", "has no effect without loss", "add loss, or remove it")
    if net.budget is not None and m.n is not None and net.broadcast_rate(m.n) < 1.0:
        problem = f"leaves each of {m.n:,} vehicles less than one broadcast a second"
        yield Breach("budget", problem, f"give at least {m.n} Hz, or remove it")
    for key in ("late", "drift") if net.clocks else ():
        yield from m.one_per_agent_rules(net.clocks, key, "clocks", alone=", or a single number")
    for k, one in enumerate(net.outages):
        yield from agent_number_rules(m, ("outages", k, "between"), one.between)
        if one.end <= one.start:
            yield Breach(("outages", k, "end"), "is not after start", "give a later end")
    pairs = [tuple(sorted(one.between)) for one in net.lost]
    for k, pair in enumerate(pairs):
        path = ("lost", k)
        again = "is lost twice" if pair in pairs[:k] else ""
        if pair[0] == pair[1]:
            again = "joins an agent to itself"
        yield from agent_number_rules(m, (*path, "between"), pair, again)
        yield from loss_time_rules(m, net.lost[k].time, path)
    solver, kinds = m.constraint.solver, ("iterated", "exact")
    if solver not in kinds:
        problem = "is not by neighbours: it needs the eigenvalues of all edges together"
        remedy = f"use constraint.solver = '{kinds[0]}' or '{kinds[1]}', or remove [network]"
        yield Breach((), f"constraint.solver = '{solver}' {problem}", remedy, None)
    for k, p in enumerate(m.phases):
        if p.control not in ("open", "tracking"):
            problem = f"phase {k + 1} has control '{p.control}', which no vehicle computes from its neighbours"
            remedy = "use control = 'tracking' or 'open', or remove [network]"
            yield Breach((), problem, remedy, None)
