# %% [markdown]
# # Reproduce the paper
#
# Each simulation of the paper is a mission that ships with rigidfleet. This notebook flies the decisive
# ones, from the first table to the passage, and shows where the printed law fails and which law flies instead.

# %%
import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet.math import pid

# %% [markdown]
# ## Table 1: a triangle, a line, a triangle
#
# Three agents at rest form an equilateral triangle, then a line, then a triangle again, by constraint
# forces alone.

# %%
triangle = rf.simulate("establish-triangle")
print(rf.assess(triangle).summary)
plotting.distances(triangle)

# %% [markdown]
# The paper's distances *jump*, and its law inverts a matrix that has no inverse on the line. As printed,
# the law cannot reach the line:

# %%
printed = rf.simulate("line-singular")
print(printed.ending)

# %% [markdown]
# The time at which the flight ends is known beforehand. The integral in the law makes an error overshoot, and $d_{13}$
# cannot exceed $d_{12} + d_{23}$: the flight meets the line as the error first passes zero, $1.618/p$
# after the step at 6 s, where $p$ is the rate of the triple pole.

# %%
p = 2.0
print(f"gains {pid.triple_pole(p)}, overshoot {pid.overshoot(*pid.triple_pole(p)):.1%}")
print(f"foretold {6.0 + 1.618 / p:.2f} s, flown {printed.phases[-1].t_end:.2f} s")

# %% [markdown]
# ## Table 2: a waypoint
#
# The formation flies as one rigid body, by a linear quadratic regulator on its centre of mass and
# attitude.

# %%
waypoint = rf.simulate("single-waypoint")
print(rf.assess(waypoint).summary)
plotting.cm(waypoint)

# %%
plotting.attitude(waypoint)

# %% [markdown]
# ## Table 3: the narrow passage
#
# Six waypoints among obstacles. The triangle is too wide for the gap: it folds into a line, turns, passes,
# and unfolds.

# %%
passage = rf.simulate("narrow-passage")
print(rf.assess(passage).summary)
plotting.trajectory(passage)

# %%
rf.replay(passage)

# %% [markdown]
# ## Table 4: not a cube
#
# Eighteen distances hold eight agents. As printed, two of them are swapped: all distances are met, and the
# shape is rigid, but it is not a cube. The verdict, which compares all pairs of agents, detects this.

# %%
for name in ("establish-cube-as-printed", "establish-cube"):
    cube = rf.simulate(name)
    error = abs(cube.constraint[-1]).max()
    print(f"{name}: greatest error of a distance {error:.1e} m\n{rf.assess(cube).summary}\n")
plotting.formations(cube)
