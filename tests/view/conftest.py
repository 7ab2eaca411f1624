"""A run that every test of pictures draws."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.films import made_record
from warpflag.view.usd import write_movie


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Path:
    """The directory of a run with its movie, 12 frames; tests leave it as it is."""
    directory = tmp_path_factory.mktemp("run")
    with made_record(directory, 12) as record:
        write_movie(record, directory / "movie.usdc")
    return directory
