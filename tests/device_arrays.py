"""CuPy where there is a GPU; else a stand-in: NumPy behind arrays that are as strict as CuPy's.

What CuPy refuses is refused here: an array of the host in a sum, as an argument, or written
into an array of the device; an array of the device that becomes one of the host other than by
`get`; a `workers` argument of the transforms; functions that are not known to be in CuPy.
"""

from __future__ import annotations

import importlib
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import scipy.fft

IN_CUPY = frozenset(
    [
        "abs", "add", "arange", "array", "asarray", "ascontiguousarray", "ceil", "clip",
        "concatenate", "conj", "conjugate", "copysign", "cos", "cosh", "cumsum", "divide",
        "empty", "empty_like", "exp", "expm1", "float32", "float64", "floor", "fmax", "fmin",
        "full", "full_like", "int32", "int64", "isfinite", "isnan", "log", "log1p",
        "logical_and", "logical_not", "logical_or", "max", "maximum", "min", "minimum",
        "multiply", "ones", "ones_like", "rint", "sign", "sin", "sqrt", "square", "stack",
        "subtract", "sum", "take", "tanh", "tensordot", "uint32", "where", "zeros",
        "zeros_like",
    ]
)  # fmt: skip
"""Checked by name against CuPy 14.2."""
FROM_HOST = {"array", "asarray"}


class DeviceArray(np.lib.mixins.NDArrayOperatorsMixin):
    """An array that lives "on the device"."""

    def __init__(self, host: Any) -> None:
        self._host = np.asarray(host)

    def get(self) -> Any:
        """Return a copy on the host, the only way there."""
        return self._host.copy()

    def __array__(self, *args: Any, **kwargs: Any) -> Any:
        raise TypeError("implicit conversion to a NumPy array is not allowed")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        if method != "__call__":
            raise TypeError(f"CuPy has no {ufunc.__name__}.{method}")
        return call(ufunc, *inputs, **kwargs)

    def __array_function__(self, func: Any, types_: Any, args: Any, kwargs: Any) -> Any:
        if func.__name__ not in IN_CUPY:
            raise TypeError(f"{func.__name__} is not known to be in CuPy")
        return call(func, *args, **kwargs)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = getattr(self._host, name)
        if callable(value):
            return lambda *args, **kwargs: call(value, *args, **kwargs)
        return DeviceArray(value) if isinstance(value, np.ndarray) else value

    def __getitem__(self, key: Any) -> DeviceArray:
        return DeviceArray(self._host[lower_key(key)])

    def __setitem__(self, key: Any, value: Any) -> None:
        self._host[lower_key(key)] = lower(value)

    def __len__(self) -> int:
        return len(self._host)

    def __float__(self) -> float:
        return float(self._host)

    def __int__(self) -> int:
        return int(self._host)

    def __bool__(self) -> bool:
        return bool(self._host)


def lower(value: Any) -> Any:
    """Return what lies behind a value of the device; an array of the host is refused."""
    if isinstance(value, DeviceArray):
        return value._host
    if isinstance(value, np.ndarray) and value.ndim > 0:
        raise TypeError("unsupported type numpy.ndarray: an array of the host came to the device")
    if isinstance(value, list | tuple):
        return type(value)(lower(item) for item in value)
    return value


def lower_key(key: Any) -> Any:
    """Return an index with arrays of the device lowered."""
    if isinstance(key, tuple):
        return tuple(lower_key(item) for item in key)
    return key._host if isinstance(key, DeviceArray) else key


def lift(value: Any) -> Any:
    """Return arrays, and what would be scalars of NumPy, as arrays of the device."""
    return DeviceArray(value) if isinstance(value, np.ndarray | np.generic) else value


def call(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call NumPy on what lies behind the arguments."""
    return lift(function(*map(lower, args), **{k: lower(v) for k, v in kwargs.items()}))


def function_of(name: str) -> Any:
    """Return the stand-in of `cupy.<name>`."""
    value = getattr(np, name)
    if isinstance(value, type):
        return value
    if name in FROM_HOST:
        return lambda a, *args, **kwargs: DeviceArray(
            value(a._host if isinstance(a, DeviceArray) else a, *args, **kwargs).copy()
        )
    return lambda *args, **kwargs: call(value, *args, **kwargs)


def transform_of(name: str) -> Any:
    """Return the stand-in of `cupyx.scipy.fft.<name>`: no `workers`, and only of the device."""
    value = getattr(scipy.fft, name)

    def transform(x: DeviceArray, **options: Any) -> DeviceArray:
        if not isinstance(x, DeviceArray):
            raise TypeError("an array of the host came to a transform of the device")
        if not options.keys() <= {"n", "s", "axis", "axes", "norm", "overwrite_x"}:
            raise TypeError(f"CuPy's {name} does not take all of {sorted(options)}")
        return DeviceArray(value(x._host, **options))

    return transform


def has_gpu() -> bool:
    """Return whether CuPy finds a GPU that works."""
    try:
        cupy = importlib.import_module("cupy")
        return bool(float(cupy.ones(3).sum()) == 3.0)
    except Exception:  # whatever CuPy says about a missing driver
        return False


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `import cupy` and `import cupyx.scipy.fft` find the stand-ins, for one test.

    Where there is a GPU they find CuPy, and the test runs on it.
    """
    if has_gpu():
        return
    cupy, cupyx = types.ModuleType("cupy"), types.ModuleType("cupyx")
    cupyx_scipy, cupyx_fft = types.ModuleType("cupyx.scipy"), types.ModuleType("cupyx.scipy.fft")
    for name in IN_CUPY:
        setattr(cupy, name, function_of(name))
    for name in ("fft", "ifft", "rfft", "irfft", "rfft2", "irfft2"):
        setattr(cupyx_fft, name, transform_of(name))
    for module in (cupy, cupyx, cupyx_scipy, cupyx_fft):
        monkeypatch.setitem(sys.modules, module.__name__, module)
