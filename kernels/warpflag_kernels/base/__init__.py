"""Precision, device arrays and clocks: what every kernel stands on."""
