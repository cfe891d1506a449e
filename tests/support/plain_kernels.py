"""Kernels of the laboratory as plain Python, beside the same kernels compiled."""

from collections.abc import Callable
from inspect import isfunction, unwrap
from types import FunctionType
from typing import Any


def plain(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel in Python, with nothing compiled below it."""
    function: Any = unwrap(kernel)
    scope = dict(function.__globals__)
    for name in function.__code__.co_names:
        called = scope.get(name)
        if callable(called) and isfunction(unwrap(called)):
            scope[name] = plain(called)
    return FunctionType(function.__code__, scope)
