// Relit picture: real pixels by the ratio of irradiances or by addition, virtual pixels over them by coverage, camera
// response; the camera's own bytes where nothing changed (docs/method.md 3, composition).
#include "common/brdf.glsl"
#include "common/camera_response.glsl"
#include "common/geometry.glsl"
#include "common/surfaces.glsl"
#include "common/upsample.glsl"
#include "common/work_list.glsl"
#include "common/albedo_range.glsl"

layout(local_size_x = 64) in;
layout(rgba8ui) writeonly uniform uimage2D code_out;
layout(rgba16f) writeonly uniform image2D linear_out;
layout(rgba32f) writeonly uniform image2D ratio_out;   // a: 1 where the picture changes (recompose.comp.glsl)
// Images, because OpenGL guarantees no more than sixteen samplers.
layout(rgba16f) readonly uniform image2D lobe_mu;
layout(rgba16f) readonly uniform image2D lobe_rho;
#include "common/interior_edges.glsl"
#pragma switch DISTANT_CHANGE
#ifdef DISTANT_CHANGE
layout(rgba16f) readonly uniform image2D distant_change;   // change_ratio.comp.glsl
#endif
uniform usampler2D picture;
uniform sampler2D linear_picture;
uniform sampler2D object_coverage;
uniform sampler2D direct_mu;
uniform sampler2D direct_rho;
uniform sampler2D cone_mu;
uniform sampler2D cone_rho;
uniform sampler2D cone_specular_mu;
uniform sampler2D cone_specular_rho;
uniform sampler2D change_ratio;
uniform sampler2D reflection;         // of objects in smooth surfaces, by rays; a: fraction of the lobe
uniform sampler2D edge_correction;    // common/edge_sides.glsl
#pragma texels rgba8ui picture
#pragma texels rgba16f linear_picture direct_mu direct_rho cone_mu cone_rho cone_specular_mu cone_specular_rho change_ratio reflection edge_correction
#pragma texels r16f object_coverage
#pragma switch bool has_reflection
uniform float exposure_scale;
#include "common/camera.glsl"
#pragma switch bool additive
#pragma switch bool has_object_lamps
uniform bool relights_real;      // method `none` shows objects and keeps the real scene
#pragma switch bool filmic   // ACES tone curve on the whole picture instead of the camera's response
#pragma switch bool specular_surfaces
uniform bool whole;              // compose every pixel, not only those near a change
uniform bool store_linear;       // for views and files; the picture itself needs only codes

// `gained`: what objects bring into a smooth surface by rays; `hidden`: fraction of what it reflected that they hide.
// `distant`: relative change of light beyond the objects' volumes.
struct Change { vec3 e_mu; vec3 delta; vec3 s_mu; vec3 s_rho; vec3 gained; float hidden; vec3 distant; bool any_change; };

// Indirect part: E_mu of the cones, and fade (E_rho - E_mu).
void add_cones(ivec2 pixel, vec4 position, vec3 normal, inout Change c) {
    vec3 e_mu = vec3(0.0), delta = vec3(0.0), s_mu = vec3(0.0), s_rho = vec3(0.0);
    vec3 distant = vec3(0.0);
    float total = 0.0;
    for (int j = 0; j < 4; ++j) {
        float w;
        ivec2 texel = low_texel(pixel, j, w);
        vec4 mu = texelFetch(cone_mu, texel, 0);
        ivec2 at = texelFetch(sample_pixels, texel, 0).xy;
        if (at.x < 0) continue;
        vec3 sp = texelFetch(real_surface_position, at, 0).xyz;
        vec3 sn = texelFetch(real_surface_normal, at, 0).xyz;
        w *= continuation(position.xyz, normal, sp, sn, sample_distance * position.w) + 1e-4;
        vec4 rho = texelFetch(cone_rho, texel, 0);
        e_mu += w * mu.rgb;
        delta += w * rho.a * (rho.rgb - mu.rgb);
#ifdef DISTANT_CHANGE
        distant += w * imageLoad(distant_change, texel).rgb;
#endif
        if (specular_surfaces) {
            vec3 specular_mu = texelFetch(cone_specular_mu, texel, 0).rgb;
            s_mu += w * specular_mu;
            s_rho += w * mix(specular_mu, texelFetch(cone_specular_rho, texel, 0).rgb, rho.a);
        }
        total += w;
    }
    if (total == 0.0) return;
    c.e_mu += e_mu / total;
    c.delta += delta / total;
    c.distant = distant / total;
    c.s_mu = s_mu / total;
    c.s_rho = s_rho / total;
}

