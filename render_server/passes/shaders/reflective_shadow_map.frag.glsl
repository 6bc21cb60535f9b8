// Normal (+ material index), texture coordinate and vertex colour of the first surface; depth goes to the depth buffer.
#include "common/packing.glsl"
#ifndef CUTOUTS
#pragma switch CUTOUTS
#else
#define MATERIAL_MAPS
#include "common/materials.glsl"
#endif

in vec3 normal;
in vec2 uv;
in vec3 tint;
flat in float material;
layout(location = 0) out vec4 out_normal;
layout(location = 1) out vec4 out_uv;

#ifdef CUTOUTS
in float clear;

bool is_left_out() {
    MaterialEntry e = materials[int(material)];
    vec2 place = place_on(e.maps[BASE_COLOR], uv) * float(textureSize(color_maps, 0).x);
    float level = log2(max(max(length(dFdx(place)), length(dFdy(place))), 1.0));
    float opacity = opacity_of_vertices(clear) * e.alpha.y * map_level(color_maps, e.maps[BASE_COLOR], uv, level).a;
    return is_cut_out(int(material), fraction_there(e, opacity), interleaved_gradient_noise(gl_FragCoord.xy + APART * material));
}
#endif

void main() {
#ifdef CUTOUTS
    if (is_left_out()) discard;
#endif
    // Vertices' normals may cancel out in a fold: any direction is as good there, NaN is not.
    out_normal = vec4(normal == vec3(0.0) ? vec3(0.0, 0.0, 1.0) : normalize(normal), material);
    out_uv = vec4(uv, pack_color(tint), 1.0);
}
