"""Rod mechanics: rotations, elastic forces and their stiffness, charts and reconstruction."""
