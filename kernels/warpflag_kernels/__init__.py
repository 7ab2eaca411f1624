"""Warp kernels of warpflag: one file per piece of physics, float32 and float64, CPU and CUDA from one source."""
