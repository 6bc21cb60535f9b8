// Smooth real surfaces, which reflect virtual objects by rays.
#include "common/geometry.glsl"
#include "common/surfaces.glsl"
#include "common/lobe.glsl"

struct Mirror { bool present; vec3 point; vec3 normal; float depth; float alpha; };

// The smooth surface that a pixel sees. A declared plane is flatter than its depth image: its own normal applies.
Mirror mirror_at(ivec2 pixel) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    Mirror m = Mirror(false, position.xyz, normal.xyz, position.w, LEAST_ALPHA);
    if (position.w <= 0.0 || normal.w < 0.0) return m;
    SurfaceEntry e = surfaces[int(normal.w)];
    vec3 away = camera_position - position.xyz;
    if (e.region[0].w == PLANE) {
        m.normal = dot(e.region[1].xyz, away) < 0.0 ? -e.region[1].xyz : e.region[1].xyz;
        m.point -= m.normal * dot(m.point - e.region[0].xyz, m.normal);
    }
    m.alpha = max(e.surface.x * e.surface.x, LEAST_ALPHA);
    m.present = e.surface.x < RAY_ROUGHNESS && dot(m.normal, away) > 0.0;
    return m;
}
