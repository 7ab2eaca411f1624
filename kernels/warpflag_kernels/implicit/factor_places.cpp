// A row of factors is C_ii^-1, lower triangle, C_(i,i+1) and C_(i,i+2); how a vector of lanes is read and written.
REAL* F = factors.blocks.data + NUMBERS * (size_t)groups.start.data[g];
auto get = [](const REAL* from) { V v; __builtin_memcpy(&v, from, sizeof(V)); return v; };
auto put = [](REAL* to, V v) { __builtin_memcpy(to, &v, sizeof(V)); };
