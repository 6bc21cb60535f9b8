// Filtered importance sampling of a GGX lobe (Colbert & Krivanek 2007, [D] 4.2.1.3): each of a few samples stands for a
// solid angle, over which the map of light was averaged beforehand. Needs brdf.glsl and environment.glsl.

const float GRAZING = 1e-2;   // least cosine to the viewer: interpolated normals turn away from it at outlines

// Half-vector about z whose density is D(h) (n.h) ([D] eq. 4.21).
vec3 lobe_normal(vec2 u, float alpha) {
    float z2 = (1.0 - u.y) / ((alpha * alpha - 1.0) * u.y + 1.0);
    float level = sqrt(max(1.0 - z2, 0.0)), phi = 2.0 * PI * u.x;
    return vec3(level * cos(phi), level * sin(phi), sqrt(z2));
}

// Density of the direction that such a half-vector reflects v to, 1/sr; [D] eq. 4.22 lacks the 4 of the reflection.
float reflected_density(float n_dot_h, float v_dot_h, float alpha) {
    return ggx_distribution(n_dot_h, alpha) * n_dot_h / (4.0 * v_dot_h);
}

#ifdef MEASURED
// Half-vector about z of a Gaussian lobe.
vec3 gaussian_normal(vec2 u, float variance) {
    float z = 1.0 + variance * log(1.0 - u.y * (1.0 - exp(-1.0 / variance)));
    float level = sqrt(max(1.0 - z * z, 0.0)), phi = 2.0 * PI * u.x;
    return vec3(level * cos(phi), level * sin(phi), z);
}

// The same for the lobes of a measured material, which share the samples.
vec3 measured_radiance(vec3 n, vec3 v, int row, float footprint, int count) {
    n = normalize(n + max(GRAZING - dot(n, v), 0.0) * v);
    mat3 basis = basis_around(n);
    vec3 local = v * basis, sum = vec3(0.0), total = vec3(0.0);
    int lobes = int(measured_base(row).a), each = max(count / max(lobes, 1), 1);
    for (int j = 0; j < lobes * each; ++j) {
        int k = j / each;
        float variance = lobe_widths(row, k).x * lobe_widths(row, k).x;
        vec3 h = gaussian_normal(vec2(fract(float(j) * 0.6180339887), (float(j % each) + 0.5) / float(each)), variance);
        vec3 l = reflect(-local, h);
        float v_dot_h = dot(local, h);
        if (l.z <= 0.0 || v_dot_h <= 0.0) continue;
        float density = half_vector_density(1.0 - h.z, variance) / (4.0 * v_dot_h);
        vec3 weight = lobe_weight(row, k, v_dot_h) * (l.z / max(l.z, local.z));
        sum += weight * environment(basis * l, sqrt(1.0 / (PI * float(each) * density) + footprint * footprint));
        total += weight;
    }
    return sum / max(total, vec3(1e-6));
}
#endif

// Mean radiance over the lobe about n (unit) of what `count` samples see in the map, weighted as the lobe reflects it: of a map
// that is the same everywhere just that, however few the samples are. `footprint`: half-angle (rad) over which the pixel itself
// averages.
vec3 lobe_radiance(vec3 n, vec3 v, vec3 f0, float roughness, float footprint, int count) {
    float alpha = max(roughness * roughness, 2e-3);   // as specular_times_cosine
    n = normalize(n + max(GRAZING - dot(n, v), 0.0) * v);
    mat3 basis = basis_around(n);
    vec3 local = v * basis, sum = vec3(0.0), total = vec3(0.0);
    for (int j = 0; j < count; ++j) {
        vec3 h = lobe_normal(vec2(fract(float(j) * 0.6180339887), (float(j) + 0.5) / float(count)), alpha);
        vec3 l = reflect(-local, h);
        float v_dot_h = dot(local, h);
        if (l.z <= 0.0 || v_dot_h <= 0.0) continue;
        float density = reflected_density(h.z, v_dot_h, alpha);
        vec3 weight = fresnel_schlick(f0, v_dot_h)
            * (ggx_distribution(h.z, alpha) * smith_visibility(l.z, local.z, alpha) * l.z / density);
        sum += weight * environment(basis * l, sqrt(1.0 / (PI * float(count) * density) + footprint * footprint));
        total += weight;
    }
    if (total == vec3(0.0)) return environment(reflect(-v, n), specular_half_angle(roughness));   // none is above the surface
    return sum / max(total, vec3(1e-6));
}
