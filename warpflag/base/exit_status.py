"""Exit statuses of the commands: part of what scripts rely on."""

__all__ = ["BAD_INPUT", "DONE", "FAILED", "INTERRUPTED", "STOPPED", "TERMINATED"]

DONE = 0  # as every command has it
FAILED = 1  # the machine failed the run: disk full, no permission
BAD_INPUT = 2  # a line for each problem; as argparse has it
STOPPED = 3  # a guard stopped the run
INTERRUPTED = 130  # by Ctrl-C: 128 and the number of the signal, as shells tell it
TERMINATED = 143  # by a signal or out of wall time: 128 and that of SIGTERM
