"""A pass of launches on a CPU as a program: its kernels and their arguments, found once and called one after another.

Warp's own graph of a CPU looks up every kernel by name and packs its arguments anew at each replay, 0.1 us a launch and
3 to 4 ns an array: for the 45 small kernels of an implicit step of two flagella, which have all arrays of model and
state, 29 % of its time. Here each launch is a call of a function whose address is known, with arguments that lie ready.
"""

from __future__ import annotations

import contextlib
import ctypes
import enum
import functools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.native import without_comments


class _Kind(enum.IntEnum):
    """Of an instruction, as in run_program.cpp; four integers each: the kind, and up to three values."""

    CALL = 0  # a kernel: address of its function, of its grid, of its arguments
    UNLESS_ZERO = 1  # go on with the next one, or elsewhere: address of a condition, instruction if that is zero
    GO = 2  # elsewhere: 0, instruction
    COPY = 3  # an array: address of the copy, of the array, bytes
    CLEAR = 4  # an array: its address, 0, bytes


@functools.cache
def _kernel() -> Any:
    module = wp.get_module("warpflag_kernels.program")

    @wp.func_native(without_comments(Path(__file__).with_name("run_program.cpp")))
    def run_program(instructions: wp.array(dtype=wp.int64), count: wp.int32): ...

    @wp.kernel(module=module)
    def run(
        # Model:
        instructions: wp.array(dtype=wp.int64),
        count: wp.int32,
    ):
        run_program(instructions, count)

    return run


@functools.cache
def _struct(kinds: tuple[type, ...]) -> type[ctypes.Structure]:
    """A struct of values of these kinds, as C lays it out."""
    fields = [(f"value_{i}", kind) for i, kind in enumerate(kinds)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


@contextlib.contextmanager
def replaced(owner: Any = wp, **functions: Callable[..., None]) -> Iterator[None]:
    """While it lasts, functions of Warp, or of its arrays, are replaced for the thread that asks for it."""
    kept, thread = {name: getattr(owner, name) for name in functions}, threading.get_ident()

    def chosen(name: str) -> Callable[..., Any]:
        def call(*values: Any, **options: Any) -> Any:
            function = functions[name] if threading.get_ident() == thread else kept[name]
            return function(*values, **options)

        return call

    try:
        for name in functions:
            setattr(owner, name, chosen(name))
        yield
    finally:
        for name, function in kept.items():
            setattr(owner, name, function)


def _refuse(array: wp.array, *_values: Any, **_options: Any) -> None:
    raise RuntimeError(f"a captured pass launches, copies and clears, and sets no array of {array.dtype.__name__}")


def _bytes(array: wp.array) -> int:
    return array.size * wp.types.type_size_in_bytes(array.dtype)


class Program:
    """Launches under conditions and in loops, in the order in which a function makes them.

    Args:
        body: makes them, by `wp.launch`, `wp.capture_if` and `wp.capture_while`, beside `wp.copy` and `zero_` of whole
            arrays; none of that is run.
        device: Warp's CPU.

    Attributes:
        in_blocks: whether a kernel works in blocks of threads, which Warp has to schedule: then this can't be run.

    Raises:
        RuntimeError: the body sets an array otherwise, which would not be repeated.
    """

    def __init__(self, body: Callable[[], None], device: Any) -> None:
        self.in_blocks = False
        self._kept: list[Any] = []  # what the instructions point to
        self._code: list[list[int]] = []
        self._launch = wp.launch
        recorded = {"launch": self._add_call, "capture_if": self._add_condition, "capture_while": self._add_loop}
        set_whole = {"zero_": self._add_clear, "fill_": _refuse, "assign": _refuse}
        with replaced(wp, copy=self._add_copy, **recorded), replaced(wp.array, **set_whole):
            body()
        instructions = wp.array(np.array(self._code, dtype=np.int64).ravel(), dtype=wp.int64, device=device)
        command = self._launch(_kernel(), 1, inputs=[instructions, len(self._code)], device=device, record_cmd=True)
        self._function, *self._arguments = self._packed(command)

    def run(self) -> None:
        """Runs it once, without Python's lock."""
        self._function(*(ctypes.byref(x) for x in self._arguments))

    def _packed(self, command: Any) -> tuple[Any, Any, Any]:
        """The function of a launch on a CPU, its grid and its arguments."""
        grid, *values = command.params
        packed = _struct(tuple(map(type, values)))(*values)
        self._kept += [command, packed]  # the command holds the arrays and the module
        return command.hooks.forward, grid, packed

    def _add_call(self, kernel: Any, dim: Any, *arguments: Any, **options: Any) -> None:
        command = self._launch(kernel, dim, *arguments, **options, record_cmd=True)
        if command is None:  # of no threads
            return
        self.in_blocks |= command.block_dim > 1
        function, grid, packed = self._packed(command)
        address = ctypes.cast(function, ctypes.c_void_p).value or 0
        self._code.append([_Kind.CALL, address, ctypes.addressof(grid), ctypes.addressof(packed)])

    def _add_copy(self, dest: wp.array, src: wp.array) -> None:
        if not (dest.is_contiguous and src.is_contiguous and dest.size == src.size and dest.dtype is src.dtype):
            raise RuntimeError("a captured pass copies whole arrays of one kind")
        self._kept += [dest, src]
        self._code.append([_Kind.COPY, dest.ptr or 0, src.ptr or 0, _bytes(src)])

    def _add_clear(self, array: wp.array) -> None:
        if not array.is_contiguous:
            raise RuntimeError("a captured pass clears whole arrays")
        self._kept.append(array)
        self._code.append([_Kind.CLEAR, array.ptr or 0, 0, _bytes(array)])

    def _add_condition(self, condition: wp.array, on_true: Callable[..., None], **options: Any) -> None:
        begin = len(self._code)
        self._kept.append(condition)
        self._code.append([_Kind.UNLESS_ZERO, condition.ptr, 0, 0])
        on_true(**options)
        self._code[begin][2] = len(self._code)

    def _add_loop(self, condition: wp.array, while_body: Callable[..., None], **options: Any) -> None:
        begin = len(self._code)

        def body() -> None:
            while_body(**options)
            self._code.append([_Kind.GO, 0, begin, 0])

        self._add_condition(condition, body)


def captured_loop(condition: wp.array, body: Callable[[], None], device: Any) -> Callable[[], None]:
    """What launches make, captured: a function that repeats them on the device for as long as a condition is not zero.

    Args:
        condition: of one integer, which launches change.
        body: launches; their kernels are loaded.
        device: of Warp; elsewhere than on a CPU, and with kernels in blocks, this is a graph of Warp's.

    Raises:
        RuntimeError: the body sets an array other than by launches, copies and `zero_`.
    """

    def loop() -> None:
        wp.capture_while(condition, body)

    if device.is_cpu and not (program := Program(loop, device)).in_blocks:
        return program.run
    with wp.ScopedCapture(device=device) as captured:
        loop()
    return functools.partial(wp.capture_launch, captured.graph)


def load(device: Any) -> None:
    """Launches the kernel that runs programs, with an empty one, where one is needed."""
    if not device.is_cpu:
        return
    wp.launch(_kernel(), 1, inputs=[wp.zeros(1, dtype=wp.int64, device=device), 0], device=device)
