// How light changed on the reduced grid. RATIO: E_rho / E_mu at each texel's pixel, and whether anything changed visibly
// in its block of pixels. LISTS: list the texels that are within FILL_RADIUS of a change or show an object; only their pixels are
// composed. Both in one dispatch: a workgroup lists the texels around its own, and `marks` tell what others have listed.
#ifdef LISTS
#define APPENDS_TEXELS
#endif
#include "common/work_list.glsl"

#include "common/pixel_group.glsl"
#include "common/sample_pixels.glsl"
#ifdef RATIO
layout(rgba16f) writeonly uniform image2D change_ratio_out;
uniform sampler2D direct_mu;
uniform sampler2D direct_rho;
uniform sampler2D cone_mu;
uniform sampler2D cone_rho;
uniform sampler2D cone_specular_mu;
uniform sampler2D cone_specular_rho;
uniform sampler2D reflection;   // a: fraction of a smooth surface's lobe that objects fill
#pragma texels rgba16f direct_mu direct_rho cone_mu cone_rho cone_specular_mu cone_specular_rho reflection
#pragma switch bool has_reflection
#include "common/least_change.glsl"
#pragma switch DISTANT_CHANGE
#ifdef DISTANT_CHANGE
#include "common/distant_change.glsl"
layout(rgba16f) writeonly uniform image2D distant_change_out;   // rgb: relative, beyond the objects' volumes
#endif
uniform int scale;

const float LEAST_IRRADIANCE = 1e-4;

bool differs(vec3 mu, vec3 rho, vec3 all_mu) { return any(greaterThan(abs(rho - mu), LEAST_CHANGE * all_mu)); }

// `gathered`: irradiance by cones.
bool block_changed(ivec2 texel, vec3 gathered) {
    bool changed = false;
    ivec2 last = textureSize(direct_mu, 0) - 1;
    for (int i = 0; i < scale * scale; ++i) {
        ivec2 pixel = min(pixel_in_block(texel, i, scale), last);
        vec3 mu = texelFetch(direct_mu, pixel, 0).rgb;
        changed = changed || differs(mu, texelFetch(direct_rho, pixel, 0).rgb, mu + gathered)
            || (has_reflection && texelFetch(reflection, pixel, 0).a > 0.0);
    }
    return changed;
}

// rgb: ratio; a: 0 no real surface, 1 unchanged, 2 changed.
vec4 value(ivec2 texel) {
    ivec2 at = texelFetch(sample_pixels, texel, 0).xy;
    if (at.x < 0) return vec4(1.0, 1.0, 1.0, 0.0);
    vec4 rho = texelFetch(cone_rho, texel, 0), mu = texelFetch(cone_mu, texel, 0);
    vec3 e_mu = texelFetch(direct_mu, at, 0).rgb + mu.rgb;
    vec3 e_rho = texelFetch(direct_rho, at, 0).rgb + mu.rgb + rho.a * (rho.rgb - mu.rgb);
    bool changed = differs(e_mu, e_rho, e_mu) || texelFetch(cone_specular_mu, texel, 0) != texelFetch(cone_specular_rho, texel, 0)
        || block_changed(texel, mu.rgb);
    vec3 ratio = (e_rho + LEAST_IRRADIANCE) / (e_mu + LEAST_IRRADIANCE);
#ifdef DISTANT_CHANGE
    vec3 distant = distant_change(texel);
    imageStore(distant_change_out, texel, vec4(distant, 0.0));
    ratio = max(ratio + distant, vec3(0.0));
    changed = changed || distant != vec3(0.0);
#endif
    return vec4(ratio, changed ? 2.0 : 1.0);
}
#endif

#ifdef LISTS
bool shows_object(ivec2 texel) { return texelFetch(sample_pixels, texel, 0).z >= 0; }

#ifdef RATIO
layout(std430) buffer Marks { uint marks[]; };   // `turn` where a texel is listed
uniform uint turn;       // another for each dispatch, not 0
const int GROUP = 8;     // texels an edge of a workgroup
const int AROUND = GROUP + 2 * FILL_RADIUS;
const uint NEAR = (1u << (2 * FILL_RADIUS + 1)) - 1u;   // as many bits as columns are near a texel
shared uint changed_rows[GROUP];   // bit x + 2 FILL_RADIUS: what changed in column x

void list_once(ivec2 texel, ivec2 size) {
    if (atomicExchange(marks[texel.y * size.x + texel.x], turn) != turn) append_texel(texel, size.x);
}

// `place`: counted from the workgroup's first texel.
bool near_change(ivec2 place) {
    uint rows = 0u;
    for (int y = max(place.y - FILL_RADIUS, 0); y <= min(place.y + FILL_RADIUS, GROUP - 1); ++y) rows |= changed_rows[y];
    return (rows >> (place.x + FILL_RADIUS) & NEAR) != 0u;
}

void list_around(ivec2 texel, ivec2 size, bool changed, bool shows) {
    ivec2 own = ivec2(gl_LocalInvocationID.xy), first = texel - own;
    if (own.x == 0) changed_rows[own.y] = 0u;
    barrier();
    if (changed) atomicOr(changed_rows[own.y], 1u << (own.x + 2 * FILL_RADIUS));
    if (shows) list_once(texel, size);
    barrier();
    for (int i = int(gl_LocalInvocationIndex); i < AROUND * AROUND; i += GROUP * GROUP) {
        ivec2 place = ivec2(i % AROUND, i / AROUND) - FILL_RADIUS, at = first + place;
        if (all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, size)) && near_change(place)) list_once(at, size);
    }
}
#else
uniform sampler2D change_ratio;
#pragma texels rgba16f change_ratio

bool near_change(ivec2 texel) {
    ivec2 last = textureSize(change_ratio, 0) - 1;
    float near = 0.0;
    // A driver does not know how long such loops are: it would unroll them, and compile each turn anew.
    ivec2 low = max(texel - FILL_RADIUS, ivec2(0)), high = min(texel + FILL_RADIUS, last), at = low;
    do {
        at.x = low.x;
        do near = max(near, texelFetch(change_ratio, at, 0).a); while (++at.x <= high.x);
    } while (++at.y <= high.y);
    return near > 1.5;
}
#endif
#endif

#ifdef RATIO
void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(sample_pixels, 0);
    bool inside = all(lessThan(texel, size));
    vec4 found = vec4(0.0);
    if (inside) {
        found = value(texel);
        imageStore(change_ratio_out, texel, found);
    }
#ifdef LISTS
    list_around(texel, size, found.a > 1.5, inside && shows_object(texel));
#endif
}
#else
void main() {
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy), size = textureSize(sample_pixels, 0);
    if (any(greaterThanEqual(texel, size))) return;
    if (shows_object(texel) || near_change(texel)) append_texel(texel, size.x);
}
#endif
