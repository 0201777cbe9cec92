"""Use of Numba's internals, which are not a stable interface: isolated here, for the tested versions only.

They shorten the very first run by an eighth: Numba translates the kernel's functions and makes no machine code of
each. With any other version, Numba's public functions alone build the kernel, with the same result.
"""

from __future__ import annotations

from typing import Any

import numba
from numba.core import codegen, cpu

#: Versions of Numba whose internals these are.
TESTED = ("0.68.1",)


def known() -> bool:
    """Whether the installed version of Numba is one of these."""
    return numba.__version__ in TESTED


def translate_only() -> None:
    """Stop Numba from making unused results: machine code of each function, and a module with all its callees."""

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
