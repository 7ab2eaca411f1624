"""What accuracy costs on a scene: windows of its own course times choices of numerics and model, each measured."""

from __future__ import annotations

from warpflag.run.tradeoff.study import Study

__all__ = ["Study"]
