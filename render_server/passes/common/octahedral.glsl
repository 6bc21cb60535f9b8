// Octahedral map of the whole sphere: direction <-> uv in [0,1]^2, +z in the centre.
vec2 octahedral_uv(vec3 d) {
    d /= abs(d.x) + abs(d.y) + abs(d.z);
    vec2 folded = (1.0 - abs(d.yx)) * vec2(d.x >= 0.0 ? 1.0 : -1.0, d.y >= 0.0 ? 1.0 : -1.0);
    return 0.5 + 0.5 * (d.z >= 0.0 ? d.xy : folded);
}

vec3 octahedral_direction(vec2 uv) {
    vec2 f = uv * 2.0 - 1.0;
    vec3 d = vec3(f, 1.0 - abs(f.x) - abs(f.y));
    float t = max(-d.z, 0.0);
    d.xy += vec2(d.x >= 0.0 ? -t : t, d.y >= 0.0 ? -t : t);
    return normalize(d);
}
