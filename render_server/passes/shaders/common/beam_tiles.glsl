// Tiles of TILE x TILE texels of the reduced grid, and a bit for each wide beam that may light a tile. Those of objects follow
// those of real surfaces. Needs geometry.glsl, beam_footprint.glsl.
#include "common/lit_pixels.glsl"

uniform isampler2D sample_pixels;
#pragma texels rgba16i sample_pixels
uniform ivec2 tiles;
uniform int beam_words;   // of a tile
#ifdef REUSES
uniform usampler2D stale_texels;   // REAL_LIGHT and OBJECT_LIGHT where light must be computed
#endif

const int TILE = 8;
const uint REAL_LIGHT = 1u, OBJECT_LIGHT = 2u;

int first_word(ivec2 tile, int layer) {
    int row = tile.y + (layer == REAL_LAYER ? 0 : tiles.y);
    return (row * tiles.x + tile.x) * beam_words;
}

// Surface of a layer that a texel samples, if it needs light.
struct LitTexel { bool needed; vec3 p; vec3 normal; };

LitTexel lit_texel(ivec2 place, int layer) {
    bool inside = all(lessThan(place, textureSize(sample_pixels, 0)));
    ivec4 pixels = inside ? lit_pixels(texelFetch(sample_pixels, place, 0)) : ivec4(-1);
    ivec2 pixel = layer == REAL_LAYER ? pixels.xy : pixels.zw;
    LitTexel t;
    t.needed = pixel.x >= 0;
#ifdef REUSES
    uint light = layer == REAL_LAYER ? REAL_LIGHT : OBJECT_LIGHT;
    t.needed = t.needed && (texelFetch(stale_texels, place, 0).r & light) != 0u;
#endif
    t.p = position_on(layer, max(pixel, ivec2(0)), t.normal);
    return t;
}
