"""From a scene to device arrays: initial shapes, starts, terms."""
