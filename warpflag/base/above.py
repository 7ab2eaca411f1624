"""Methods whose bodies stand in a folder above: how a record or a scene shows itself in a notebook.

Imports only point down, so such a method names its function, which is loaded when it is called.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

__all__ = ["method_from"]


def method_from(module: str, function: str, doc: str) -> Callable[..., Any]:
    """A method that hands its object, and what else it is given, to a function.

    Args:
        module: dotted name of the module that has the function; imported at the first call.
        function: its name there; it takes the object first.
        doc: docstring of the method.
    """

    def method(self: Any, *values: Any, **options: Any) -> Any:
        return getattr(importlib.import_module(module), function)(self, *values, **options)

    method.__doc__ = doc
    return method
