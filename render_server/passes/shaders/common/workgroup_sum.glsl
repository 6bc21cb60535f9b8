// Sum over a workgroup of THREADS threads (= local_size_x, a power of two), which all of them get.
shared vec2 workgroup_parts[THREADS];

vec2 workgroup_sum(vec2 own, int thread) {
    workgroup_parts[thread] = own;
    barrier();
    for (int apart = THREADS / 2; apart > 0; apart /= 2) {
        if (thread < apart) workgroup_parts[thread] += workgroup_parts[thread + apart];
        barrier();
    }
    return workgroup_parts[0];
}
