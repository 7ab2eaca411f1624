"""What a scene requires, what it leaves out, and the time that it takes: told before it is run."""

from __future__ import annotations

from warpflag.run.check.report import report

__all__ = ["report"]
