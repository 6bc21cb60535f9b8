// Smooth surfaces that reflect virtual objects by rays: real ones, or (OF_OBJECTS) those of the objects themselves. What needs
// materials.glsl besides includes it before: what is included within a condition is not again.
#include "common/geometry.glsl"
#include "common/lobe.glsl"
#ifdef OF_OBJECTS
#include "common/shown_maps.glsl"
#include "common/shown_normal.glsl"
#else
#include "common/surfaces.glsl"
#endif

struct Mirror { bool present; vec3 point; vec3 normal; float depth; float alpha; bool of_coat; };

#ifdef OF_OBJECTS
bool shines(MaterialEntry m) { return m.dielectric.rgb != vec3(0.0) || m.base_color.a > 0.0; }

// The smooth surface of the object that a pixel shows.
Mirror mirror_at(ivec2 pixel) {
    ivec2 raster = raster_texel(pixel);
    vec4 position = texelFetch(virtual_raster_position, raster, 0);
    vec4 normal = texelFetch(virtual_raster_normal, raster, 0);
    Mirror m = Mirror(false, position.xyz, normal.xyz, position.w, LEAST_ALPHA, false);
    if (position.w <= 0.0) return m;
    float roughness = shines(materials[int(normal.w)]) ? roughness_at(raster, int(normal.w)) : 1.0;
#ifdef EXTENDED
    Coating over = coating_at(raster, int(normal.w));
    m.of_coat = over.coat > 0.0 && over.roughness < roughness;
    if (m.of_coat) {   // the smoother of both speaks for both
        roughness = over.roughness;
        m.normal = shown_normal(raster, true).xyz;
    }
#endif
    m.alpha = max(roughness * roughness, LEAST_ALPHA);
    m.present = roughness < RAY_ROUGHNESS && dot(m.normal, camera_position - m.point) > 0.0;
    return m;
}

// Of the two pixels that represent a texel of the reduced grid, the one that may show a mirror.
ivec2 mirror_pixel(ivec4 represent) { return represent.zw; }

// Whether a pixel of that `coverage` by objects shows mirrors.
bool shows_mirror(float coverage) { return coverage > 0.0; }

// Which smooth surface a pixel shows.
float mirror_entry(ivec2 pixel) { return texelFetch(virtual_raster_normal, raster_texel(pixel), 0).w; }
#else
// The smooth surface that a pixel sees. A declared plane is flatter than its depth image: its own normal applies.
Mirror mirror_at(ivec2 pixel) {
    vec4 position = texelFetch(real_surface_position, pixel, 0);
    vec4 normal = texelFetch(real_surface_normal, pixel, 0);
    Mirror m = Mirror(false, position.xyz, normal.xyz, position.w, LEAST_ALPHA, false);
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

ivec2 mirror_pixel(ivec4 represent) { return represent.xy; }

bool shows_mirror(float coverage) { return coverage < 1.0; }

float mirror_entry(ivec2 pixel) { return texelFetch(real_surface_normal, pixel, 0).w; }
#endif
