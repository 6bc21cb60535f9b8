// World position + depth along the optical axis, normal + material, texture coordinate, vertex colour; with MATERIAL_MAPS
// what the maps give in place of the last two. CUTOUTS: some materials have alpha. HIDES_BACKS: some are not seen from behind. MEASURED: some go by the light.
#include "common/fragment.glsl"
#pragma switch HIDES_BACKS
in vec3 world;
in vec3 normal;
in vec2 uv;
in vec3 tint;
in float depth;
flat in float material;
#ifdef CUTOUTS
in float clear;
#endif
#ifdef MATERIAL_MAPS
in vec2 second_uv;
in vec4 tangent;
#endif
layout(location = 0) out vec4 out_position;
layout(location = 1) out vec4 out_normal;
layout(location = 2) out vec2 out_uv;
layout(location = 3) out vec4 out_tint;
#ifdef PACKS_EXTENDED
layout(location = 4) out uvec4 out_extended;
#endif

Fragment interpolated() {
    vec3 right = dFdx(world), down = dFdy(world), across = cross(right, down), view = camera_position - world;
    vec3 face = normalize(across == vec3(0.0) ? view : across);
    Fragment f;
    f.world = world;
    f.depth = depth;
    f.normal = normal;
    f.face = dot(face, view) < 0.0 ? -face : face;
    f.uv = uv;
    f.tint = tint;
    f.material = int(material);
    f.is_back = gl_FrontFacing;   // rows go downwards, which turns the winding
#ifdef CUTOUTS
    f.opacity = opacity_of_vertices(clear);
#endif
#ifdef MATERIAL_MAPS
    f.second_uv = second_uv;
    f.tangent = tangent;
    f.uv_slopes = vec4(dFdx(uv), dFdy(uv));
    f.second_uv_slopes = vec4(dFdx(second_uv), dFdy(second_uv));
    f.right = right;
    f.down = down;
#endif
    return f;
}

void main() {
    Fragment f = interpolated();
    Surface s = surface_at(f, true);
#ifdef HIDES_BACKS
    if (f.is_back && hides_back(f.material)) discard;
#endif
#ifdef CUTOUTS
    if (is_left_out(f, gl_FragCoord.xy, 0.0)) discard;
#endif
    out_position = s.position;
    out_normal = s.normal;
    out_uv = s.uv;
    out_tint = s.tint;
#ifdef PACKS_EXTENDED
    out_extended = s.extended;
#endif
}
