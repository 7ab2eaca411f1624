"""Devices, output files and progress: what the other rooms stand on."""
