"""Messages between vehicles: broadcasts at a rate, which reach each neighbour late, or never.

A link (i, j) is what vehicle i hears of vehicle j. Whether and when a message arrives is decided as it is sent, by
numbers that depend on nothing but the seed, the link and the tick: the same link loses the same messages whatever
happens elsewhere.
"""

import math
from typing import NamedTuple

import numpy as np

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.typing import Bools, Floats, Ints

#: Columns of a message: position [m], velocity [m/s], acceleration and the input's share of it [m/s^2], whether the
#: vehicle is saturated, its clock (4, see `clocks.post_clock`), and the acceleration by each iterate of the constraint
#: force [m/s^2], three columns each.
R, V, A, U, SATURATED, CLOCK, PULL = 0, 3, 6, 9, 12, 13, 17
#: Rows of `Mail.count`: messages sent, heard, lost.
SENT, HEARD, LOST = range(3)
#: Kinds of random numbers.
_FADES, _WAITS = range(2)
_NEVER = -1


class Network(NamedTuple):
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
    lag: float  # time constant with which vehicles estimate the acceleration by what they do not know [s]


class Mail(NamedTuple):
    """What is under way, what has arrived, and what vehicles then hold; D ticks are kept, Q columns a message."""

    post: Floats  # (D, N, Q) what each vehicle could send at the last ticks
    posted: (
        Floats  # (D, L, R) beside it, the multipliers of the edge of each link, and its integral
    )
    due: Ints  # (L, D) newest tick of sending among the messages that arrive at a tick; -1 for none
    stamp: Ints  # (L,) tick of sending of the newest message heard; -1 for none
    heard: Floats  # (L, Q) that message
    own: Floats  # (L, Q) what i had posted at that tick itself
    theirs: Floats  # (L, R) multipliers and integral of j at that tick
    ours: Floats  # (L, R) and those of i
    fresh: Bools  # (L,) whether that message came since the law was last evaluated
    fading: Bools  # (L,) whether the link loses messages
    grip: Floats  # (L,) share with which i pulls at its edge, from 0 to 1
    edge: Ints  # (L,) the edge of the phase that joins i and j; -1 for none
    multiplier: (
        Floats  # (L, R) iterates of i's multiplier [N], and its integral of the constraint [m s]
    )
    estimate: Floats  # (N, 6) of velocity [m/s], and of acceleration by what is not known [m/s^2]
    commanded: Floats  # (N, 3) acceleration by the desired force [m/s^2]
    pull: Floats  # (N, 3 (R - 1)) acceleration by each iterate of the constraint force [m/s^2]
    count: Ints  # (3, L) see `SENT`
    oldest: Ints  # (L,) greatest age of what i used of j [ticks]
    matrix: Floats  # (W, W) work, W the greatest number of links of a vehicle
    rows: Floats  # (W, 10) work


@jit
def mix(x):
    """A permutation of the integers of 32 bits without pattern (C. Wellons' lowbias32)."""
    x ^= x >> 16
    x = (x * 0x7FEB352D) & 0xFFFFFFFF
    x ^= x >> 15
    x = (x * 0x846CA68B) & 0xFFFFFFFF
    return x ^ (x >> 16)


@jit
def chance(seed, kind, link, k):
    """A number in [0, 1) of a link (2,) at tick k: the same one whenever it is drawn."""
    x = mix(seed[0] ^ kind)
    x = mix(x ^ seed[1])
    x = mix(x ^ link[0])
    x = mix((x + link[1]) & 0xFFFFFFFF)
    return mix((x + k) & 0xFFFFFFFF) / 4294967296.0


@jit
def is_out(k, i, j, outages):
    """Whether an outage keeps vehicle i from hearing j at tick k."""
    for row in range(outages.shape[0]):
        x, y, begin, end = outages[row, 0], outages[row, 1], outages[row, 2], outages[row, 3]
        if begin <= k < end and (x < 0 or (x in (i, j) and (y < 0 or y in (i, j)))):
            return True
    return False


