"""The one place where numba is named: typed, cached on disk, no fast-math (results must not depend on the machine)."""

import atexit
import hashlib
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType
from typing import Any, TypeVar, cast, get_args

import numba
from numba.core import config as numba_config
from numba.core import event as numba_event
from numba.extending import register_jitable

from .compiling import compilation_began, many_compilations

_Function = TypeVar("_Function", bound=Callable[..., Any])

# Its settings are made when it is imported, and no type checker sees them.
_config: Any = numba_config
_event: Any = numba_event
# One or two more go unnoticed, a cold start has dozens.
_NOTICED = 3


class _Compilations(numba_event.Listener):
    """Counts what is compiled (not what is read from the cache) and says so when it is noticed."""

    def __init__(self) -> None:
        self.count = 0

    def on_start(self, event: Any) -> None:
        """Count a compilation that begins."""
        del event
        self.count += 1
        compilation_began()
        if self.count == _NOTICED:
            many_compilations()

    def on_end(self, event: Any) -> None:
        """Leave it at the beginning."""


compilations = _Compilations()
_event.register("numba:compile", compilations)


class _Stamp:
    """What numba's cache compares: numba's own stamp of the kernel's file, and all that is compiled into the kernel.

    Without it a change of an equation in another file would leave the kernels that use it as they were. It is
    computed when the cache is first asked, since a kernel may call functions that are defined below it.
    """

    def __init__(self, own: object, function: Callable[..., Any]) -> None:
        self._own, self._function = own, function

    def __str__(self) -> str:
        digest = hashlib.sha256()
        for part in _parts(cast(FunctionType, self._function), set()):
            digest.update(part.encode())
        return f"{self._own} {digest.hexdigest()}"

    def __eq__(self, other: object) -> bool:
        return str(self) == other

    __hash__ = None  # type: ignore[assignment] # compared only

    def __reduce__(self) -> tuple[type[str], tuple[str]]:
        return str, (str(self),)


def _parts(function: FunctionType, seen: set[FunctionType]) -> Iterator[str]:
    """Yield name, code and constants of a function and of every function of this project that it calls.

    The name because what is compiled finds a function that it calls by the module in which it was.
    """
    seen.add(function)
    code = function.__code__
    yield f"{function.__module__}.{function.__qualname__}"
    yield code.co_code.hex()
    yield repr([each for each in code.co_consts if not isinstance(each, CodeType)])
    for annotation in function.__annotations__.values():
        yield from _fields(annotation)
    for name in code.co_names:
        value = function.__globals__.get(name)
        called = getattr(value, "py_func", value)
        if isinstance(value, type):
            yield from _fields(value)
        if not isinstance(called, FunctionType):
            yield f"{name} {value!r}" if isinstance(value, int | float | tuple) else name
        elif called not in seen and _floor(called) in (__package__, _floor(function)):
            yield from _parts(called, seen)


def _fields(annotation: Any) -> Iterator[str]:
    """Yield the fields of the named tuples in an annotation: numba's stamp knows their types, not their order."""
    if isinstance(annotation, type) and hasattr(annotation, "_fields"):
        yield f"{annotation.__name__} {annotation._fields}"
        for field in annotation.__annotations__.values():
            yield from _fields(field)
    for part in get_args(annotation):
        yield from _fields(part)


def _floor(function: FunctionType) -> str:
    return function.__module__.split(".")[0]


def compiled(function: _Function) -> _Function:
    """Compile a kernel of floats and arrays; the straight Python version stays at `.py_func`."""
    return _compile(function)


def released(function: _Function) -> _Function:
    """Compile a kernel that lets go of the interpreter's lock and, unlike an `unlocked` one, makes arrays itself."""
    return _compile(function, nogil=True)


def unlocked(function: _Function) -> _Function:
    """Compile a kernel that lets go of the interpreter's lock, so that threads may run beside each other.

    It takes the arrays that it fills and makes none itself, so that nothing is counted at each access.
    """
    return _compile(function, nogil=True, _nrt=False)


def inlined(function: _Function) -> _Function:
    """Mark a part of an `unlocked` kernel, which becomes one with it; called from Python it stays plain Python."""
    return register_jitable(error_model="numpy", _nrt=False, forceinline=True)(function)


def _compile(function: _Function, **options: bool) -> _Function:
    njit: Any = numba.njit
    if _config.DISABLE_JIT:
        # Plain Python, to be followed by a debugger; whoever asks for the straight version finds it all the same.
        function.py_func = function  # type: ignore[attr-defined]
        return function
    try:
        dispatcher = njit(cache=True, error_model="numpy", **options)(function)
    except RuntimeError:
        if _config.CACHE_DIR:
            raise
        _use_temporary_cache()
        dispatcher = njit(cache=True, error_model="numpy", **options)(function)
    index = dispatcher._cache._cache_file  # noqa: SLF001 - numba offers no other way to name what a kernel depends on
    index._source_stamp = _Stamp(index._source_stamp, function)  # noqa: SLF001
    return cast(_Function, dispatcher)


def _use_temporary_cache() -> None:
    """Compile into a folder that ends with this process: neither the package's own nor the user's can be written."""
    folder = tempfile.mkdtemp(prefix="autotune-kernels-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    _config.CACHE_DIR = folder
    warnings.warn(
        "Compiled kernels can be kept in no folder: neither beside the package nor in the user's cache may be written. "
        "They are compiled for this run only; set NUMBA_CACHE_DIR to a folder that may be written.",
        RuntimeWarning,
        stacklevel=2,
    )


def equation(function: _Function) -> _Function:
    """Mark an equation that is written once and serves two readers.

    Called from Python it stays plain Python and takes whatever has arithmetic and item assignment (numpy, CasADi);
    called from a `compiled` kernel it is compiled with it.
    """
    return register_jitable(error_model="numpy")(function)
