"""Contact: steric force, neighbour lists, contact search."""
