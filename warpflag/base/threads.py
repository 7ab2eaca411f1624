"""One thread below NumPy for a process of the command line."""

from __future__ import annotations

import os

__all__ = ["ONE_THREAD", "keep_to_one_thread"]

ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment in which the libraries below NumPy start no threads."""


def keep_to_one_thread() -> None:
    """Has NumPy, not imported yet, compute in one thread, unless the environment says how many.

    Its matrices are small here, and threads wait for each other at full load: on two cores that have other work, too,
    200 ms of `ecoli.toml` took 40 s and 17 s of computing, in one thread 10 s and 3 s.
    """
    for name, count in ONE_THREAD.items():
        os.environ.setdefault(name, count)
