// A march that begins beyond the objects' volume: through the coarse scene into it, and out again. Where mu and rho
// differ lies inside, so that both share the way to it. Needs march.glsl with ENDS_AHEAD, environment.glsl.

// Through this volume from `start` (voxels) on the ray q + t d, and on through the coarse scene.
Crossed march_through(sampler3D mipmap, vec3 q, vec3 d, float start, float ratio, Crossed sum) {
    bool differs = false;
    float t = start;
    if (sum.coverage < WALL) t += march_near(mipmap, q + start * d, d, start, ratio, sum, differs);
    vec3 leave = (volume_origin + (q + t * d) * voxel_edge - far_origin) / far_edge;
    if (far_size > 0 && sum.coverage < WALL) march_far(leave, d, t * voxel_edge / far_edge, ENDLESS, ratio, sum);
    return sum;
}

// Change of the radiance that arrives along d at q (voxels); `ratio`: the cone's diameter / distance.
vec3 change_along(vec3 q, vec3 d, float ratio) {
    vec2 within = box_interval(q, d, vec3(0.0), vec3(float(volume_size)));
    if (within.x >= within.y) return vec3(0.0);
    Crossed sum = Crossed(vec3(0.0), 0.0);
    float ahead = within.x * voxel_edge / far_edge, skip = 1.5;   // as march_one begins
    if (far_size > 0 && ahead > skip)
        march_far((volume_origin + q * voxel_edge - far_origin) / far_edge + skip * d, d, skip, ahead - skip, ratio, sum);
    if (sum.coverage >= WALL) return vec3(0.0);
    float start = within.x > 0.0 ? within.x + 1.0 : 0.0;   // whose first sample lies inside
    Crossed mu = march_through(mipmap_mu, q, d, start, ratio, sum), rho = march_through(mipmap_rho, q, d, start, ratio, sum);
    float blocked = blocked_fraction(rho.coverage) - blocked_fraction(mu.coverage);
    return rho.c - mu.c - blocked * environment(d, atan(0.5 * ratio));
}
