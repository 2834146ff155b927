"""The one place where numba is named: typed, cached on disk, no fast-math (results must not depend on the machine)."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.extending import register_jitable

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a kernel of floats and arrays; the straight Python version stays at `.py_func`."""
    return cast(_Function, numba.njit(cache=True, error_model="numpy")(function))


def equation(function: _Function) -> _Function:
    """Mark an equation that is written once and serves two readers.

    Called from Python it stays plain Python and takes whatever has arithmetic and item assignment (numpy, CasADi);
    called from a `compiled` kernel it is compiled with it.
    """
    return register_jitable(function)
