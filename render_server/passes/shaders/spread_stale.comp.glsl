// The stale texels of the reduced grid: where light at real surfaces must be computed, the neighbours of these, and
// where light at objects must be computed. Keeps what the next frame looks up.
#include "common/geometry.glsl"
#include "common/reprojection.glsl"
#include "common/object_history.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
uniform usampler2D own_stale;   // 1 where light at real surfaces must be computed
uniform isampler2D sample_pixels;
uniform int turn;
layout(r8ui) writeonly uniform uimage2D stale_out;
layout(rgba16i) writeonly uniform iimage2D sample_pixels_out;
layout(rgba32f) writeonly uniform image2D object_position_out;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), last = textureSize(own_stale, 0) - 1;
    if (any(greaterThan(texel, last))) return;
    uint found = 0u;
    for (int i = 0; i < 9; ++i)
        found |= texelFetch(own_stale, clamp(texel + ivec2(i % 3, i / 3) - 1, ivec2(0), last), 0).r;
    uint stale = (found != 0u ? STALE_NEAR : 0u) | (texelFetch(own_stale, texel, 0).r != 0u ? STALE_REAL : 0u);
    ivec4 pixels = texelFetch(sample_pixels, texel, 0);
    vec4 position = vec4(0.0);
    if (pixels.z >= 0) {
        ivec2 raster = raster_texel(pixels.zw);
        position = texelFetch(virtual_raster_position, raster, 0);
        vec3 normal = texelFetch(virtual_raster_normal, raster, 0).xyz;
        if (!has_history || is_due(texel, turn) || last_object_texels(position, normal).total < LEAST_WEIGHT)
            stale |= STALE_OBJECT;
    }
    imageStore(stale_out, texel, uvec4(stale));
    imageStore(sample_pixels_out, texel, pixels);
    imageStore(object_position_out, texel, position);
}
