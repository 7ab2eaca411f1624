// All rows but the first of one group of flagella: every segment turned and stretched by the increment s x, and MANY
// other increments transported with it.
auto dot = [](const V a[3], const V b[3]) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
auto cross = [](const V a[3], const V b[3], V to[3]) {
    to[0] = a[1] * b[2] - a[2] * b[1];
    to[1] = a[2] * b[0] - a[0] * b[2];
    to[2] = a[0] * b[1] - a[1] * b[0];
};
auto inverse_length = [&](const V a[3]) { return REAL(1) / __builtin_elementwise_sqrt(dot(a, a)); };
auto of_body = [&](const REAL* b, const V at[3], V to[3]) {  // increment of a point of the body
    const V turn[3] = {zero + b[3], zero + b[4], zero + b[5]};
    cross(turn, at, to);
    for (int r = 0; r < 3; ++r) to[r] += b[r];
};
const REAL* body = (const REAL*)(x.body.data + cell);
const wp::quat_t<double> orientation = end.body_orientation.data[cell];
V y_old[3], y[3], x_before[3];
for (int l = 0; l < W; ++l) {
    const auto anchor = model.motor.anchor.data[flagellum[l]];
    const auto at = wp::quat_rotate(orientation, wp::vec_t<3, double>(anchor[0], anchor[1], anchor[2]));
    for (int r = 0; r < 3; ++r) {
        y_old[r][l] = start.position.data[node[l]][r];
        y[r][l] = REAL(at[r]);
    }
}
of_body(body, y_old, x_before);
for (int r = 0; r < 3; ++r) x_before[r] *= s;
V before[MANY + 1][3], carried[MANY + 1][3];
for (int m = 0; m < MANY; ++m) {
    of_body((const REAL*)((m == 0 ? a : b).body.data + cell), y_old, before[m]);
    of_body((const REAL*)((m == 0 ? a : b).body.data + cell), y, carried[m]);
}
for (int i = 1; i < rows; ++i) {
    V position[3], director[3], xe[4], other[MANY + 1][4];
    for (int l = 0; l < W; ++l) {
        const int e = element(l, i);
        for (int r = 0; r < 3; ++r) position[r][l] = start.position.data[e][r];
        for (int r = 0; r < 3; ++r) director[r][l] = start.director.data[e][r];
        for (int r = 0; r < 4; ++r) xe[r][l] = x.node.data[e][r];
        for (int m = 0; m < MANY; ++m)
            for (int r = 0; r < 4; ++r) other[m][r][l] = (m == 0 ? a : b).node.data[e][r];
    }
    V t[3], d[3], w[3];
    for (int r = 0; r < 3; ++r) {
        t[r] = position[r] - y_old[r];
        y_old[r] = position[r];
    }
    const V length_old = __builtin_elementwise_sqrt(dot(t, t)), inverse = REAL(1) / length_old;
    for (int r = 0; r < 3; ++r) {
        t[r] *= inverse;
        d[r] = (s * xe[r] - x_before[r]) * inverse;
        x_before[r] = s * xe[r];
    }
    cross(t, d, w);
    for (int r = 0; r < 3; ++r) w[r] += s * xe[3] * t[r];
    // The quaternion of the turn.
    const V y2 = REAL(0.25) * dot(w, w);
    V sine = REAL(0.5) * SINE, cosine = COSINE;
    if (__builtin_reduce_max(y2) > REAL(SMALL_ANGLE_SQUARED))
        for (int l = 0; l < W; ++l) if (y2[l] > REAL(SMALL_ANGLE_SQUARED)) {
            const REAL half = wp::sqrt(y2[l]);
            sine[l] = REAL(0.5) * wp::sin(half) / half;
            cosine[l] = wp::cos(half);
        }
    const V q[3] = {sine * w[0], sine * w[1], sine * w[2]};
    V matrix[3][3];
    for (int r = 0; r < 3; ++r) for (int c = 0; c < 3; ++c) {
        const V turn = r == c ? REAL(2) * cosine * cosine - REAL(1) : REAL(2) * cosine * q[(6 - r - c) % 3];
        matrix[r][c] = REAL(2) * q[r] * q[c] + (c == (r + 1) % 3 ? -turn : turn);
    }
    auto turned = [&](const V v[3], V to[3]) {
        for (int r = 0; r < 3; ++r) to[r] = matrix[r][0] * v[0] + matrix[r][1] * v[1] + matrix[r][2] * v[2];
    };
    const V length = (REAL(1) + dot(t, d)) * length_old;
    V t_new[3], e1[3];
    turned(t, t_new);
    const V unit = REAL(1.5) - REAL(0.5) * dot(t_new, t_new);  // 1/length of what differs from 1 by round-off
    for (int r = 0; r < 3; ++r) {
        t_new[r] *= unit;
        y[r] += length * t_new[r];
    }
    turned(director, e1);
    const V slip = dot(e1, t_new);
    for (int r = 0; r < 3; ++r) e1[r] -= slip * t_new[r];
    const V unit1 = inverse_length(e1);
    for (int r = 0; r < 3; ++r) e1[r] *= unit1;
    for (int m = 0; m < MANY; ++m) {
        V step[3], there[3];
        for (int r = 0; r < 3; ++r) {
            step[r] = other[m][r] - before[m][r];
            before[m][r] = other[m][r];
        }
        turned(step, there);
        for (int r = 0; r < 3; ++r) carried[m][r] += there[r];
    }
    for (int l = 0; l < W; ++l) if (i <= last[l]) {
        const int e = node[l] + i;
        for (int r = 0; r < 3; ++r) end.position.data[e][r] = y[r][l];
        for (int r = 0; r < 3; ++r) end.tangent.data[e][r] = t_new[r][l];
        for (int r = 0; r < 3; ++r) end.director.data[e][r] = e1[r][l];
        end.length.data[e] = wp::abs(length[l]);
        for (int m = 0; m < MANY; ++m) {
            auto& to = (m == 0 ? a_out : b_out).node.data[e];
            for (int r = 0; r < 3; ++r) to[r] = carried[m][r][l];
            to[3] = other[m][3][l];
        }
    }
}
