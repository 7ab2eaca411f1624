"""`python -m warpflag`: the command line."""

import sys

from warpflag.cli import command

sys.exit(command())
