"""Files made from a record: whole or absent, and one kind of error for what can't be made."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["OutputError", "whole"]


class OutputError(ValueError):
    """A movie, picture or export that can't be made as it was asked for; one line."""


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary name of the same kind beside `path`; what was written there is `path` when the block ends well."""
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
