"""Movies, pictures, curves and exports, all from the record."""
