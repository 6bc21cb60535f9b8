// Irradiance of the light volumes at 1/scale of the picture (METHOD 5): E(n) = 2/3 <SH, lobe(-n)> (light is kept per cell
// edge squared), trilinear about the point half a cell above the surface, on top of the surroundings R.
// REAL: E_mu and E_rho of real surfaces; CHANGE: E_rho = E_mu + the one volume of the change. VIRTUAL otherwise: the light
// on the objects, and what a mirror on them would see.
#include "passes/common/environment.glsl"
#include "passes/common/brdf.glsl"
#include "passes/common/volume.glsl"
#include "passes/common/light_cells.glsl"
#include "passes/common/sampling_grid.glsl"

layout(local_size_x = 8, local_size_y = 8) in;
#ifdef REAL
layout(binding = 0, rgba16f) writeonly uniform image2D irradiance_mu;    // rgb E_mu, a: 1 where known
layout(binding = 1, rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: volume fade
layout(binding = 2, rgba16f) writeonly uniform image2D specular_mu;
#else
layout(binding = 0, rgba16f) writeonly uniform image2D irradiance_rho;   // rgb E_rho, a: 1 where known
#endif
layout(binding = 3, rgba16f) writeonly uniform image2D specular_rho;
layout(std430, binding = 8) readonly buffer WithoutObjects { vec4 light_mu[]; };   // channel by channel
layout(std430, binding = 9) readonly buffer WithObjects { vec4 light_rho[]; };     // CHANGE: the change itself
uniform vec3 camera_position;
uniform bool has_geometry;   // cells behind the surface are dark and must not be read
uniform float damping;

const float PER_FACE = 2.0 / 3.0;   // of 1 / edge^2: a uniform field's intensity in radiance
const float RIM = 2.0;               // cells over which the change fades at the border

struct Light12 { vec4 r; vec4 g; vec4 b; };

uint cell_count() { return uint(volume_size * volume_size * volume_size); }

// Intensity at q, from the cells whose centres lie before the plane (p, n) if `front_only`.
Light12 intensity(bool with_objects, vec3 q, vec3 p, vec3 n, bool front_only) {
    ivec3 base = ivec3(floor(q - 0.5));
    vec3 f = q - 0.5 - vec3(base);
    Light12 sum = Light12(vec4(0.0), vec4(0.0), vec4(0.0));
    float total = 0.0;
    for (int i = 0; i < 8; ++i) {
        ivec3 o = ivec3(i & 1, (i >> 1) & 1, i >> 2), cell = base + o;
        vec3 share = mix(1.0 - f, f, vec3(o));
        float w = share.x * share.y * share.z * (front_only ? max(dot(vec3(cell) + 0.5 - p, n), 0.0) : 1.0);
        if (w <= 0.0 || !in_grid(cell, volume_size)) continue;
        uint at = cell_index(cell, volume_size), channel = cell_count();
        if (with_objects) {
            sum.r += w * light_rho[at]; sum.g += w * light_rho[at + channel]; sum.b += w * light_rho[at + 2u * channel];
        } else {
            sum.r += w * light_mu[at]; sum.g += w * light_mu[at + channel]; sum.b += w * light_mu[at + 2u * channel];
        }
        total += w;
    }
    float scale = total > 0.0 ? 1.0 / total : 0.0;
    return Light12(scale * sum.r, scale * sum.g, scale * sum.b);
}

vec3 against(Light12 light, vec4 shape) { return vec3(dot(light.r, shape), dot(light.g, shape), dot(light.b, shape)); }

// Where the light grows towards the back of the surface it leaked through it ([P2] 4.4): it is scaled down by how fast
// it does so along the normal, relative to itself.
vec3 damped(bool with_objects, vec3 q, vec3 n, vec3 e) {
    vec3 behind = vec3(0.0), before = vec3(0.0);
    for (int i = 0; i < (damping > 0.0 ? 1 : 0); ++i) {
        behind = PER_FACE * against(intensity(with_objects, q, q, n, false), lobe(-n));
        before = PER_FACE * against(intensity(with_objects, q + n, q, n, false), lobe(-n));
    }
    vec3 opposing = max((behind - before) * sign(e), vec3(0.0));
    return e / (1.0 + damping * opposing / max(abs(e), vec3(1e-6)));
}

// Irradiance from the volume at a surface point q (cells) with normal n.
vec3 from_volume(bool with_objects, vec3 q, vec3 n) {
    vec3 e = PER_FACE * against(intensity(with_objects, q + 0.5 * n, q, n, has_geometry), lobe(-n));
    return damped(with_objects, q, n, e);
}

float border_fade(vec3 q) {
    vec3 rim = min(q, float(volume_size) - q);
    return smoothstep(0.0, RIM, min(rim.x, min(rim.y, rim.z)));
}

// What a mirror at the point would show of the surroundings, were nothing in the volume.
vec3 mirrored(SurfacePoint s) {
    if (s.roughness < 0.0) return vec3(0.0);
    return environment(reflect(normalize(s.position - camera_position), s.normal), specular_half_angle(s.roughness));
}

#ifdef REAL
void shade(ivec2 texel, SurfacePoint s) {
    vec3 q = volume_coordinate(s.position);
    vec3 e_mu = vec3(0.0), e_rho = vec3(0.0), c = vec3(0.0);
    float fade = s.present ? border_fade(q) : 0.0;
    if (s.present) {
        c = mirrored(s);
        e_mu = environment_irradiance(s.normal);
        e_rho = e_mu;
    }
    if (fade > 0.0) {
#ifdef CHANGE
        e_rho += from_volume(true, q, s.normal);
#else
        vec3 mu = from_volume(false, q, s.normal), rho = from_volume(true, q, s.normal);
        e_rho = max(e_mu + fade * mu + (rho - mu), vec3(0.0));   // composition lets the change fade
        e_mu = max(e_mu + fade * mu, vec3(0.0));
#endif
    }
    imageStore(irradiance_mu, texel, vec4(e_mu, s.present ? 1.0 : 0.0));
    imageStore(irradiance_rho, texel, vec4(e_rho, fade));
    imageStore(specular_mu, texel, vec4(c, 1.0));
    imageStore(specular_rho, texel, vec4(c, 1.0));
}
#else
void shade(ivec2 texel, SurfacePoint s) {
    vec3 e = vec3(0.0), c = vec3(0.0);
    if (s.present) {
        vec3 q = volume_coordinate(s.position);
        e = max(environment_irradiance(s.normal) + from_volume(true, q, s.normal), vec3(0.0));
        c = mirrored(s);
    }
    imageStore(irradiance_rho, texel, vec4(e, s.present ? 1.0 : 0.0));
    imageStore(specular_rho, texel, vec4(c, 1.0));
}
#endif

void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(texel, low_resolution_size))) return;
    shade(texel, surface_point(texel));
}
