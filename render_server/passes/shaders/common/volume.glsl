// Voxel volume in world axes; its mipmap is one 3-D texture of n x n x (DIRECTIONS + ceil(DIRECTIONS / 2) / 2) n:
// level 0 of direction k at z = k n; levels l >= 1 behind all of them, two directions side by side in x, at y = n (1
// - 2^(1-l)). Directions: 0:+x 1:-x 2:+y 3:-y 4:+z 5:-z, in which a cone travels; isotropic sets have one.
//
// Objects far apart have volumes of their own, n voxels an edge too: their mipmaps lie side by side in x. A thread works in
// one volume at a time, `volume`; coordinates in voxels are of that one.
#ifndef DIRECTIONS
#define DIRECTIONS 6
#endif
#pragma switch SEVERAL_VOLUMES
#ifdef SEVERAL_VOLUMES
layout(std140) uniform Volumes {
    mat4 volume_places;   // a column for each: world position of the low corner, m; h, m
    int volume_size;      // n, voxels per edge
    int volume_levels;
    int volume_count;     // 4 at most
};
int volume = 0;
#define volume_origin volume_places[volume].xyz
#define voxel_edge volume_places[volume].w
#else
layout(std140) uniform Volume {
    vec3 volume_origin;   // world position of the low corner, m
    float voxel_edge;     // h, m
    int volume_size;      // n, voxels per edge
    int volume_levels;
};
const int volume = 0, volume_count = 1;
#endif

ivec3 level_base_of(int n, int level, int k) {
    if (level == 0) return ivec3(0, 0, k * n);
    return ivec3((k & 1) * n / 2, n - (n >> (level - 1)), DIRECTIONS * n + (k >> 1) * n / 2);
}

ivec3 level_base(int level, int k) {
    return level_base_of(volume_size, level, k) + ivec3(volume * volume_size, 0, 0);
}

// Premultiplied (c, a) at q (voxels of level 0 from the low corner), trilinear within one level and direction, of the mipmap
// that begins at x = `first`.
vec4 volume_sample(sampler3D mipmap, int first, int n, vec3 q, int level, int k) {
    float cells = float(n >> level);
    ivec3 base = level_base_of(n, level, k) + ivec3(first, 0, 0);
    vec3 c = clamp(q * exp2(-float(level)), vec3(0.5), vec3(cells - 0.5)) + vec3(base);
    return textureLod(mipmap, c / vec3(textureSize(mipmap, 0)), 0.0);
}

vec3 volume_coordinate(vec3 p) { return (p - volume_origin) / voxel_edge; }

bool inside_cube(vec3 q, float edge) { return all(greaterThan(q, vec3(0.0))) && all(lessThan(q, vec3(edge))); }

bool inside_volume(vec3 q) { return inside_cube(q, float(volume_size)); }

// Where the ray q + t d, t >= 0, is inside a box: (first t, last t); none where first >= last.
vec2 box_interval(vec3 q, vec3 d, vec3 low, vec3 high) {
    vec3 inverse = 1.0 / (d + vec3(equal(d, vec3(0.0))) * 1e-9);
    vec3 t0 = (low - q) * inverse, t1 = (high - q) * inverse;
    vec3 near = min(t0, t1), far = max(t0, t1);
    return vec2(max(max(near.x, near.y), max(near.z, 0.0)), min(far.x, min(far.y, far.z)));
}

const float ENDLESS = 1e30;   // of a ray that meets nothing

// The delta fades over the last voxels, so that nothing is cut off at the border.
const float FADE_VOXELS = 4.0;

float volume_fade(vec3 q) {
    vec3 rim = min(q, float(volume_size) - q);
    return smoothstep(0.0, FADE_VOXELS, min(rim.x, min(rim.y, rim.z)));
}

#ifdef SEVERAL_VOLUMES
void work_in_volume(int chosen) { volume = chosen; }

// Goes to the volume in which a point (world, m) lies deepest.
void enter_volume(vec3 p) {
    float nearest = 1e30;
    int found = 0;
    for (volume = 0; volume < volume_count; ++volume) {
        vec3 away = abs(volume_coordinate(p) / float(volume_size) - 0.5);
        float most = max(away.x, max(away.y, away.z));
        if (most < nearest) { nearest = most; found = volume; }
    }
    volume = found;
}

// Whether a point (world, m) is in any volume, or at most `margin` (m) from it.
bool near_volume(vec3 p, float margin) {
    int before = volume;
    bool near = false;
    for (volume = 0; volume < volume_count; ++volume)
        near = near || inside_cube(p - volume_origin + margin, float(volume_size) * voxel_edge + 2.0 * margin);
    volume = before;
    return near;
}

// Of the volumes that a ray (world, m) has not `crossed`, goes to the one that it meets first after a distance t; returns where,
// or ENDLESS.
float enter_next(vec3 from, vec3 d, float t, uint crossed) {
    float nearest = ENDLESS;
    int found = 0;
    for (volume = 0; volume < volume_count; ++volume) {
        if ((crossed >> volume & 1u) != 0u) continue;
        vec2 within = box_interval(from - volume_origin, d, vec3(0.0), vec3(float(volume_size) * voxel_edge));
        float at = max(within.x, t);
        if (at < within.y && at < nearest) { nearest = at; found = volume; }
    }
    volume = found;
    return nearest;
}

// The coordinate of what is at q in the volume `home`.
vec3 coordinate_from(vec3 q, int home) {
    return volume_coordinate(volume_places[home].xyz + q * volume_places[home].w);
}
#else
void work_in_volume(int chosen) {}

void enter_volume(vec3 p) {}

vec3 coordinate_from(vec3 q, int home) { return q; }

bool near_volume(vec3 p, float margin) {
    return inside_cube(p - volume_origin + margin, float(volume_size) * voxel_edge + 2.0 * margin);
}
#endif
