"""The movie of a record as a USD scene: how it is written, read back and checked."""

from warpflag.view.usd.movie import Shot, movie_stage, write_movie

__all__ = ["Shot", "movie_stage", "write_movie"]
