// For group g of flagella: BODY with V, a vector of the W lanes, each with the first node and the last row of its
// flagellum. None of this is for CUDA, but a kernel that could call it must compile there.
#ifndef __CUDACC__
    const int rows = groups.rows.data[g];
    auto run = [&](auto zero) {
        using V = decltype(zero);
        constexpr int W = sizeof(V) / sizeof(REAL);
        int flagellum[W], node[W], last[W], shortest = rows;
        for (int l = 0; l < W; ++l) {
            flagellum[l] = groups.first.data[g] + (l < groups.count.data[g] ? l : groups.count.data[g] - 1);
            node[l] = first_node.data[flagellum[l]];
            last[l] = first_node.data[flagellum[l] + 1] - node[l] - 1;
            shortest = last[l] + 1 < shortest ? last[l] + 1 : shortest;
        }
        auto element = [&](int l, int i) { return node[l] + (i < last[l] ? i : last[l]); };
        BODY
    };
    switch (groups.width.data[g]) { CASES }
#endif
