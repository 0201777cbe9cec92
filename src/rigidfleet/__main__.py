"""``python -m rigidfleet`` is the command ``rigidfleet``.

Nothing is loaded with this module: the processes of a sweep load it again, and are not the command.
"""

import sys


def main() -> int:
    """Run the command; return its exit code."""
    from rigidfleet.cli import app

    return app.main()


if __name__ == "__main__":
    sys.exit(main())
