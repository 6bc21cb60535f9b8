// A march that begins beyond the objects' volume: through the coarse scene into it, and out again. Where mu and rho
// differ lies inside, so that both share the way to it. Needs march.glsl with ENDS_AHEAD, environment.glsl.

// Through this volume from `start` (voxels) on the ray q + t d; returns the distance where it ends.
float march_inside(sampler3D mipmap, vec3 q, vec3 d, float start, float ratio, inout Crossed sum) {
    bool differs = false;
    return start + march_near(mipmap, q + start * d, d, start, ratio, sum, differs);
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
    Crossed mu = sum, rho = sum;
    float t_mu = march_inside(mipmap_mu, q, d, start, ratio, mu), t_rho = march_inside(mipmap_rho, q, d, start, ratio, rho);
    int k = 0;
    do {   // behind it by the same code: march.glsl
        Crossed behind = k == 0 ? mu : rho;
        march_beyond(q, d, k == 0 ? t_mu : t_rho, 0.0, ratio, behind);
        if (k == 0) mu = behind;
        else rho = behind;
    } while (++k < 2);
    float blocked = blocked_fraction(rho.coverage) - blocked_fraction(mu.coverage);
    return rho.c - mu.c - blocked * environment(d, atan(0.5 * ratio));
}
