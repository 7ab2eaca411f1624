// The sum of what the WARP threads of a warp hold, in the first of them. On a CPU they are fibers of one block, which
// meet and leave their numbers where the first one finds them.
#ifdef __CUDA_ARCH__
for (int distance = WARP / 2; distance > 0; distance /= 2)
    for (int axis = 0; axis < 3; ++axis) v[axis] += __shfl_down_sync(0xffffffffu, v[axis], distance);
#elif !defined(__CUDACC__)
static REAL held[WARP][3];
for (int axis = 0; axis < 3; ++axis) held[thread][axis] = v[axis];
WP_TILE_SYNC();
if (thread == 0)
    for (int other = 1; other < WARP; ++other)
        for (int axis = 0; axis < 3; ++axis) v[axis] += held[other][axis];
WP_TILE_SYNC();
#endif
return v;
