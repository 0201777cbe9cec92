"""``python -m rigidfleet`` is the command ``rigidfleet``.

Nothing is loaded with this module: the processes of a sweep load it again, and are not the command.
"""

import os
import sys


def main() -> int:
    """Run the command; return its exit code."""
    # No plugin of pydantic concerns missions, and to look for some reads about all packages that are installed.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "true")
    try:
        import signal

        # Nothing is lost by Ctrl-C while the command is loaded, and no import can turn it into another error.
        before = signal.signal(signal.SIGINT, lambda *_: os._exit(130))
        from rigidfleet.cli import app

        signal.signal(signal.SIGINT, before)
        return app.main()
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
