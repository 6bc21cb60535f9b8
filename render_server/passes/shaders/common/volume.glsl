// Voxel volume in world axes; its mipmap is one 3-D texture of n x n x (DIRECTIONS + ceil(DIRECTIONS / 2) / 2) n:
// level 0 of direction k at z = k n; levels l >= 1 behind all of them, two directions side by side in x, at y = n (1
// - 2^(1-l)). Directions: 0:+x 1:-x 2:+y 3:-y 4:+z 5:-z, in which a cone travels; isotropic sets have one.
#ifndef DIRECTIONS
#define DIRECTIONS 6
#endif
layout(std140) uniform Volume {
    vec3 volume_origin;   // world position of the low corner, m
    float voxel_edge;     // h, m
    int volume_size;      // n, voxels per edge
    int volume_levels;
};

ivec3 level_base_of(int n, int level, int k) {
    if (level == 0) return ivec3(0, 0, k * n);
    return ivec3((k & 1) * n / 2, n - (n >> (level - 1)), DIRECTIONS * n + (k >> 1) * n / 2);
}

ivec3 level_base(int level, int k) { return level_base_of(volume_size, level, k); }

// Premultiplied (c, a) at q (voxels of level 0 from the low corner), trilinear within one level and direction.
vec4 volume_sample(sampler3D mipmap, int n, vec3 q, int level, int k) {
    float cells = float(n >> level);
    vec3 c = clamp(q * exp2(-float(level)), vec3(0.5), vec3(cells - 0.5)) + vec3(level_base_of(n, level, k));
    return textureLod(mipmap, c / vec3(textureSize(mipmap, 0)), 0.0);
}

vec3 volume_coordinate(vec3 p) { return (p - volume_origin) / voxel_edge; }

bool inside_cube(vec3 q, float edge) { return all(greaterThan(q, vec3(0.0))) && all(lessThan(q, vec3(edge))); }

bool inside_volume(vec3 q) { return inside_cube(q, float(volume_size)); }

// The delta fades over the last voxels, so that nothing is cut off at the border.
const float FADE_VOXELS = 4.0;

float volume_fade(vec3 q) {
    vec3 rim = min(q, float(volume_size) - q);
    return smoothstep(0.0, FADE_VOXELS, min(rim.x, min(rim.y, rim.z)));
}

vec3 axis_direction(int k) {
    vec3 d = vec3(0.0);
    d[k >> 1] = (k & 1) == 0 ? 1.0 : -1.0;
    return d;
}
