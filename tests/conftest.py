"""What every physics test runs on: each device present, in both precisions."""

from __future__ import annotations

import os

import pytest

# Each process of the tests has a core to itself: threads below NumPy would take the others' and wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _devices() -> list[str]:
    import warp as wp

    wp.config.quiet = True
    return ["cpu", *(device.alias for device in wp.get_cuda_devices())]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "device" in metafunc.fixturenames:
        metafunc.parametrize("device", _devices())


@pytest.fixture(params=["float64", "float32"])
def precision(request: pytest.FixtureRequest) -> str:
    """Numbers of the forces and positions on the device."""
    return request.param
