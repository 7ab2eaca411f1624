"""Kernels that are about to run: found, compiled side by side where they are not in the cache, and loaded."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from warpflag.base.device import cores, start_warp
from warpflag.base.kernel_cache import keep_checksums, kernel_folder, remove_damaged
from warpflag.base.progress import bar
from warpflag.base.streams import is_terminal, tell

__all__ = ["load_kernels", "noted_launches"]

_MOST_AT_ONCE = 4  # modules; each takes some 200 MB of memory while it is compiled
# A thread that compiles begins with Warp's headers, which takes it as long as two modules of the usual size: 4 s.
_LEAST_PER_THREAD = 3  # modules
EXPLAINED_AFTER = 2.0  # after which a line says that kernels are being compiled: a warm cache needs no word
_SECONDS_PER_LOOK = 0.2  # between two counts of what has been compiled: five a second
_LOADED_FOLDERS: set[Path] = set()  # folders of the modules that this process has loaded


@contextlib.contextmanager
def noted_launches() -> Iterator[set[tuple[Any, int | None]]]:
    """While it lasts, launches are noted instead of made, those under a condition once; hold `LAUNCHING`.

    Returns:
        Kernels that were launched, each with its block size where one was given.
    """
    start_warp()
    from warpflag_kernels.base.program import replaced

    noted: set[tuple[Any, int | None]] = set()

    def launch(kernel: Any, *_arguments: Any, block_dim: int | None = None, **_options: Any) -> None:
        noted.add((kernel, block_dim))

    def under(_condition: Any, *bodies: Any, **options: Any) -> None:
        for body in (*bodies, options.pop("on_true", None), options.pop("on_false", None)):
            if body is not None:
                body(**options)

    with replaced(launch=launch, capture_if=under, capture_while=under):
        yield noted


def load_kernels(
    launch: Callable[[], None], device: Any, quiet: bool = False, explained_after: float = EXPLAINED_AFTER
) -> float:
    """Loads the kernels that a function launches; several modules at once are compiled where they are not in the cache.

    Args:
        launch: launches them; nothing of it is run, and arrays stay as they are.
        device: of Warp.
        quiet: say nothing; otherwise compiling that lasts is explained on standard error.
        explained_after: how long it may last without a word [s].

    Returns:
        Computing time that compiling took [s]; 0 where all were in the cache.
    """
    with noted_launches() as noted:
        launch()
    # A CPU has one form of each module, whatever the blocks.
    modules = {(kernel.module, None if device.is_cpu else block) for kernel, block in noted}
    waiting = sorted(((module, block) for module, block in modules), key=lambda own: (own[0].name, own[1] or 0))
    identifiers = {module.get_module_identifier(1 if device.is_cpu else block) for module, block in waiting}
    folders = {kernel_folder() / identifier for identifier in identifiers}
    fresh = folders - _LOADED_FOLDERS
    damaged = remove_damaged(fresh)
    if damaged and not quiet:
        tell(f"{len(damaged)} compiled modules in {kernel_folder()} were damaged, and are compiled again")
    missing = {path for path in folders if not path.exists()}.union(damaged)
    began = time.process_time()
    if not missing:
        for module, block in waiting:
            _load(module, block, device)
    else:
        with _explained(missing, quiet, explained_after):
            pool = ThreadPoolExecutor(min(_MOST_AT_ONCE, cores(), math.ceil(len(missing) / _LEAST_PER_THREAD)))
            try:
                for loaded in [pool.submit(_load, module, block, device) for module, block in waiting]:
                    loaded.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)  # an interrupt does not wait for the others
    compiling = time.process_time() - began if missing else 0.0
    keep_checksums(fresh)
    _LOADED_FOLDERS.update(folders)
    return compiling


def _load(module: Any, block: int | None, device: Any) -> None:
    start_warp().force_load(device, [module], block, 0)


@contextlib.contextmanager
def _explained(missing: set[Path], quiet: bool, explained_after: float) -> Iterator[None]:
    """While it lasts, says how many of the modules that were missing are in the cache; nothing if it does not last."""
    over = threading.Event()

    def explain() -> None:
        if over.wait(explained_after):
            return
        plural = "s" if len(missing) > 1 else ""
        kind = f"compiling {len(missing)} module{plural} of kernels, once for each kind of scene on each machine"
        tell(f"{kind}, up to two minutes; kept in {kernel_folder()}")
        if not is_terminal(sys.stderr):
            return
        shown = bar(len(missing), "compiling kernels, {n:.0f} of {total:.0f} |{bar}| {elapsed}")
        while not over.wait(_SECONDS_PER_LOOK):
            shown.update(sum(map(os.path.exists, missing)) - shown.n)
            shown.refresh()
        shown.update(sum(map(os.path.exists, missing)) - shown.n)
        shown.close()

    thread = threading.Thread(target=explain, daemon=True)
    if not quiet:
        thread.start()
    try:
        yield
    finally:
        over.set()
        if not quiet:
            thread.join()
