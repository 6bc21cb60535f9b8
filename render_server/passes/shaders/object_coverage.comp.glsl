// Fraction of each pixel that the virtual objects cover: real surfaces occlude them by depth, with an edge softened
// along the picture's own edges. Unknown depth never occludes; depth masks the object only, never its delta
// (docs/method.md 3). UNMIXES: pixels at such an edge are unmixed; otherwise listed for edge_unmixing.comp.glsl. And where samples of a
// pixel show another surface of the objects than the shaded one, finds the neighbour that shows that surface.
#include "common/shown_object.glsl"
#ifdef UNMIXES
#include "common/unmixing.glsl"
#else
#define APPENDS_TEXELS
#include "common/work_list.glsl"
layout(r16f) writeonly uniform image2D object_coverage;
uniform sampler2D linear_picture;
#pragma texels rgba16f linear_picture
#endif

#include "common/pixel_group.glsl"
layout(rg16f) writeonly uniform image2D interior_edges;   // as common/interior_edges.glsl reads them
uniform sampler2D second_surface;                         // as in edge_samples.comp.glsl
#pragma texels rgba32f second_surface
uniform ivec2 first_pixel;     // of the rectangle that may show an object; the rest was cleared

const int WINDOW = 5;   // pixels

ivec2 neighbour(ivec2 pixel, int i, ivec2 size) {
    return clamp(pixel + ivec2(i % WINDOW, i / WINDOW) - WINDOW / 2, ivec2(0), size - 1);
}

// Fraction of the window in front, over the pixels that are near and of similar colour; if not wanted, any. (llvmpipe executes both
// sides of a branch, but no turn of a loop too many.)
float softened(ivec2 pixel, float z, ivec2 size, bool wanted) {
    vec3 colour = texelFetch(linear_picture, pixel, 0).rgb;
    float sum = 0.0, weight = 0.0;
    int count = wanted ? WINDOW * WINDOW : 0;
    for (int i = 0; i < count; ++i) {
        ivec2 at = neighbour(pixel, i, size);
        vec3 d = (texelFetch(linear_picture, at, 0).rgb - colour) / (0.05 + colour);
        vec2 away = vec2(at - pixel);
        float w = exp(-0.25 * dot(away, away) - 4.0 * dot(d, d));
        sum += w * in_front(at, z);
        weight += w;
    }
    return sum / weight;
}

const float NEARNESS = 0.1;    // weight of the distance beside the distance from a neighbour's plane: it breaks ties

// Distance of a position from the surface of a pixel, m; large where that shows no object.
float away(ivec2 at, vec3 place) {
    if (texelFetch(sample_coverage, at, 0).r == 0.0) return 1e9;
    vec3 offset = place - texelFetch(virtual_raster_position, at, 0).xyz;
    return abs(dot(offset, texelFetch(virtual_raster_normal, at, 0).xyz)) + NEARNESS * length(offset);
}

// The share of samples that show another surface of the objects, and the neighbour that shows it; 0 if none does, or if there are no
// samples. (llvmpipe executes both sides of a branch, but no turn of a loop too many.)
vec2 interior_edge(ivec2 pixel) {
    vec4 second = antialiased ? texelFetch(second_surface, pixel, 0) : vec4(0.0);
    ivec2 last = textureSize(second_surface, 0) - 1, best = ivec2(1);
    float least = away(pixel, second.xyz);
    int count = second.w > 0.0 ? 9 : 0;
    for (int i = 0; i < count; ++i) {
        ivec2 beside = ivec2(i % 3, i / 3);
        float d = away(clamp(pixel + beside - 1, ivec2(0), last), second.xyz);
        if (d < least) { least = d; best = beside; }
    }
    bool found = count > 0 && best != ivec2(1);
    return found ? vec2(second.w / texelFetch(sample_coverage, pixel, 0).r, best.y << 2 | best.x) : vec2(0.0);
}

void main() {
    ivec2 pixel = first_pixel + ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = textureSize(real_surface_position, 0);
    if (any(greaterThanEqual(pixel, size))) return;
    float z = depth_shown(pixel);
    if (z <= 0.0) { imageStore(object_coverage, pixel, vec4(0.0)); return; }
    imageStore(interior_edges, pixel, vec4(interior_edge(pixel), 0.0, 0.0));
    float fraction = 0.0;
    for (int i = 0; i < WINDOW * WINDOW; ++i) fraction += in_front(neighbour(pixel, i, size), z);
    fraction /= float(WINDOW * WINDOW);
    bool at_edge = fraction > 0.0 && fraction < 1.0;
    float smooth_fraction = softened(pixel, z, size, at_edge);
    if (at_edge) fraction = smooth_fraction;
    if (antialiased) fraction *= covered_fraction(pixel, z);
    imageStore(object_coverage, pixel, vec4(fraction));
#ifdef UNMIXES
    if (at_edge) unmix(pixel);
#else
    if (at_edge) append_texel(pixel, size.x);
#endif
}
