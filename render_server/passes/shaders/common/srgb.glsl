// Linear -> sRGB code (IEC 61966-2-1), for views that no camera made.
uvec4 srgb(vec3 x) {
    x = clamp(x, 0.0, 1.0);
    vec3 y = mix(12.92 * x, 1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, greaterThan(x, vec3(0.0031308)));
    return uvec4(round(y * 255.0), 255u);
}
