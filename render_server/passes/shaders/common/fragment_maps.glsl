// The maps of a fragment, filtered over its footprint. Needs materials.glsl, shown_maps.glsl, camera.glsl and the inputs `world`, `uv`,
// `second_uv`.
uniform sampler2D sample_coverage;   // of the samples drawn before; one texel of zeros if there is no more than one

struct Slopes { vec4 uv; vec4 second_uv; vec3 right; vec3 down; };   // per pixel: to the right (xy), down (zw); of the place
Slopes slopes;

void find_slopes() {
    slopes = Slopes(vec4(dFdx(uv), dFdy(uv)), vec4(dFdx(second_uv), dFdy(second_uv)), dFdx(world), dFdy(world));
}

vec2 uv_of(MapEntry m) { return m.v.w > 0.5 ? second_uv : uv; }

// Slopes of a map's own coordinate.
vec4 slopes_of(MapEntry m) {
    vec4 s = m.v.w > 0.5 ? slopes.second_uv : slopes.uv;
    return vec4(dot(m.u.xy, s.xy), dot(m.v.xy, s.xy), dot(m.u.xy, s.zw), dot(m.v.xy, s.zw));
}

// The mean over a pixel's footprint, long and narrow where a surface is seen at a grazing angle: up to PROBES samples along its
// length, of the mip level of its width. Samplers' own anisotropic filters differ between drivers; Mesa's blurs what is enlarged.
const float PROBES = 8.0;

// 1 if not wanted. (llvmpipe executes both sides of a branch, but no turn of a loop too many.)
vec4 map_here(sampler2DArray maps, MapEntry m, bool wanted) {
    float edge = float(textureSize(maps, 0).x);
    vec4 s = slopes_of(m) * edge;
    vec2 along = dot(s.xy, s.xy) > dot(s.zw, s.zw) ? s.xy : s.zw;
    float major = length(along), minor = max(abs(s.x * s.w - s.y * s.z) / max(major, 1e-12), max(major / PROBES, 1.0));
    int count = wanted && has_map(m) ? int(clamp(ceil(major / minor), 1.0, PROBES)) : 0;
    vec2 place = place_on(m, uv_of(m));
    float margin = 0.5 * minor / edge;
    vec4 sum = vec4(0.0);
    for (int i = 0; i < count; ++i) {
        vec2 shift = ((float(i) + 0.5) / float(count) - 0.5) * along / edge;
        sum += textureLod(maps, layer_place(m, place + shift, margin), log2(minor));
    }
    return count == 0 ? vec4(1.0) : sum / float(count);
}

// Whether an earlier sample represents the pixel: sample_coverage.comp.glsl will not copy this one's maps.
bool is_represented() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    bool known = !lens_distortion && all(lessThan(pixel, textureSize(sample_coverage, 0)));
    return known && texelFetch(sample_coverage, pixel, 0).r > 0.0;
}

ShownMaps fragment_maps(int index, vec3 tint) {
    MaterialEntry e = materials[index];
    bool wanted = !is_represented();
    vec2 rough_metal = map_here(data_maps, e.maps[METALLIC_ROUGHNESS], wanted).gb;
    float occlusion = 1.0 + e.maps[OCCLUSION].sampling.w * (map_here(data_maps, e.maps[OCCLUSION], wanted).r - 1.0);
    vec3 base = tint * map_here(color_maps, e.maps[BASE_COLOR], wanted).rgb;
    return ShownMaps(base, rough_metal.y, rough_metal.x, occlusion, map_here(color_maps, e.maps[EMISSIVE], wanted).rgb);
}

float fragment_opacity(int index) {
    MaterialEntry e = materials[index];
    return e.alpha.y * map_here(color_maps, e.maps[BASE_COLOR], true).a;
}

// Directions along u and against v of a triangle's coordinate, of any length. `s`: slopes_of.
void map_axes(vec4 s, out vec3 rightwards, out vec3 upwards) {
    float turn = s.x * s.w - s.y * s.z;
    rightwards = (slopes.right * s.w - slopes.down * s.y) * sign(turn);
    upwards = (slopes.right * s.z - slopes.down * s.x) * sign(turn);
}

// The normal `n` with a normal map's tilt. Tangents are those of the triangle's texture coordinates, turned into the plane across
// n; the map's y points against v (glTF 2.0, section 3.9.3). Towards the viewer `v` at least.
vec3 bent_normal(MapEntry m, vec3 n, vec3 v) {
    vec3 tangent, upwards;
    map_axes(slopes_of(m), tangent, upwards);
    tangent -= n * dot(n, tangent);
    if (!has_map(m) || dot(tangent, tangent) == 0.0) return n;
    tangent = normalize(tangent);
    vec3 across = cross(n, tangent);
    if (dot(across, upwards) < 0.0) across = -across;
    vec3 tilt = map_here(data_maps, m, true).rgb * 2.0 - 1.0;
    vec3 bent = tilt.x * m.sampling.w * tangent + tilt.y * m.sampling.w * across + tilt.z * n;
    bent = normalize(dot(bent, bent) == 0.0 ? n : bent);
    return normalize(bent + max(1e-2 - dot(bent, v), 0.0) * v);
}
