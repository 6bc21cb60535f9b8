// Irradiance of a surface from the light volumes (docs/method.md 5): E(n) = 2/3 <SH, lobe(-n)> (light is stored per
// cell edge squared), trilinear about the point half a cell above the surface. Volumes lie side by side in x; the one of
// volume.glsl, which must come first, is read.
#include "common/light_cells.glsl"

uniform sampler3D light_mu;    // or the direct change
uniform sampler3D light_rho;   // or the change itself, indirect
#pragma texels rgba32f light_mu light_rho
uniform bool has_geometry;   // cells behind the surface are dark and must not be read
uniform float damping;

const float PER_FACE = 2.0 / 3.0;   // of 1 / edge^2: a uniform field's intensity in radiance

vec4 light_of(bool with_objects, ivec3 texel) {
    return with_objects ? texelFetch(light_rho, texel, 0) : texelFetch(light_mu, texel, 0);
}

struct Light12 { vec4 r; vec4 g; vec4 b; };

// Intensity at q of a volume of `size` cells an edge; with `front_only` from the cells whose centres are in front of the plane (p, n).
Light12 intensity(bool with_objects, int size, vec3 q, vec3 p, vec3 n, bool front_only) {
    ivec3 base = ivec3(floor(q - 0.5)), first = ivec3(volume * size, 0, 0);
    vec3 f = q - 0.5 - vec3(base);
    Light12 sum = Light12(vec4(0.0), vec4(0.0), vec4(0.0));
    float total = 0.0;
    for (int i = 0; i < 8; ++i) {
        ivec3 o = ivec3(i & 1, (i >> 1) & 1, i >> 2), cell = base + o;
        vec3 fraction = mix(1.0 - f, f, vec3(o));
        float w = fraction.x * fraction.y * fraction.z * (front_only ? max(dot(vec3(cell) + 0.5 - p, n), 0.0) : 1.0);
        if (w <= 0.0 || !in_grid(cell, size)) continue;
        sum.r += w * light_of(with_objects, in_channel(first + cell, 0, size));
        sum.g += w * light_of(with_objects, in_channel(first + cell, 1, size));
        sum.b += w * light_of(with_objects, in_channel(first + cell, 2, size));
        total += w;
    }
    float scale = total > 0.0 ? 1.0 / total : 0.0;
    return Light12(scale * sum.r, scale * sum.g, scale * sum.b);
}

vec3 against(Light12 light, vec4 shape) { return vec3(dot(light.r, shape), dot(light.g, shape), dot(light.b, shape)); }

// Light that increases towards the back of the surface has leaked through it ([P2] 4.4): it is scaled down by its
// relative increase along the normal.
vec3 damped(bool with_objects, vec3 q, vec3 n, vec3 e) {
    vec3 behind = vec3(0.0), before = vec3(0.0);
    for (int i = 0; i < (damping > 0.0 ? 1 : 0); ++i) {
        behind = PER_FACE * against(intensity(with_objects, volume_size, q, q, n, false), lobe(-n));
        before = PER_FACE * against(intensity(with_objects, volume_size, q + n, q, n, false), lobe(-n));
    }
    vec3 opposing = max((behind - before) * sign(e), vec3(0.0));
    return e / (1.0 + damping * opposing / max(abs(e), vec3(1e-6)));
}

// Irradiance at a surface point q (cells) with normal n, from a volume of `size` cells an edge.
vec3 irradiance_in(bool with_objects, int size, vec3 q, vec3 n) {
    return PER_FACE * against(intensity(with_objects, size, q + 0.5 * n, q, n, has_geometry), lobe(-n));
}

// The same of the volume that the block describes, damped.
vec3 from_volume(bool with_objects, vec3 q, vec3 n) {
    return damped(with_objects, q, n, irradiance_in(with_objects, volume_size, q, n));
}
