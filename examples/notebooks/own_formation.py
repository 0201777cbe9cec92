# %% [markdown]
# # A formation of your own
#
# This notebook goes from points in space to a verdict on their flight: do the distances hold the shape, which
# edges are best, does the formation fly, and how close do vehicles come?

# %%
import numpy as np

import rigidfleet as rf
from rigidfleet import plotting
from rigidfleet.formation.graphs import complete_graph
from rigidfleet.rigidity import analyse

# %% [markdown]
# ## The shape
#
# The shape is an arrow of seven vehicles: a tip, two barbs on each side, and two behind, one above the
# other. Slots are in the body frame, x ahead, z up.

# %%
slots = np.array(
    [[4, 0, 0], [1, 2.5, 0], [1, -2.5, 0], [-2, 5, 0], [-2, -5, 0], [-3, 0, 1.5], [-3, 0, -1.5]]
)
print(f"{len(slots)} vehicles, {len(complete_graph(len(slots)))} pairs")

# %% [markdown]
# ## Is it rigid?
#
# A rigid shape needs at least $3N - 6 = 15$ distances, and not any fifteen will do. Here, each vehicle keeps its
# distance from the next three in number:

# %%
pairs = complete_graph(len(slots))
tempting = pairs[pairs[:, 1] - pairs[:, 0] <= 3]
found = analyse(slots, tempting)
print(f"{len(tempting)} edges, rank {found.rank} of {found.needed}: {found.rigidity_class}")

# %% [markdown]
# Their number suffices, but two motions change no distance to first order: prestress could hold the shape,
# but distances in flight hardly do. `design` chooses the edges that hold it best:

# %%
edges = rf.design(slots)
chosen = analyse(slots, edges)
print(f"{len(edges)} edges, rank {chosen.rank} of {chosen.needed}: {chosen.rigidity_class}")
print(f"index {chosen.index:.3f}, that of the others {found.index:.3f}")

# %% [markdown]
# ## The mission
#
# The dictionary has the keys of a mission file, and is checked like one. The vehicles start on the ground,
# climb, form the arrow, fly, and turn.

# %%
start = slots * [1, 1, 0] + [0, 0, 0.3]
start[6] += [-2.0, 0, 0]  # it stands behind the one that will be above it
mission = rf.Mission.from_dict(
    {
        "schema_version": 1,
        "name": "arrow",
        "title": "An arrow of seven",
        "agents": {"mass": 1.2, "position": start, "thrust_limit": 26.0},
        "formations": {"arrow": {"slots": slots, "edges": edges + 1}},  # agents count from 1 there
        "obstacles": [{"kind": "ground"}],
        "limits": {"separation": 1.0, "separation_below": 1.0, "speed": 6.0},
        "phases": [
            {"kind": "fly", "position": [*start[:, :2].mean(axis=0), 6.0], "duration": 6.0},
            {"kind": "establish", "formation": "arrow", "duration": 6.0},
            {"kind": "fly", "position": [25.0, 5.0, 10.0], "yaw_deg": 0.0, "duration": 11.0},
            {"kind": "turn", "yaw_deg": 90.0, "duration": 6.0},
            {"kind": "fly", "position": [25.0, 25.0, 10.0], "yaw_deg": 90.0, "duration": 9.0},
        ],
    }
)
mission

# %% [markdown]
# A check says what the mission will meet before it flies:

# %%
rf.check(mission)

# %%
result = rf.simulate(mission)
plotting.trajectory(result)

# %%
verdict = rf.assess(result)
verdict

# %%
plotting.clearance(result)

# %% [markdown]
# This is the flight; turn it with the mouse:

# %%
rf.replay(result)

# %% [markdown]
# ## Share it
#
# Save the record of the flight, and a report that anyone can open and print:

# %%
result.save("arrow.nc")
rf.report(result, "arrow.html", verdicts=[verdict])
