"""`python -m warpflag`: the command line."""

import sys

from warpflag.cli import main

sys.exit(main())
