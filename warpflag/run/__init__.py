"""One run: the simulation, its directory, checkpoints and summary."""
