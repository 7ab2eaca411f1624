"""Ray casting of pictures."""
