"""Precision, the plan of execution, shared device arrays, clocks, random numbers."""
