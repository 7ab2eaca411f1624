"""Devices, output files, text streams, the progress line and rotations, which all other folders use."""
