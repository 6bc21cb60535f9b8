// Products of light, transfer and harmonics ([D] 5.2.2): P_k(n) = integral of L(w) T(n, w) Y_k(w), T a clamped cosine
// in five bands, L not band-limited. An object with coefficients O_k then occludes sum P_k O_k of E(n). PAIRS: A_j
// integral of L Y_j Y_k for all j, k (tripling coefficients summed over the light). Otherwise: the table of normals,
// octahedral, a layer per coefficient, E(n) in the last.
#include "common/light_probe.glsl"

#ifdef PAIRS
layout(local_size_x = 64) in;
uniform sampler2D probe;
layout(std430) writeonly buffer Pairs { vec4 pairs[]; };   // j * SH_LENGTH + k
const float BANDS[5] = float[](3.14159265, 2.09439510, 0.78539816, 0.0, -0.13089969);

void main() {
    int pair = int(gl_GlobalInvocationID.x), j = pair / SH_LENGTH, k = pair % SH_LENGTH;
    if (j >= 25) return;
    vec3 sum = vec3(0.0);
    for (int t = 0; t < PROBE_TEXELS; ++t) {
        float weight = texel_solid_angle(t) * texel_harmonic(t, j) * texel_harmonic(t, k);
        sum += weight * texelFetch(probe, ivec2(t % PROBE_SIZE, t / PROBE_SIZE), 0).rgb;
    }
    pairs[pair] = vec4(BANDS[int(sqrt(float(j) + 0.5))] * sum, 0.0);
}
#else
layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image3D products;
layout(std430) readonly buffer Pairs { vec4 pairs[]; };
const float WHOLE = 3.54490770;   // 1 / Y_0

void main() {
    int texel = int(gl_GlobalInvocationID.x), k = int(gl_GlobalInvocationID.y);
    if (texel >= PROBE_TEXELS) return;
    vec3 sum = vec3(0.0);
    int column = k == SH_LENGTH ? 0 : k;
    for (int j = 0; j < 25; ++j) sum += texel_harmonic(texel, j) * pairs[j * SH_LENGTH + column].rgb;
    ivec3 at = ivec3(texel % PROBE_SIZE, texel / PROBE_SIZE, k);
    imageStore(products, at, vec4(k == SH_LENGTH ? WHOLE * sum : sum, 1.0));
}
#endif
