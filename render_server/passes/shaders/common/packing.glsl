// A colour of 8 bits per channel as one float that holds it exactly (an integer below 2^24).
float pack_color(vec3 c) {
    vec3 codes = round(clamp(c, 0.0, 1.0) * 255.0);
    return codes.r + 256.0 * codes.g + 65536.0 * codes.b;
}

vec3 unpack_color(float packed_codes) {
    uint codes = uint(packed_codes);
    return vec3(codes & 255u, (codes >> 8) & 255u, codes >> 16) / 255.0;
}
