"""Fly a mission, look at it, draw it: in four lines."""

import rigidfleet as rf


def main(folder="figures"):
    """Fly the paper's narrow passage and draw it into a folder; return the result."""
    result = rf.simulate("narrow-passage")
    print(result, rf.assess(result).summary, sep="\n")
    rf.plot(result, folder)
    return result


if __name__ == "__main__":
    main()