Change change_at(ivec2 pixel, vec4 position, vec4 normal) {
    vec3 e_mu = texelFetch(direct_mu, pixel, 0).rgb;
    vec3 none = vec3(0.0);
    Change c = Change(e_mu, texelFetch(direct_rho, pixel, 0).rgb - e_mu, none, none, none, 0.0, none, false);
    add_cones(pixel, position, normal.xyz, c);
    if (specular_surfaces && normal.w >= 0.0) {
        SurfaceEntry e = surfaces[int(normal.w)];
        float cosine = max(dot(normal.xyz, normalize(camera_position - position.xyz)), 1e-3);
        vec3 reflectance = specular_reflectance(e.f0.rgb, e.surface.x, cosine);
        if (has_reflection && e.surface.x < RAY_ROUGHNESS) {   // rays give the objects' change there, cones do not
            vec4 seen = texelFetch(reflection, pixel, 0);
            c.gained = reflectance * seen.rgb;
            c.hidden = seen.a;
            c.s_rho = c.s_mu;
        }
        c.s_mu = reflectance * c.s_mu + imageLoad(lobe_mu, pixel).rgb;
        c.s_rho = reflectance * c.s_rho + imageLoad(lobe_rho, pixel).rgb;
    } else {
        c.s_mu = vec3(0.0);
        c.s_rho = vec3(0.0);
    }
    c.any_change = c.delta != vec3(0.0) || c.distant != vec3(0.0) || c.s_mu != c.s_rho || c.hidden > 0.0;
    return c;
}

// Fraction of the picture's radiance that is diffuse.
vec3 diffuse_fraction(ivec2 pixel, Change c, vec4 normal, vec3 b) {
    if (c.s_mu == vec3(0.0) && c.hidden == 0.0) return vec3(1.0);
    SurfaceEntry e = surfaces[int(normal.w)];
    // Reflections reach farther than the direct light was computed.
    bool lit = c.hidden == 0.0 || texelFetch(direct_mu, pixel, 0).a > 0.0;
    vec3 diffuse = e.albedo.w > 0.5 && lit ? e.albedo.rgb / PI * c.e_mu : max(b - c.s_mu, vec3(0.0));
    return (1.0 - e.f0.w) * diffuse / max(diffuse + c.s_mu, vec3(1e-6));
}

// What a specular surface shows in addition, of `glossy`, the picture's specular part. Predicted reflections that the
// picture does not show (a wrong normal reflects a light) cannot be removed from it. Occlusion found by rays and
// shadowed lights overlap; their parts of the picture are unknown, so the larger counts.
vec3 specular_change(Change c, vec3 glossy) {
    vec3 shown = min(glossy / max(c.s_mu, vec3(1e-6)), vec3(1.0));
    vec3 lost = shown * max(c.s_mu - c.s_rho, vec3(0.0)), more = max(c.s_rho - c.s_mu, vec3(0.0));
    return c.hidden > 0.0 ? c.gained - max(c.hidden * glossy, lost) : more - lost;
}

// `ratio`: of the light; all that there is where nothing is added and the surface is not specular.
vec3 relit(ivec2 pixel, Change c, vec4 normal, vec3 b, out vec3 ratio) {
    float e = 1e-3 * max(texelFetch(direct_mu, pixel, 0).a, 1e-6);
    ratio = (max(c.e_mu + c.delta, vec3(0.0)) + e) / (c.e_mu + e);
    // A ratio is right whatever the scale of the picture's own lights, which those of objects do not share: no surface reflects more
    // of these than the greatest albedo.
    vec3 gained = max(c.delta + c.distant * c.e_mu, vec3(0.0));
    ratio += c.distant;
    if (has_object_lamps) ratio = min(ratio, 1.0 + ALBEDO_RANGE.y / PI * gained / max(b, vec3(1e-6)));
    ratio = max(ratio, vec3(0.0));
    if (additive) {
        vec3 albedo = clamp(PI * b / max(c.e_mu, vec3(1e-6)), ALBEDO_RANGE.x, ALBEDO_RANGE.y);
        vec3 glossy = c.hidden > 0.0 ? (1.0 - diffuse_fraction(pixel, c, normal, b)) * b : vec3(0.0);
        return max(vec3(0.0), b * (1.0 + c.distant) + albedo / PI * c.delta + specular_change(c, glossy));
    }
    vec3 w = diffuse_fraction(pixel, c, normal, b), glossy = (1.0 - w) * b;
    return w * b * ratio + max(vec3(0.0), glossy + specular_change(c, glossy));
}

