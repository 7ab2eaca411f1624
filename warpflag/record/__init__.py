"""Records of runs: frames, how they are written and how they are read."""

from warpflag.record.layout import RECORD_NAME, Frame, FrameRows, RecordError
from warpflag.record.record import Record

__all__ = ["RECORD_NAME", "Frame", "FrameRows", "Record", "RecordError"]
