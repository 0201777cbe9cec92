"""Vehicles that send only when their neighbours guess them wrongly."""

from typing import Any

import numpy as np
import pytest
from test_network import CUBE, fly, laid_out, mission

import rigidfleet as rf
from rigidfleet.kernel.mail import HEARD, SENT, A, R, V

GUSTS = {"gusts": {"model": "first-order", "intensity": 1000.0, "time_scale": 2.0, "seed": 4}}
WINDY = {"p": {"model": "point", "mass": 1.0, "thrust_limit": 100.0, "drag": 0.001}}


def test_a_vehicle_sends_when_its_last_message_leads_astray():
    """It sends exactly when the motion that it last told of, straight on from there, is off by more than the bound."""
    m = mission(
        {"event": 0.01, "delay": 0.02},
        vehicles=WINDY,
        disturbances=GUSTS,
        tracking={"Q": [1.0, 0.0], "R": 1.0},
    )
    problem, work, flight, state = laid_out(m)
    fly(problem, work, flight, state, 300)  # slots stand still from 4 s on
    net, mail, tick = flight.network, state.mail, flight.steps * flight.h
    assert (net.event, net.longest) == (0.01, (25 - 1) // 2)
    last: list[tuple[int, np.ndarray]] = []
    first: dict[int, tuple[int, np.ndarray]] = {}
    silent = early = late = 0
    for k in range(300, 800):
        before = mail.count[SENT].copy()
        fly(problem, work, flight, state, 1)
        posts = mail.post[k % len(mail.post)]
        sent = mail.count[SENT] - before
        if not last:  # until all have spoken
            first |= {int(j): (k, posts[j].copy()) for j in net.links[sent > 0, 1]}
            last = [first[j] for j in range(8)] if len(first) == 8 else []
            continue
        for j, (when, post) in enumerate(last):
            age = (k - when) * tick
            guess = post[R : R + 3] + age * (post[V : V + 3] + 0.5 * age * post[A : A + 3])
            off = float(np.linalg.norm(posts[j, R : R + 3] - guess))
            speaks = bool(sent[net.links[:, 1] == j].all())
            assert speaks == bool(sent[net.links[:, 1] == j].any())
            assert speaks == (off >= 0.01 or k - when >= net.longest), (k, j, off)
            silent += not speaks
            early += speaks and off >= 0.01
            late += speaks and off < 0.01
            if speaks:
                last[j] = k, posts[j].copy()
    assert silent > 3000
    assert early > 100
    assert late > 20


@pytest.mark.parametrize(("loss", "burst"), [(0.0, None), (0.3, None), (0.3, 3.0)])
def test_silence_never_runs_out_for_want_of_an_event(loss, burst):
    """In still air nobody is ever off; neighbours hear of one another often enough to hold on, whatever is lost."""
    keys = {"event": 1.0, "silence": 2.0, "loss": loss} | (
        {} if burst is None else {"burst": burst}
    )
    problem, work, flight, state = laid_out(mission(keys))
    fly(problem, work, flight, state, 210)
    grips = []
    for _ in range(400):
        fly(problem, work, flight, state, 1)
        grips.append(state.mail.grip.copy())
    assert (np.array(grips) == 1.0).mean() > 0.999
    assert state.mail.count[SENT].max() < 0.5 * 610
    assert state.mail.count[HEARD].min() > 0


@pytest.mark.long
@pytest.mark.parametrize("shape", ["cube", "triangle"])
def test_half_of_the_broadcasts_hold_the_shape(shape):
    """With far less than half of the broadcasts, over six flights in gusts, within a tenth of the central law's."""
    tables: dict[str, Any] = {}
    r = CUBE
    if shape == "triangle":
        r = np.array([[0, 0, 0], [4, 0, 0], [2, 3.4641, 0]])
        tables = {
            "agents": {"position": (r + [0, 0, 20]).tolist(), "vehicle": "p"},
            "formations": {"cube": {"slots": r.tolist(), "edges": [[1, 2], [1, 3], [2, 3]]}},
        }
    i, j = np.triu_indices(len(r), 1)

    def error(network: dict[str, float] | None, seed: int) -> float:
        gusts = {"gusts": GUSTS["gusts"] | {"seed": seed}}
        m = mission(
            network,
            time=40.0,
            vehicles=WINDY,
            disturbances=gusts,
            tracking={"Q": [1.0, 0.0], "R": 1.0},
            **tables,
        )
        flown = rf.simulate(m)
        late = flown.position[flown.time > 10.0]
        off = np.linalg.norm(late[:, i] - late[:, j], axis=2) - np.linalg.norm(r[i] - r[j], axis=1)
        return float(np.sqrt((off**2).mean()))

    ratios = [error({"event": 0.005}, seed) / error(None, seed) for seed in range(6)]
    assert 1.0 < np.mean(ratios) <= 1.1
