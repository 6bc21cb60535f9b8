// The lit voxels as cubes, traversed cell by cell along each pixel's ray (Amanatides & Woo 1987); beyond the volume
// the picture at a quarter of its brightness.
#include "common/volume.glsl"
#include "common/srgb.glsl"

#include "common/pixel_group.glsl"
layout(rgba8ui) writeonly uniform uimage2D code_out;
uniform usampler2D picture;
uniform sampler2D picture_rays;
uniform sampler3D voxels;
#pragma texels rgba8ui picture
#pragma texels rg32f picture_rays
#include "common/camera.glsl"

const float VISIBLE_COVERAGE = 0.05;

// Premultiplied texel of a voxel as seen along d: the mean of its facing directions.
vec4 facing_texel(ivec3 cell, vec3 d) {
    vec4 sum = vec4(0.0);
    for (int axis = 0; axis < (DIRECTIONS == 1 ? 1 : 3); ++axis) {
        int k = DIRECTIONS == 1 ? 0 : 2 * axis + (d[axis] >= 0.0 ? 0 : 1);
        sum += texelFetch(voxels, level_base(0, k) + cell, 0) * (DIRECTIONS == 1 ? 1.0 : abs(d[axis]));
    }
    return sum;
}

// Shows the first voxel that the ray meets in this volume if it is nearer than `nearest` (m).
void show_volume(ivec2 pixel, vec3 d, inout float nearest) {
    vec3 q = volume_coordinate(camera_position);
    vec2 within = box_interval(q, d, vec3(0.0), vec3(float(volume_size)));
    if (within.x >= within.y || within.x * voxel_edge >= nearest) return;
    vec3 inverse = 1.0 / (d + vec3(equal(d, vec3(0.0))) * 1e-9);
    vec3 at = q + (within.x + 1e-3) * d;
    ivec3 cell = ivec3(floor(at)), stride = ivec3(sign(d));
    vec3 next = (vec3(cell) + max(vec3(stride), 0.0) - q) * inverse;
    int axis = 2;
    float t = within.x;
    for (int i = 0; i < 3 * volume_size; ++i) {
        if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, ivec3(volume_size)))) return;
        vec4 c = facing_texel(cell, d);
        if (c.a > VISIBLE_COVERAGE) {
            if (t * voxel_edge < nearest)
                imageStore(code_out, pixel, srgb(c.rgb / c.a * (1.0 - 0.12 * float(axis))));
            nearest = min(nearest, t * voxel_edge);
            return;
        }
        axis = next.x < next.y ? (next.x < next.z ? 0 : 2) : (next.y < next.z ? 1 : 2);
        t = next[axis];
        cell[axis] += stride[axis];
        next[axis] += abs(inverse[axis]);
    }
}

void main() {
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, textureSize(picture, 0)))) return;
    imageStore(code_out, pixel, uvec4(texelFetch(picture, pixel, 0).rgb / 4u, 255u));
    vec3 d = normalize(mat3(world_from_camera) * vec3(texelFetch(picture_rays, pixel, 0).xy, 1.0));
    float nearest = 1e30;
    for (int shown = 0; shown < volume_count; ++shown) {
        work_in_volume(shown);
        show_volume(pixel, d, nearest);
    }
}
