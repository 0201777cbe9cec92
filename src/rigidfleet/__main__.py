"""``python -m rigidfleet`` is the command ``rigidfleet``."""

import sys

from rigidfleet.cli.app import main

if __name__ == "__main__":
    sys.exit(main())
