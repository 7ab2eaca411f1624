"""NumPy computes in one thread in a command, unless the user has said how many."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from warpflag.base.threads import ONE_THREAD

_LISTING = """
import os, sys
sys.argv = ["warpflag", "devices"]
from warpflag.cli import command
assert "numpy" not in sys.modules
command()
import numpy
numpy.eye(400) @ numpy.eye(400)
print(len(os.listdir("/proc/self/task")))
"""


@pytest.mark.skipif(not os.path.isdir("/proc/self/task") or (os.cpu_count() or 1) < 2, reason="threads are not listed")
@pytest.mark.parametrize(("asked", "threads"), [(None, 1), ("2", 2)])
def test_a_command_has_as_many_threads_as_asked(asked, threads):
    environment = {name: value for name, value in os.environ.items() if name not in ONE_THREAD}
    if asked is not None:
        environment["OPENBLAS_NUM_THREADS"] = asked
    found = subprocess.run(
        [sys.executable, "-c", _LISTING], env=environment, capture_output=True, text=True, check=True
    )
    assert int(found.stdout.split()[-1]) == threads
