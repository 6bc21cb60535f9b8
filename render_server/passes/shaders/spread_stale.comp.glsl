// Marks the neighbours of stale texels (2), whose caustics stale pixels blend in, and keeps the grid for the next frame.
layout(local_size_x = 8, local_size_y = 8) in;
uniform usampler2D stale_texels;
uniform isampler2D sample_pixels;
layout(r8ui) writeonly uniform uimage2D stale_out;
layout(rgba16i) writeonly uniform iimage2D sample_pixels_out;

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), last = textureSize(stale_texels, 0) - 1;
    if (any(greaterThan(texel, last))) return;
    uint found = 0u;
    for (int i = 0; i < 9; ++i)
        found |= 2u * texelFetch(stale_texels, clamp(texel + ivec2(i % 3, i / 3) - 1, ivec2(0), last), 0).r;
    imageStore(stale_out, texel, uvec4(found | texelFetch(stale_texels, texel, 0).r));
    imageStore(sample_pixels_out, texel, texelFetch(sample_pixels, texel, 0));
}
