// Sum over a workgroup of THREADS threads (= local_size_x, a power of two), which all of them get.
shared vec2 workgroup_parts[THREADS];

vec2 workgroup_sum(vec2 own, int thread) {
    workgroup_parts[thread] = own;
    barrier();
    for (int stride = THREADS / 2; stride > 0; stride /= 2) {
        if (thread < stride) workgroup_parts[thread] += workgroup_parts[thread + stride];
        barrier();
    }
    return workgroup_parts[0];
}
