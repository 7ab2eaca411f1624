"""Warp and its devices: started silently, found by name, described."""

from __future__ import annotations

import functools
import os
import tempfile
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

from warpflag.base.streams import say

__all__ = [
    "LAUNCHING",
    "DeviceError",
    "alone",
    "cores",
    "find_device",
    "list_devices",
    "start_warp",
]


_F = TypeVar("_F", bound=Callable[..., Any])
LAUNCHING = threading.RLock()
"""Held by the thread that launches kernels: a capture records what any thread launches meanwhile."""


def alone(function: _F) -> _F:
    """The function, called by one thread at a time: it launches kernels or captures them."""

    @functools.wraps(function)
    def called(*args: Any, **options: Any) -> Any:
        with LAUNCHING:
            return function(*args, **options)

    return cast("_F", called)


class DeviceError(ValueError):
    """This machine has no such device; the message is one line that says which it has."""


LEAST_ADDRESSES = 2.0e9
"""Address space below which loading kernels ends in a crash instead of an error [bytes]: 1.6e9 crashed, 1.8e9 ran."""


@functools.cache
def start_warp() -> Any:
    """The module `warp`, initialised, with nothing said below warnings.

    Its library writes to the process's standard error that there is no CUDA driver. On a machine without a GPU that
    is no news, so what it writes while it starts is caught and only the rest passed on.

    Raises:
        MemoryError: this process may not have the addresses that Warp's compiler needs, without which it crashes.
    """
    _check_addresses()
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    try:
        kept = os.dup(2)
    except OSError:  # no standard error
        wp.init()
        return wp
    try:
        with tempfile.TemporaryFile() as caught:
            say("")  # what Python holds back goes first
            os.dup2(caught.fileno(), 2)
            try:
                wp.init()
            finally:
                os.dup2(kept, 2)
            caught.seek(0)
            lines = caught.read().decode(errors="replace").splitlines(keepends=True)
    finally:
        os.close(kept)
    say("".join(line for line in lines if "find or load the NVIDIA CUDA driver" not in line))
    return wp


def _check_addresses() -> None:
    try:
        import resource
    except ImportError:  # no POSIX system
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_ADDRESSES:
        allowed = f"{limit / 1e9:.3g} of the {LEAST_ADDRESSES / 1e9:.3g} GB of addresses that kernels need"
        raise MemoryError(f"this process may have {allowed} (ulimit -v)")


def find_device(name: Any = None) -> Any:
    """Warp's device of a name.

    Args:
        name: "cpu", "cuda:0", ...; default: the device that Warp prefers.

    Raises:
        DeviceError: this machine has no such device.
    """
    wp = start_warp()
    try:
        if str(name).startswith("cuda") and not wp.is_cuda_available():
            raise ValueError("no CUDA driver, or no device")  # Warp's own look would print its errors
        return wp.get_device(name)
    except Exception as error:
        aliases = ", ".join(device.alias for device in wp.get_devices())
        raise DeviceError(f"device {name}: not here; this machine has {aliases}") from error


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def list_devices() -> list[str]:
    """One line per device: its name for --device, what it is, its memory; the preferred one is marked."""
    wp = start_warp()
    lines = []
    for device in wp.get_devices():
        memory = f", {device.total_memory / 2**30:.0f} GiB, sm_{device.arch}" if device.is_cuda else ""
        mark = "  (default)" if device == wp.get_preferred_device() else ""
        lines.append(f"{device.alias:<8} {device.name}{memory}{mark}")
    return lines
