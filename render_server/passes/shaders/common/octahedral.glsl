// Octahedral map of the whole sphere: direction -> uv in [0,1]^2, +z in the centre.
vec2 octahedral_uv(vec3 d) {
    d /= abs(d.x) + abs(d.y) + abs(d.z);
    vec2 folded = (1.0 - abs(d.yx)) * vec2(d.x >= 0.0 ? 1.0 : -1.0, d.y >= 0.0 ? 1.0 : -1.0);
    return 0.5 + 0.5 * (d.z >= 0.0 ? d.xy : folded);
}

vec3 octahedral_direction(vec2 uv) {
    vec2 d = 2.0 * uv - 1.0;
    float z = 1.0 - abs(d.x) - abs(d.y);
    vec2 unfolded = (1.0 - abs(d.yx)) * vec2(d.x >= 0.0 ? 1.0 : -1.0, d.y >= 0.0 ? 1.0 : -1.0);
    return normalize(vec3(z >= 0.0 ? d : unfolded, z));
}
