// Views of the lights' depth maps: what lies where in the maps of one atlas (passes/shadow_maps.py).
struct LightView {
    mat4 view_from_world;   // light at the origin (unless directional), looking along +z
    vec4 tile;              // x, y, size in texels; half extent (m for directional, else tangent)
    vec4 range;             // near, far in m; 1 if orthographic; 0
    vec4 front;             // plane (world) in front of which the light shines
};

// A row each, as those of lights.
layout(rgba32ui) readonly uniform uimage2D light_view_rows;

vec4 view_column(int i, int column) { return uintBitsToFloat(imageLoad(light_view_rows, ivec2(column, i))); }

LightView listed_view(int i) {
    mat4 view_from_world = mat4(view_column(i, 0), view_column(i, 1), view_column(i, 2), view_column(i, 3));
    return LightView(view_from_world, view_column(i, 4), view_column(i, 5), view_column(i, 6));
}

vec2 lateral(LightView view, vec3 v) { return view.range.z > 0.5 ? v.xy : v.xy / max(v.z, 1e-6); }

float linear_depth(LightView view, float d) {
    float near = view.range.x, far = view.range.y;
    return view.range.z > 0.5 ? mix(near, far, d) : near * far / (far - d * (far - near));
}

// The map's depth of a distance along the view: linear_depth undone.
float map_depth(LightView view, float z) {
    float near = view.range.x, far = view.range.y;
    return view.range.z > 0.5 ? (z - near) / (far - near) : far * (z - near) / (z * (far - near));
}

// Texel coordinate (pixel centres at .5) of a lateral position; outside its tile: negative.
vec2 tile_texel(LightView view, vec2 s) {
    vec2 uv = 0.5 + 0.5 * s / view.tile.w;
    if (any(lessThan(uv, vec2(0.0))) || any(greaterThanEqual(uv, vec2(1.0)))) return vec2(-1.0);
    return view.tile.xy + uv * view.tile.z;
}

const float NOTHING = 1e30;   // depth where a map shows nothing

float first_depth(sampler2D map, LightView view, ivec2 texel) {
    float d = texelFetch(map, texel, 0).r;
    return d >= 1.0 ? NOTHING : linear_depth(view, d);
}

// Of a lamp's `count` views, from `first` on: the one that shows p or, if none does, to whose tile it is nearest: a penumbra may reach beyond. Views around groups of objects
// are apart, and so are the penumbrae of what they show (passes/group_views.py).
int view_containing(int first, int count, vec3 p) {
    int found = first + count - 1, end = count > 1 ? first + count : first;
    float nearest = NOTHING;
    for (int i = first; i < end; ++i) {
        LightView view = listed_view(i);
        vec3 v = (view.view_from_world * vec4(p, 1.0)).xyz;
        vec2 s = abs(lateral(view, v));
        float beyond = v.z > 0.0 ? max(max(s.x, s.y) - view.tile.w, 0.0) : NOTHING;
        if (beyond < nearest) { nearest = beyond; found = i; }
    }
    return found;
}
