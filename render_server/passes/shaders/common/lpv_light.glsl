// Irradiance of a surface from the light volumes (docs/method.md 5): E(n) = 2/3 <SH, lobe(-n)> (light is stored per
// cell edge squared), trilinear about the point half a cell above the surface. Volumes lie side by side in x; the one of
// volume.glsl, which must come first, is read.
#include "common/light_cells.glsl"

uniform sampler3D light_mu;    // or the direct change
uniform sampler3D light_rho;   // or the change itself, indirect
#pragma texels rgba32f light_mu light_rho
uniform bool has_geometry;   // cells behind the surface are dark and must not be read
uniform float damping;
#pragma switch bool is_damped   // by more than nothing

const float PER_FACE = 2.0 / 3.0;   // of 1 / edge^2: a uniform field's intensity in radiance

// Irradiance from the light without and with objects: of the two, shaders compute what they use.
struct Brought { vec3 mu; vec3 rho; };

// Against a shape, at a texel of the red channel, in volumes of `size` cells an edge.
vec3 mu_at(ivec3 texel, int size, vec4 shape) {
    return vec3(dot(texelFetch(light_mu, texel, 0), shape), dot(texelFetch(light_mu, in_channel(texel, 1, size), 0), shape),
                dot(texelFetch(light_mu, in_channel(texel, 2, size), 0), shape));
}

vec3 rho_at(ivec3 texel, int size, vec4 shape) {
    return vec3(dot(texelFetch(light_rho, texel, 0), shape), dot(texelFetch(light_rho, in_channel(texel, 1, size), 0), shape),
                dot(texelFetch(light_rho, in_channel(texel, 2, size), 0), shape));
}

// On a surface that faces n, of the light at q of a volume of `size` cells an edge; with `front_only` from the cells whose centres are
// in front of the plane (p, n).
Brought brought_at(int size, vec3 q, vec3 p, vec3 n, bool front_only) {
    ivec3 base = ivec3(floor(q - 0.5)), first = ivec3(volume * size, 0, 0);
    vec3 f = q - 0.5 - vec3(base);
    vec4 shape = lobe(-n);
    Brought sum = Brought(vec3(0.0), vec3(0.0));
    float total = 0.0;
    for (int i = 0; i < 8; ++i) {
        ivec3 o = ivec3(i & 1, (i >> 1) & 1, i >> 2), cell = base + o;
        vec3 fraction = mix(1.0 - f, f, vec3(o));
        float w = fraction.x * fraction.y * fraction.z * (front_only ? max(dot(vec3(cell) + 0.5 - p, n), 0.0) : 1.0);
        if (w <= 0.0 || !in_grid(cell, size)) continue;
        sum.mu += w * mu_at(first + cell, size, shape);
        sum.rho += w * rho_at(first + cell, size, shape);
        total += w;
    }
    float scale = total > 0.0 ? PER_FACE / total : 0.0;
    return Brought(scale * sum.mu, scale * sum.rho);
}

// Light that increases towards the back of the surface has leaked through it ([P2] 4.4): it is scaled down by its
// relative increase along the normal.
vec3 damped(vec3 e, vec3 behind, vec3 before) {
    vec3 opposing = max((behind - before) * sign(e), vec3(0.0));
    return e / (1.0 + damping * opposing / max(abs(e), vec3(1e-6)));
}

// At a surface point q (cells) with normal n, from a volume of `size` cells an edge.
Brought brought_in(int size, vec3 q, vec3 n) { return brought_at(size, q + 0.5 * n, q, n, has_geometry); }

// The same of the volume that the block describes, damped.
Brought brought(vec3 q, vec3 n) {
    Brought e = brought_in(volume_size, q, n);
    if (!is_damped) return e;
    Brought behind = brought_at(volume_size, q, q, n, false), before = brought_at(volume_size, q + n, q, n, false);
    return Brought(damped(e.mu, behind.mu, before.mu), damped(e.rho, behind.rho, before.rho));
}
