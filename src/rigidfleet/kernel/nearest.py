"""The nearest of many boxes, at all samples of a flight."""

from rigidfleet.kernel.compiler import elementwise  # noqa: F401 -- the zero of numbers
from rigidfleet.kernel.compiler.jit import exact
from rigidfleet.kernel.measured import BLOCK
from rigidfleet.solids import distance

from_box = exact(distance.from_box)


@exact
def nearest_boxes(s):
    """Least distance of each agent's surface to a box, and the first box that is so near.

    The inner loops, over samples of one agent, are such that the compiler makes vectors of them.
    """
    K, n = s.r.shape[0], s.r.shape[1]
    x, y, z = s.places[0], s.places[1], s.places[2]
    for i in range(n):
        radius = s.radius[i]
        for first in range(0, K, BLOCK):
            count = min(BLOCK, K - first)
            least, nearest = s.least[i, first : first + count], s.nearest[i, first : first + count]
            for k in range(count):
                x[k], y[k], z[k] = s.r[first + k, i, 0], s.r[first + k, i, 1], s.r[first + k, i, 2]
            for b in range(s.boxes.shape[0]):
                box = s.boxes[b]
                box = (box[0], box[1], box[2], box[3], box[4], box[5])
                for k in range(count):
                    clearance = from_box(x[k], y[k], z[k], box) - radius
                    closer = clearance < least[k]  # false for NaN
                    least[k] = clearance if closer else least[k]
                    nearest[k] = b if closer else nearest[k]
