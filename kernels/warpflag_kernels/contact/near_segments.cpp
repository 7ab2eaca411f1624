// Lists the segments [begin, end) of one flagellum that are near (x, y, z), in ascending order; returns the length of the
// list. A CPU tests a block of them at once: a bit for each that is near. What a block reads beyond `end` is masked, and
// lies within the arrays, which are a block longer than there are segments.
const float* __restrict__ X = near.x.data; const float* __restrict__ Y = near.y.data;
const float* __restrict__ Z = near.z.data; const float* __restrict__ H = near.half.data;
int* S = near.segment.data + list;
#ifdef __CUDACC__
for (int j = begin; j < end; ++j) {
    const float dx = x - X[j], dy = y - Y[j], dz = z - Z[j], reach = within + H[j];
    if (dx * dx + dy * dy + dz * dz < reach * reach) {
        if (found < SLOTS) S[found] = j;
        ++found;
    }
}
#else
for (int b = begin; b < end; b += TESTED_AT_ONCE) {
    unsigned hits = 0;
    for (int l = 0; l < TESTED_AT_ONCE; ++l) {
        const float dx = x - X[b + l], dy = y - Y[b + l], dz = z - Z[b + l], reach = within + H[b + l];
        hits |= (unsigned)(dx * dx + dy * dy + dz * dz < reach * reach) << l;
    }
    if (end - b < TESTED_AT_ONCE) hits &= (1u << (end - b)) - 1u;
    for (; hits; hits &= hits - 1) {
        if (found < SLOTS) S[found] = b + __builtin_ctz(hits);
        ++found;
    }
}
#endif
return found;
