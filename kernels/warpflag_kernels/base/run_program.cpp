// A program of launches on a CPU, four integers an instruction: see program.py.
for (int at = 0; at < count;) {
    const long long* const now = instructions.data + 4 * at;
    switch (now[0]) {
    case 0:  // a kernel, its grid, its arguments
        reinterpret_cast<void (*)(void*, void*)>(now[1])(
            reinterpret_cast<void*>(now[2]), reinterpret_cast<void*>(now[3])
        );
        ++at;
        break;
    case 1:  // a condition; where to go on if it is zero
        at = *reinterpret_cast<const int*>(now[1]) != 0 ? at + 1 : static_cast<int>(now[2]);
        break;
    case 2:  // where to go on
        at = static_cast<int>(now[2]);
        break;
    case 3:  // a copy, what is copied, bytes
        memcpy(reinterpret_cast<void*>(now[1]), reinterpret_cast<const void*>(now[2]), static_cast<size_t>(now[3]));
        ++at;
        break;
    default:  // an array to clear, bytes
        memset(reinterpret_cast<void*>(now[1]), 0, static_cast<size_t>(now[3]));
        ++at;
    }
}
