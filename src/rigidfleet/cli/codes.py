"""Exit codes of the command."""

PASSED, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
