"""What a network of vehicles is, and what is under way on it: arrays that compiled code reads and writes.

A link (i, j) is what vehicle i hears of vehicle j.
"""

import math
from typing import NamedTuple

import numpy as np

from rigidfleet.typing import Bools, Floats, Ints

#: Columns of a message: position [m], velocity [m/s], acceleration and the input's share of it [m/s^2], whether the
#: vehicle is saturated, whether it tracks a slot, position, velocity and acceleration of that slot (which whoever knows
#: the plan need not be sent), its clock (4, see `clocks.post_clock`), and the acceleration by each iterate of the
#: constraint force [m/s^2], three columns each.
R, V, A, U, SATURATED, TRACKED, SLOT, CLOCK, PULL = 0, 3, 6, 9, 12, 13, 14, 23, 27
#: Share that a vehicle believes of what its neighbour does not know yet of it.
FRESH = 0.5
#: Share of the difference of two integrals that one message takes away, and how much longer it takes with each further
#: message under way: more would overshoot.
TOGETHER, UNDER_WAY = 0.1, 0.3
#: Rows of `Mail.count`: messages sent, heard, lost.
SENT, HEARD, LOST = range(3)
#: No message, no edge.
NONE = -1
#: An edge whose other end is lost: nobody has said so yet.
RELEASED = -2


class Links(NamedTuple):
    """A network of N vehicles with L links, and the estimates that the law by neighbours takes from it."""

    every: int  # attitude ticks between a vehicle's broadcasts; 0: no network
    delay: int  # attitude ticks from a broadcast to its arrival, at least 1
    jitter: int  # greatest number of ticks by which a message is later than that
    worsens: float  # probability with which a link that passes messages begins to lose them
    recovers: float  # probability with which it ends
    range: float  # [m]
    silence: int  # ticks without a message from which an edge lets go
    seed: Ints  # (2,) halves of the seed, 32 bits each
    links: Ints  # (L, 2) vehicles i that hear j, sorted
    first: Ints  # (N + 1,) first link of each vehicle
    reverse: Ints  # (L,) link (j, i) of each link (i, j)
    outages: Floats  # (O, 4) vehicles, from 0 and -1 for all, and from and until which tick no message is sent
    event: float  # distance [m] by which neighbours guess a vehicle wrongly before it sends; 0: it always sends
    longest: int  # ticks after which it sends nevertheless
    lag: float  # time constant with which vehicles estimate the acceleration by what they do not know [s]


class Mail(NamedTuple):
    """What is under way, what has arrived, and what vehicles then hold; D ticks are kept, Q columns a message."""

    post: Floats  # (D, N, Q) what each vehicle could send at the last ticks
    posted: (
        Floats  # (D, L, R) beside it, the multipliers of the edge of each link, and its integral
    )
    due: Ints  # (L, D) newest tick of sending among the messages that arrive at a tick; `NONE`
    stamp: Ints  # (L,) tick of sending of the newest message heard; `NONE`
    heard: Floats  # (L, Q) that message
    own: Floats  # (L, Q) what i had posted at that tick itself
    theirs: Floats  # (L, R) multipliers and integral of j at that tick
    ours: Floats  # (L, R) and those of i
    fresh: Bools  # (L,) whether that message came since the law was last evaluated
    fading: Bools  # (L,) whether the link loses messages
    grip: Floats  # (L,) share with which i pulls at its edge, from 0 to 1
    edge: Ints  # (L,) the edge of the phase that joins i and j; `NONE`, `RELEASED`
    length: Floats  # (L,) its length as it was last planned [m]
    multiplier: (
        Floats  # (L, R) iterates of i's multiplier [N], and its integral of the constraint [m s]
    )
    estimate: Floats  # (N, 6) of velocity [m/s], and of acceleration by what is not known [m/s^2]
    commanded: Floats  # (N, 3) acceleration by the desired force [m/s^2]
    pull: Floats  # (N, 3 (R - 1)) acceleration by each iterate of the constraint force [m/s^2]
    mute: Bools  # (N,) whether a vehicle that follows a law of its own has nothing to say
    silent: Bools  # (N,) whether a vehicle did not send when it could, the last time
    said: Ints  # (N,) tick of each vehicle's last broadcast; `NONE`
    last: Floats  # (N, Q) that message
    count: Ints  # (3, L) see `SENT`
    oldest: Ints  # (L,) greatest age of what i used of j [ticks]
    matrix: Floats  # (W, W) work, W the greatest number of links of a vehicle
    rows: Floats  # (W, 6) work


def no_network(n: int) -> Links:
    """No network between n vehicles: one law knows all states."""
    none = np.zeros(0, dtype=np.int64)
    return Links(
        0, 1, 0, 0.0, 1.0, math.inf, 1, np.zeros(2, dtype=np.int64), np.zeros((0, 2), dtype=np.int64),
        np.zeros(n + 1, dtype=np.int64), none, np.zeros((0, 4)), 0.0, 1, 1.0,
    )  # fmt: skip


def empty_mail(net: Links, iterations: int) -> Mail:
    """Nothing sent and nothing heard; the law has some ``iterations``."""
    n, links, depth = len(net.first) - 1, len(net.links), net.delay + net.jitter + 2
    columns, shares = PULL + 3 * iterations, iterations + 1
    most = int(np.diff(net.first).max(initial=0))
    message, share = np.zeros((links, columns)), np.zeros((links, shares))
    if not net.every:  # no network
        n = 0
    return Mail(
        np.zeros((depth, n, columns)), np.zeros((depth, links, shares)), np.full((links, depth), NONE),
        np.full(links, NONE), message, message.copy(), share, share.copy(), np.zeros(links, dtype=np.bool_),
        np.zeros(links, dtype=np.bool_), np.zeros(links), np.full(links, NONE), np.zeros(links), share.copy(),
        np.zeros((n, 6)), np.zeros((n, 3)), np.zeros((n, 3 * iterations)), np.zeros(n, dtype=np.bool_),
        np.zeros(n, dtype=np.bool_), np.full(n, NONE), np.zeros((n, columns)),
        np.zeros((3, links), dtype=np.int64), np.zeros(links, dtype=np.int64), np.zeros((most, most)),
        np.zeros((most, 6)),
    )  # fmt: skip


def write_edges_of_links(
    net: Links, mail: Mail, edges: Ints, integral: Floats, *, lose: bool = False
) -> None:
    """Give the links the edges (m, 2) of a phase; those that are new begin with their ``integral`` (m,) [m s].

    To ``lose`` edges is nothing that a vehicle knows at once: it holds on to their last length until it is silent.
    """
    if not len(net.links):
        return
    place = {tuple(sorted(pair)): k for k, pair in enumerate(np.asarray(edges).tolist())}
    edge = np.array([place.get(tuple(sorted(pair)), NONE) for pair in net.links.tolist()])
    new = (edge >= 0) & (mail.edge < 0)
    mail.multiplier[new] = 0.0
    mail.multiplier[new, -1] = integral[edge[new]]
    mail.edge[:] = np.where((edge < 0) & (mail.edge != NONE), RELEASED, edge) if lose else edge
