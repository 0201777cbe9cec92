"""The command ``rigidfleet``: it parses, calls and prints.

What was asked for goes to standard output: verdicts, tables, JSON. Progress and errors go to standard
error. Colours and animation are for terminals, and `NO_COLOR` is respected.

Exit codes
----------
- 0: done; for `run` and `report`: the flight passed its verdict; for `sweep`: every run is flown,
  passed or not
- 1: flew, but failed its verdict, as a flight does that could not be flown to its end; for `check`:
  something will fail
- 2: bad input, or files that cannot be read or written
- 130: interrupted (Ctrl-C); what flew is saved, marked incomplete

Packages that take long to load are imported by the commands that need them.
"""

from __future__ import annotations

import gc
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError

from rigidfleet._version import __version__
from rigidfleet.cli import check, console, design, live, new, report, run, sweep
from rigidfleet.cli.codes import BAD_INPUT, FAILED, INTERRUPTED, PASSED
from rigidfleet.errors import RigidfleetError

__all__ = ["BAD_INPUT", "FAILED", "INTERRUPTED", "PASSED", "app", "main"]

app = App(
    name="rigidfleet",
    help="Fly many air vehicles as one rigid body: simulate, judge and draw formation flights.",
    help_epilogue="Exit codes: 0 done, or the flight passed; 1 it flew but failed its verdict, or "
    "will fail (check); 2 bad input; 130 interrupted, what flew is saved.",
    help_format="plaintext",
    version=f"rigidfleet {__version__}",
    version_flags=["--version"],
    default_parameter=Parameter(negative=(), show_default=False),
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
    result_action="return_value",
)
_COMMANDS = (
    run.run, run.missions, check.check, design.design, new.new, report.report, report.replay,
    live.live, sweep.sweep,
)  # fmt: skip
for _key, _command in enumerate(_COMMANDS, start=1):
    app.command(_command, sort_key=_key)


def main(tokens: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code; without `tokens`, on the arguments of the process."""
    if tokens is None:
        # Imports make a hundred thousand objects that stay: looked through as often as by default, they
        # would take a tenth longer.
        gc.set_threshold(100_000)
        warnings.showwarning = cast("Any", console.warn)
        # Matrices are small here: threads over them wait for each other, and on a busy machine for long.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    console.prepare_streams()
    try:
        return app(tokens, console=console.out(), error_console=console.err()) or PASSED
    except CycloptsError as error:
        console.complain(_usage(error))
        return BAD_INPUT
    except RigidfleetError as error:
        console.complain(error)
        return BAD_INPUT
    except BrokenPipeError:
        console.hang_up(sys.stdout)
        return PASSED
    except OSError as error:  # a full disk and the like: no fault of the program
        if error.filename is None:
            console.hang_up(sys.stdout)
        console.complain(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        console.err().print("Interrupted", style="yellow")
        return INTERRUPTED
    except MemoryError:
        console.complain(
            "There is too little memory for this. Use fewer agents, edges or samples, or a larger machine."
        )
        return BAD_INPUT
    except Exception as error:
        if sys.flags.dev_mode:
            raise
        console.complain(_own_fault(error))
        return BAD_INPUT


def _own_fault(error: Exception) -> str:
    """What to say of an error that nobody has foreseen."""
    *_, at = traceback.extract_tb(error.__traceback__)
    text = f"{type(error).__name__} in {Path(at.filename).name}, line {at.lineno}: {error}".rstrip(
        ": "
    )
    return (
        f"{text}\n    this is a fault of rigidfleet, not of yours: please report it, with the file that led to it"
        " (python -X dev -m rigidfleet ... shows all of it)"
    )


def _usage(error: CycloptsError) -> str:
    """What is wrong with the command as typed."""
    from rigidfleet._renamed import successor

    command = " ".join(("rigidfleet", *(error.command_chain or ()), "--help"))
    text = str(error)
    if isinstance(error, UnusedCliTokensError):
        text = f"Unexpected: {' '.join(error.unused_tokens or ())}."
    if isinstance(error, UnknownOptionError) and (told := successor(error.token.keyword)):
        text = f"Unknown option: {error.token.keyword}; {told}."
    return f"{text}\n    see `{command}`"
