// The maps of a fragment (common/fragment.glsl), filtered over its footprint.
vec2 uv_of(Fragment f, MapEntry m) { return m.v.w > 0.5 ? f.second_uv : f.uv; }

// Slopes of a map's own coordinate.
vec4 slopes_of(Fragment f, MapEntry m) {
    vec4 s = m.v.w > 0.5 ? f.second_uv_slopes : f.uv_slopes;
    return vec4(dot(m.u.xy, s.xy), dot(m.v.xy, s.xy), dot(m.u.xy, s.zw), dot(m.v.xy, s.zw));
}

// The mean over a pixel's footprint, long and narrow where a surface is seen at a grazing angle: up to PROBES samples along its
// length, of the mip level of its width. Samplers' own anisotropic filters differ between drivers; Mesa's blurs what is enlarged.
const float PROBES = 8.0;

// 1 without a map. (llvmpipe executes both sides of a branch, but no turn of a loop too many.)
vec4 map_here(sampler2DArray maps, Fragment f, MapEntry m) {
    float edge = float(textureSize(maps, 0).x);
    vec4 s = slopes_of(f, m) * edge;
    vec2 along = dot(s.xy, s.xy) > dot(s.zw, s.zw) ? s.xy : s.zw;
    float major = length(along), minor = max(abs(s.x * s.w - s.y * s.z) / max(major, 1e-12), max(major / PROBES, 1.0));
    int count = has_map(m) ? int(clamp(ceil(major / minor), 1.0, PROBES)) : 0;
    vec2 place = place_on(m, uv_of(f, m));
    float margin = 0.5 * minor / edge;
    vec4 sum = vec4(0.0);
    for (int i = 0; i < count; ++i) {
        vec2 shift = ((float(i) + 0.5) / float(count) - 0.5) * along / edge;
        sum += textureLod(maps, layer_place(m, place + shift, margin), log2(minor));
    }
    return count == 0 ? vec4(1.0) : sum / float(count);
}

// All 1 if not wanted.
MapValues fragment_values(Fragment f, bool wanted) {
    MapValues s = no_maps();
    for (uint left = wanted ? maps_of(f.material, COLOR_MAPS) : 0u; left != 0u; left &= left - 1u)
        take_color(s, findLSB(left), map_here(color_maps, f, materials[f.material].maps[findLSB(left)]));
    for (uint left = wanted ? maps_of(f.material, DATA_MAPS | 1u << OCCLUSION) : 0u; left != 0u; left &= left - 1u)
        take_data(s, findLSB(left), map_here(data_maps, f, materials[f.material].maps[findLSB(left)]));
    return s;
}

ShownMaps shown_maps(Fragment f, MapValues s) {
    MaterialEntry e = materials[f.material];
    float occlusion = 1.0 + e.maps[OCCLUSION].sampling.w * (s.occlusion - 1.0);
    return ShownMaps(f.tint * s.base, s.metallic, s.roughness, occlusion, glow_tint(e, f.tint) * s.glow);
}

float fragment_opacity(Fragment f) {
    MaterialEntry e = materials[f.material];
    float own = e.alpha.y * map_here(color_maps, f, e.maps[BASE_COLOR]).a;
#ifdef CUTOUTS
    own *= f.opacity;
#endif
    return fraction_there(e, own);
}

// Directions along u and against v of a triangle's coordinate, of any length. `s`: slopes_of.
void map_axes(Fragment f, vec4 s, out vec3 rightwards, out vec3 upwards) {
    float turn = s.x * s.w - s.y * s.z;
    rightwards = (f.right * s.w - f.down * s.y) * sign(turn);
    upwards = (f.right * s.z - f.down * s.x) * sign(turn);
}

// Directions of a normal map's x and y on the front: of the file's tangent, else of the triangle's texture coordinates, turned into
// the plane across n; the map's y points against v (glTF 2.0, sections 3.7.2.1, 3.9.3). Zero where coordinates tell none.
void tangent_frame(Fragment f, MapEntry m, vec3 n, float side, out vec3 tangent, out vec3 bitangent) {
    vec3 upwards;
    bool is_given = f.tangent.xyz != vec3(0.0);
    map_axes(f, slopes_of(f, m), tangent, upwards);
    tangent = is_given ? f.tangent.xyz : tangent - n * dot(n, tangent);
    if (tangent == vec3(0.0)) return;
    tangent = normalize(tangent);
    bitangent = cross(n, tangent);
    bool turns = is_given ? side * f.tangent.w < 0.0 : dot(bitangent, upwards) < 0.0;
    if (turns) bitangent = -bitangent;
}

// The normal `n` with a normal map's tilt, towards the viewer `v` at least. Of a surface seen from behind, all of it is reversed.
vec3 bent_normal(Fragment f, MapEntry m, vec3 n, vec3 v) {
    vec3 tangent = vec3(0.0), bitangent = vec3(0.0);
    float side = materials[f.material].flags.x > 0.5 && dot(n, f.normal) < 0.0 ? -1.0 : 1.0;
    tangent_frame(f, m, n, side, tangent, bitangent);
    if (!has_map(m) || tangent == vec3(0.0)) return n;
    vec3 tilt = map_here(data_maps, f, m).rgb * 2.0 - 1.0;
    vec3 bent = side * m.sampling.w * (tilt.x * tangent + tilt.y * bitangent) + tilt.z * n;
    bent = normalize(dot(bent, bent) == 0.0 ? n : bent);
    return normalize(bent + max(1e-2 - dot(bent, v), 0.0) * v);
}
