"""What is taken from Numba that it does not promise: isolated here, for the versions that it was tested with.

Two things shorten the first run ever: Numba translates the kernel's functions and makes no machine code of each
(an eighth of the time), and a second process does half of the translation (a third of the time). With any other
version neither is done: the kernel is then built by Numba's public functions alone, and comes out the same.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any

import numba
from numba.core import codegen, compiler, cpu, serialize

#: Versions of Numba whose internals these are.
TESTED = ("0.68.1",)


def known() -> bool:
    """Whether the installed Numba is one of those."""
    return numba.__version__ in TESTED


def translate_only() -> None:
    """Keep Numba from all that nobody needs: machine code of each function, and of each a module with all it calls."""

    def executable(_context: Any, library: Any, function: Any, environment: Any) -> Any:
        name, module = function.qualname.split(".")[-1], function.lookup_module()
        return cpu._dynfunc.make_function(module, name, "", 0, environment, (library,))

    def finalize(library: Any) -> None:
        library._finalized = True

    def whole(library: Any) -> str:
        module, seen, rest = library._final_module.clone(), {library}, [library]
        while rest:
            for other in rest.pop()._linking_libraries:
                if other not in seen:
                    seen.add(other)
                    rest.append(other)
                    module.link_in(other._final_module, preserve=True)
        return str(module)

    cpu.CPUContext.get_executable = executable
    codegen.CPUCodeLibrary.finalize = finalize
    codegen.CPUCodeLibrary.get_llvm_str = whole
    codegen.JITCodeLibrary._finalize_specific = lambda _library: None
    codegen.JITCPUCodegen.set_env = lambda _codegen, _name, _environment: None


def portable(function: Any, arguments: Any, simplified: Callable[[str, str, str], Any]) -> bytes:
    """A function that Numba has translated for ``arguments``, in bytes that `received` takes in another process.

    ``simplified(text, symbol, name)`` is its module as it is to be kept.
    """
    function.compile(arguments)
    result = function.overloads[arguments]
    symbol = result.fndesc.llvm_func_name
    module = simplified(result.library.get_llvm_str(), symbol, symbol)
    result.library.serialize_using_object_code = result.library.serialize_using_bitcode
    result.library._final_module = module
    return serialize.dumps(result._reduce())


def received(context: Any, done: bytes) -> Any:
    """What Numba takes for a translated function of its own."""
    return compiler.CompileResult._rebuild(context, *pickle.loads(done))


def given_by(function: Any, cache: Any) -> None:
    """Have a function's translations asked of ``cache``."""
    function._cache = cache
