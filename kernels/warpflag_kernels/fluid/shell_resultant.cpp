// Component i of force (0 to 2) and torque (3 to 5) of the flows at n beads on their body, which is held.
const int rows = 3 * n;
const REAL* __restrict__ R = shell.rigid.data + 18 * own + i * rows;
const REAL* __restrict__ U = shell.flow.data + at;
REAL sum = 0;
for (int r = 0; r < rows; ++r) sum += R[r] * U[r];
return sum;