@jit
def send(k, S, silent, net, mail):
    """Broadcast at tick k what is posted, over each link of vehicles at S (N, 17) that are not ``silent`` (N,)."""
    for l in range(net.links.shape[0]):
        i, j = net.links[l, 0], net.links[l, 1]
        if silent[j]:
            continue
        mail.count[SENT, l] += 1
        draw = chance(net.seed, _FADES, net.links[l], k)
        # A chain of two states (Gilbert, Elliott): what it did last decides what the same number means.
        mail.fading[l] = draw >= net.recovers if mail.fading[l] else draw < net.worsens
        distance = 0.0
        for q in range(3):
            distance += (S[i, q] - S[j, q]) ** 2
        if mail.fading[l] or distance > net.range**2 or is_out(k, i, j, net.outages):
            mail.count[LOST, l] += 1
            continue
        late = int(chance(net.seed, _WAITS, net.links[l], k) * (net.jitter + 1))
        slot = (k + net.delay + late) % mail.due.shape[1]
        if mail.due[l, slot] != _NEVER:  # an older one that arrives at the same tick
            mail.count[HEARD, l] += 1
        mail.due[l, slot] = k


@jit
def receive(k, net, mail):
    """Take the messages that arrive at tick k; one that is older than what is known is dropped."""
    depth = mail.due.shape[1]
    for l in range(net.links.shape[0]):
        stamp = mail.due[l, k % depth]
        mail.due[l, k % depth] = _NEVER
        if stamp == _NEVER:
            continue
        mail.count[HEARD, l] += 1
        if stamp <= mail.stamp[l]:
            continue
        mail.stamp[l], mail.fresh[l], then = stamp, True, stamp % depth
        for q in range(mail.heard.shape[1]):
            mail.heard[l, q] = mail.post[then, net.links[l, 1], q]
            mail.own[l, q] = mail.post[then, net.links[l, 0], q]
        for q in range(mail.theirs.shape[1]):
            mail.theirs[l, q] = mail.posted[then, net.reverse[l], q]
            mail.ours[l, q] = mail.posted[then, l, q]


def no_network(n: int) -> Network:
    """No network between n vehicles: one law knows all states."""
    none = np.zeros(0, dtype=np.int64)
    return Network(
        0, 1, 0, 0.0, 1.0, math.inf, 1, np.zeros(2, dtype=np.int64), np.zeros((0, 2), dtype=np.int64),
        np.zeros(n + 1, dtype=np.int64), none, np.zeros((0, 4)), 1.0,
    )  # fmt: skip


def empty_mail(net: Network, iterations: int) -> Mail:
    """Nothing sent and nothing heard; the law has some ``iterations``."""
    n, links, depth = len(net.first) - 1, len(net.links), net.delay + net.jitter + 2
    columns, shares = PULL + 3 * iterations, iterations + 1
    most = int(np.diff(net.first).max(initial=0))
    message, share = np.zeros((links, columns)), np.zeros((links, shares))
    if net.every == 0:
        n = 0
    return Mail(
        np.zeros((depth, n, columns)), np.zeros((depth, links, shares)), np.full((links, depth), _NEVER),
        np.full(links, _NEVER), message, message.copy(), share, share.copy(), np.zeros(links, dtype=np.bool_),
        np.zeros(links, dtype=np.bool_), np.zeros(links), np.full(links, _NEVER), share.copy(), np.zeros((n, 6)),
        np.zeros((n, 3)), np.zeros((n, 3 * iterations)),
        np.zeros((3, links), dtype=np.int64), np.zeros(links, dtype=np.int64), np.zeros((most, most)),
        np.zeros((most, 10)),
    )  # fmt: skip


def assign_edges(net: Network, mail: Mail, edges: Ints, integral: Floats) -> None:
    """Give the links the edges (m, 2) of a phase; those that are new begin with their ``integral`` (m,) [m s]."""
    if not len(net.links):
        return
    place = {tuple(sorted(pair)): k for k, pair in enumerate(np.asarray(edges).tolist())}
    edge = np.array([place.get(tuple(sorted(pair)), -1) for pair in net.links.tolist()])
    new = (edge >= 0) & (mail.edge < 0)
    mail.multiplier[new] = 0.0
    mail.multiplier[new, -1] = integral[edge[new]]
    mail.edge[:] = edge