// Where depth is unknown the change of light continues from surroundings of similar colour; 1 if there are none, or if not wanted.
// (llvmpipe executes both sides of a branch, but no turn of a loop too many.)
vec3 surrounding_ratio(ivec2 pixel, vec3 b, bool wanted) {
    ivec2 centre = ivec2(quotient(pixel.x, scale), quotient(pixel.y, scale)), last = textureSize(sample_pixels, 0) - 1;
    float total = 1e-4;   // no change if all are far away or of another colour
    vec3 sum = vec3(total);
    int reach = wanted ? FILL_RADIUS : -1;
    for (int j = -reach; j <= reach; ++j)
        for (int i = -reach; i <= reach; ++i) {
            ivec2 texel = clamp(centre + ivec2(i, j), ivec2(0), last);
            vec4 ratio = texelFetch(change_ratio, texel, 0);
            if (ratio.a == 0.0) continue;
            ivec2 at = texelFetch(sample_pixels, texel, 0).xy;
            vec3 difference = (texelFetch(linear_picture, at, 0).rgb - b) / (0.1 + b);
            vec2 away = vec2(at - pixel) / float(FILL_RADIUS * scale);
            float w = exp(-4.0 * dot(away, away) - 4.0 * dot(difference, difference));
            sum += w * ratio.rgb;
            total += w;
        }
    return sum / total;
}

// ACES tone curve (Narkowicz's fit, 2015).
vec3 aces(vec3 x) { return clamp(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0); }

// The pixel that represents a pixel's surface: another one at the rims of real things in front of objects.
ivec2 surface_pixel(ivec2 pixel) {
    int code = int(texelFetch(edge_correction, pixel, 0).a) - 1, width = 2 * SURFACE_REACH + 1;
    return code < 0 ? pixel : pixel + ivec2(code % width, code / width) - SURFACE_REACH;
}

void compose(ivec2 pixel) {
    uvec4 code = uvec4(texelFetch(picture, pixel, 0).rgb, 255u);
    vec3 b = max(texelFetch(linear_picture, pixel, 0).rgb + texelFetch(edge_correction, pixel, 0).rgb, vec3(0.0));
    vec3 result = b, ratio = vec3(1.0);
    bool changed = filmic;
    ivec2 at = surface_pixel(pixel);
    vec4 position = texelFetch(real_surface_position, at, 0);
    float shown = texelFetch(object_coverage, pixel, 0).r;
    bool relights = relights_real && shown < 1.0;
    if (relights && position.w > 0.0) {
        vec4 normal = texelFetch(real_surface_normal, at, 0);
        Change c = change_at(at, position, normal);
        if (c.any_change) { result = relit(at, c, normal, b, ratio); changed = true; }
    }
    bool is_unknown = relights && position.w <= 0.0;
    vec3 around = surrounding_ratio(pixel, b, is_unknown);
    if (is_unknown) {
        ratio = around;
        if (ratio != vec3(1.0)) { result = b * ratio; changed = true; }
    }
    if (shown > 0.0) {
        result = mix(result, objects_radiance(pixel), shown);
        changed = true;
    }
    if (changed) {
        vec3 x = result * exposure_scale;
        if (filmic) x = aces(x);
        code.rgb = encode(x);
    }
    imageStore(code_out, pixel, code);
    imageStore(ratio_out, pixel, vec4(ratio, changed ? 1.0 : 0.0));
    if (store_linear) imageStore(linear_out, pixel, vec4(result, 1.0));
}

// The pixels of the texels that change_ratio listed, or (`whole`) all pixels.
void main() {
    ivec2 size = textureSize(picture, 0), grid = textureSize(sample_pixels, 0);
    int block = scale * scale;
    uint count = (whole ? uint(grid.x * grid.y) : listed_count()) * uint(block), i = first_item();
    if (i < count) do {
        int number = quotient(int(i), block);
        uint index = whole ? uint(number) : texels[number];
        ivec2 pixel = pixel_in_block(texel_of_index(index, grid.x), int(i) - number * block, scale);
        if (all(lessThan(pixel, size))) compose(pixel);
    } while ((i += items_apart()) < count);
}
