// What each tile of 8 x 8 texels of the reduced grid shows, so that beams pass over tiles that do not need their light.
layout(local_size_x = 64) in;
layout(r8ui) writeonly uniform uimage2D tiles_out;   // sum of REAL_TILE and OBJECT_TILE
uniform isampler2D sample_pixels;
#ifdef REUSES
uniform usampler2D stale_texels;   // 0: light there is the last frame's
#endif
#include "common/caustic_tiles.glsl"

shared uint found;

void main() {
    if (gl_LocalInvocationIndex == 0u) found = 0u;
    memoryBarrierShared();
    barrier();
    ivec2 tile = ivec2(gl_WorkGroupID.xy), texel = place_in_tile(tile);
    if (all(lessThan(texel, textureSize(sample_pixels, 0)))) {
        ivec4 pixels = texelFetch(sample_pixels, texel, 0);
        bool real = pixels.x >= 0, object = pixels.z >= 0;
#ifdef REUSES
        uint stale = texelFetch(stale_texels, texel, 0).r;
        real = real && (stale & 3u) != 0u;
        object = object && (stale & 4u) != 0u;
#endif
        uint shown = (real ? REAL_TILE : 0u) + (object ? OBJECT_TILE : 0u);
        if (shown != 0u) atomicOr(found, shown);
    }
    memoryBarrierShared();
    barrier();
    if (gl_LocalInvocationIndex == 0u) imageStore(tiles_out, tile, uvec4(found));
}
