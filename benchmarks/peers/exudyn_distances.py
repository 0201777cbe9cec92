"""Exudyn: mass points, every edge a distance constraint of a differential-algebraic system."""

from __future__ import annotations

import numpy as np

from .case import DURATION, STEPS, AbsentError, Array, Case, Flight, Peer, timed


def peer() -> Peer:
    """Generalized alpha, at a step."""
    try:
        import exudyn
    except ImportError:
        raise AbsentError("Exudyn: .venv/bin/uv pip install exudyn") from None
    return Peer(
        "Exudyn",
        exudyn.__version__,
        "hard constraints (index 3), whose distances are set before each step, from Python, to what our law makes"
        " of them, so that the motion is the same; implicit steps of equal length",
        True,
        STEPS,
        "step [s]",
        flight,
    )


def flight(case: Case, step: float) -> Flight:
    """The generalized-alpha solver."""
    import exudyn as exu
    from exudyn import utilities as items

    lengths = case.lengths(step).tolist()

    system = exu.SystemContainer()
    mbs = system.AddSystem()
    markers, nodes = [], []
    for r, m, f in zip(case.r.tolist(), case.m.tolist(), case.force.tolist(), strict=True):
        node = mbs.AddNode(items.NodePoint(referenceCoordinates=r))
        body = mbs.AddObject(items.ObjectMassPoint(physicsMass=m, nodeNumber=node))
        marker = mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=body))
        mbs.AddLoad(items.LoadForceVector(markerNumber=marker, loadVector=f))
        nodes.append(node)
        markers.append(marker)
    edges = [
        mbs.AddObject(items.ObjectConnectorDistance(markerNumbers=[markers[i], markers[j]], distance=x))
        for (i, j), x in zip(case.edges.tolist(), lengths[0], strict=True)
    ]  # fmt: skip

    def set_lengths(mbs: exu.MainSystem, t: float) -> bool:
        for edge, x in zip(edges, lengths[round(t / step)], strict=True):
            mbs.SetObjectParameter(edge, "distance", x)
        return True

    mbs.SetPreStepUserFunction(set_lengths)
    mbs.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = round(DURATION / step)
    settings.timeIntegration.endTime = DURATION
    settings.timeIntegration.verboseMode = 0
    settings.solutionSettings.writeSolutionToFile = False
    settings.displayStatistics = False
    if case.n > 20:
        settings.linearSolverType = exu.LinearSolverType.EigenSparse

    def fly() -> Array:
        mbs.SolveDynamic(settings, updateInitialValues=False)
        return np.array([mbs.GetNodeOutput(k, exu.OutputVariableType.Position) for k in nodes])

    return timed(fly)
