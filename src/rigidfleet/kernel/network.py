"""Messages between vehicles: broadcasts at a rate, which reach each neighbour late, or never.

Whether and when a message arrives is decided as it is sent, by numbers that depend on nothing but the seed, the link
and the tick: the same link loses the same messages whatever happens elsewhere.
"""

from rigidfleet.kernel.compiler.jit import jit
from rigidfleet.kernel.linalg import copy_vector
from rigidfleet.kernel.mail import HEARD, LOST, NONE, SENT

#: Kinds of random numbers.
_FADES, _WAITS = range(2)


@jit
def mix_32_bits(x):
    """A permutation of the integers of 32 bits without pattern (C. Wellons' lowbias32)."""
    x ^= x >> 16
    x = (x * 0x7FEB352D) & 0xFFFFFFFF
    x ^= x >> 15
    x = (x * 0x846CA68B) & 0xFFFFFFFF
    return x ^ (x >> 16)


@jit
def random_uniform(seed, kind, link, k):
    """A number in [0, 1) of a link (2,) at tick k: the same one whenever it is drawn."""
    x = mix_32_bits(seed[0] ^ kind)
    x = mix_32_bits(x ^ seed[1])
    x = mix_32_bits(x ^ link[0])
    x = mix_32_bits((x + link[1]) & 0xFFFFFFFF)
    return mix_32_bits((x + k) & 0xFFFFFFFF) / 4294967296.0


@jit
def is_in_outage(k, i, j, outages):
    """Whether an outage keeps vehicle i from hearing j at tick k."""
    for row in range(outages.shape[0]):
        x, y, begin, end = outages[row, 0], outages[row, 1], outages[row, 2], outages[row, 3]
        if begin <= k < end and (x < 0 or (x in (i, j) and (y < 0 or y in (i, j)))):
            return True
    return False


@jit
def send(k, S, net, mail):
    """Broadcast at tick k what is posted, over each link of vehicles at S (N, 17) that are not silent."""
    for l in range(net.links.shape[0]):
        i, j = net.links[l, 0], net.links[l, 1]
        if mail.silent[j]:
            continue
        mail.count[SENT, l] += 1
        draw = random_uniform(net.seed, _FADES, net.links[l], k)
        # A chain of two states (Gilbert, Elliott): what it did last decides what the same number means.
        mail.fading[l] = draw >= net.recovers if mail.fading[l] else draw < net.worsens
        distance = 0.0
        for q in range(3):
            distance += (S[i, q] - S[j, q]) ** 2
        if mail.fading[l] or distance > net.range**2 or is_in_outage(k, i, j, net.outages):
            mail.count[LOST, l] += 1
            continue
        late = int(random_uniform(net.seed, _WAITS, net.links[l], k) * (net.jitter + 1))
        slot = (k + net.delay + late) % mail.due.shape[1]
        if mail.due[l, slot] != NONE:  # an older one that arrives at the same tick
            mail.count[HEARD, l] += 1
        mail.due[l, slot] = k


@jit
def receive(k, net, mail):
    """Take the messages that arrive at tick k; one that is older than what is known is dropped."""
    depth = mail.due.shape[1]
    for l in range(net.links.shape[0]):
        stamp = mail.due[l, k % depth]
        mail.due[l, k % depth] = NONE
        if stamp == NONE:
            continue
        mail.count[HEARD, l] += 1
        if stamp <= mail.stamp[l]:
            continue
        mail.stamp[l], mail.fresh[l], then = stamp, True, stamp % depth
        copy_vector(mail.post[then, net.links[l, 1]], mail.heard[l])
        copy_vector(mail.post[then, net.links[l, 0]], mail.own[l])
        copy_vector(mail.posted[then, net.reverse[l]], mail.theirs[l])
        copy_vector(mail.posted[then, l], mail.ours[l])
