"""The command ``rigidfleet``: parse the arguments, call the library, print.

Verdicts, tables and JSON go to standard output; progress and errors go to standard error. Colours and animation are
for terminals only, and `NO_COLOR` is respected.

Exit codes
----------
- 0: success; for `run`, `assess` and `report`: the flight passed its verdict; for `sweep`: all runs are flown, whether
  they passed or failed, and one at least has a verdict; for `tune`: gains are chosen, perhaps the mission's own
- 1: the flight failed its verdict or ended early; for `check`: the flight will fail
- 2: invalid input, or files that cannot be read or written; for `sweep`: no run has a verdict
- 3: undecided: what was measured leaves the verdict in doubt
- 130: interrupted (Ctrl-C); the flight so far is saved, marked incomplete

Packages that load slowly are imported only by the commands that need them.
"""

from __future__ import annotations

import gc
import logging
import os
import re
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

from cyclopts import App, CycloptsError, Parameter, UnknownOptionError, UnusedCliTokensError

from rigidfleet._version import __version__
from rigidfleet.cli import (
    assess,
    check,
    console,
    design,
    export,
    live,
    new,
    report,
    run,
    sweep,
    tune,
)
from rigidfleet.cli.codes import BAD_INPUT, FAILED, INTERRUPTED, PASSED
from rigidfleet.errors import RigidfleetError
from rigidfleet.kernel.compiler import levels

__all__ = ["BAD_INPUT", "FAILED", "INTERRUPTED", "PASSED", "app", "main"]

app = App(
    name="rigidfleet",
    help="Fly many air vehicles as one rigid body: simulate, judge and draw formation flights.",
    help_epilogue="Exit codes: 0 success, the flight passed; 1 the flight failed its verdict, or "
    "will fail (check); 2 invalid input; 3 undecided (a log); 130 interrupted, the flight so far is saved.",
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
    run.run, run.missions, check.check, design.design, new.new, assess.assess, report.report, report.replay,
    export.export, live.live, sweep.sweep, tune.tune,
)  # fmt: skip
#: Lines below each other that are indented alike, and not what underlines a heading.
_PARAGRAPH = re.compile(r"(?m)^( *)(?!-+$)\S.*(\n\1(?!-+$)\S.*)+")
for _key, _command in enumerate(_COMMANDS, start=1):
    # Paragraphs are wrapped by the width of the terminal, not where lines of the source end.
    _command.__doc__ = _PARAGRAPH.sub(
        lambda match: match[1] + " ".join(match[0].split()), _command.__doc__ or ""
    )
    app.command(_command, sort_key=_key)
app.register_install_completion_command(help="Complete words with Tab in this user's shell.")


def main(tokens: Sequence[str] | None = None) -> int:
    """Run the command with `tokens`, by default the arguments of the process, and return its exit code."""
    if tokens is None:
        # Imports create about 100,000 permanent objects. With the default threshold, garbage collection would make
        # them 10 % slower.
        gc.set_threshold(100_000)
        warnings.showwarning = cast("Any", console.warn)
        # The matrices are small: several threads would only wait for each other, on a busy machine for long.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        # Without a home that can be written, it would report on two lines that it needs none.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        for key, value in levels.LIBRARY_SETTINGS.get(os.environ.get(levels.KEY, ""), {}).items():
            os.environ.setdefault(key, value)
            warnings.filterwarnings("ignore", f"(?s).*{key}", ImportWarning)
    console.prepare_streams()
    try:
        with run.raise_interrupts() if tokens is None else nullcontext():
            return app(tokens, console=console.out(), error_console=console.err()) or PASSED
    except (CycloptsError, RigidfleetError) as error:
        console.print_error(_usage_text(error) if isinstance(error, CycloptsError) else error)
        return BAD_INPUT
    except BrokenPipeError:
        console.discard_output(sys.stdout)
        return PASSED
    except OSError as error:  # a full disk, for example: not a fault of the program
        if error.filename is None:
            console.discard_output(sys.stdout)
        console.print_error(f"{error.filename or 'standard output'}: {error.strerror or error}")
        return BAD_INPUT
    except KeyboardInterrupt:
        console.err().print("Interrupted", style="yellow")
        return INTERRUPTED
    except MemoryError:
        console.print_error(
            "There is not enough memory. Use fewer agents, edges or samples, or a larger machine."
        )
        return BAD_INPUT
    except Exception as error:
        if sys.flags.dev_mode:
            raise
        console.print_error(_internal_error_message(error))
        return BAD_INPUT
    finally:
        if tokens is None:
            gc.freeze()  # the interpreter would search all objects once more before it ends, for 0.1 s


def _internal_error_message(error: Exception) -> str:
    """Message for an unexpected error."""
    *_, at = traceback.extract_tb(error.__traceback__)
    text = f"{type(error).__name__} in {Path(at.filename).name}, line {at.lineno}: {error}"
    return (
        f"{text.rstrip(': ')}\n    this is a bug in rigidfleet: please report it with the input file"
        " (python -X dev -m rigidfleet ... shows the traceback)"
    )


def _usage_text(error: CycloptsError) -> str:
    """Message for an invalid command line."""
    from rigidfleet._common.renamed import rename_hint

    command = " ".join(("rigidfleet", *(error.command_chain or ()), "--help"))
    text = str(error)
    if isinstance(error, UnusedCliTokensError):
        text = f"Unexpected arguments: {' '.join(error.unused_tokens or ())}."
    if isinstance(error, UnknownOptionError) and (newer := rename_hint(error.token.keyword)):
        text = f"Unknown option: {error.token.keyword}; {newer}."
    return f"{text}\n    see `{command}`"
