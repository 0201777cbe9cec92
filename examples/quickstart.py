"""Load a mission, fly it, look at it, draw it: in five lines."""

import rigidfleet as rf


def main(folder="figures"):
    """Fly the paper's narrow passage and draw it into a folder; return the result."""
    mission = rf.load_mission("narrow-passage")
    result = rf.simulate(mission)
    print(result, rf.assess(result).summary, sep="\n")
    rf.plot(result, folder)
    return result


if __name__ == "__main__":
    main()
