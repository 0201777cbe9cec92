"""``python -m rigidfleet`` is the command ``rigidfleet``.

Nothing is loaded with this module: the processes of a sweep load it again, and are not the command.
"""

try:
    import os
    import signal
    import sys
except KeyboardInterrupt:
    raise SystemExit(130) from None


def main() -> int:
    """Run the command; return its exit code."""
    # Nothing is lost by Ctrl-C while the command is loaded or ends, and no import can turn it into another error.
    before = signal.signal(signal.SIGINT, _quit)
    from rigidfleet.cli import app

    try:
        signal.signal(signal.SIGINT, before)
        return app.main()
    except KeyboardInterrupt:
        return app.INTERRUPTED
    finally:
        signal.signal(signal.SIGINT, _quit)


def _quit(*_: object) -> None:
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
