"""Records of runs: frames, how they are written and how they are read."""

from warpflag.record.record import RECORD_NAME, Frame, Record, RecordError

__all__ = ["RECORD_NAME", "Frame", "Record", "RecordError"]
