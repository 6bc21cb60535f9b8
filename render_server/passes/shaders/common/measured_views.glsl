// What several cameras measure of the real scene (render_server/passes/measured_views.py): the picture and depth of
// each in a layer, in its upper left corner.
struct MeasuredView {
    mat4 view_from_world;
    vec4 pinhole;   // fx, fy, cx, cy (pixel centres at integers)
    vec2 extent;    // width and height of the picture, pixels
};

uniform sampler2D view_cameras;         // a row each: matrix by columns, pinhole, extent
uniform sampler2DArray view_radiance;   // camera units, reduced: as mip level `picture_lod`
uniform sampler2DArray view_depth;      // m along the optical axis, 0 unknown

int seeing_view = -1;   // the one that showed the point largest when `camera_sees` was asked

vec4 view_texel(int index, int column) { return texelFetch(view_cameras, ivec2(column, index), 0); }

MeasuredView measured_view(int index) {
    mat4 matrix = mat4(view_texel(index, 0), view_texel(index, 1), view_texel(index, 2), view_texel(index, 3));
    return MeasuredView(matrix, view_texel(index, 4), view_texel(index, 5).xy);
}

vec2 view_pixel(MeasuredView view, vec3 c) { return view.pinhole.xy * c.xy / c.z + view.pinhole.zw + 0.5; }

bool view_sees(int index, MeasuredView view, vec3 c) {
    if (c.z <= 0.0) return false;
    vec2 pixel = view_pixel(view, c);
    if (any(lessThan(pixel, vec2(0.0))) || any(greaterThanEqual(pixel, view.extent))) return false;
    float seen = texelFetch(view_depth, ivec3(ivec2(pixel), index), 0).r;
    return seen > 0.0 && abs(seen - c.z) < depth_tolerance * c.z;
}

// Whether any camera sees p; `n` is the normal of the visible side, zero if either is. A pinhole shows an area dA at c
// on fx fy |n.c| / z^3 dA pixels.
bool camera_sees(vec3 p, vec3 n) {
    float most = 0.0;
    seeing_view = -1;
    for (int i = 0; i < textureSize(view_cameras, 0).y; ++i) {
        MeasuredView view = measured_view(i);
        vec3 c = (view.view_from_world * vec4(p, 1.0)).xyz;
        float facing = n == vec3(0.0) ? length(c) : -dot(mat3(view.view_from_world) * n, c);
        float pixels = view.pinhole.x * view.pinhole.y * facing / (c.z * c.z * c.z);
        if (pixels <= most || !view_sees(i, view, c)) continue;
        most = pixels;
        seeing_view = i;
    }
    return seeing_view >= 0;
}

bool camera_sees(vec3 p) { return camera_sees(p, vec3(0.0)); }

// After `camera_sees` found a view. Samples keep clear of what lies beside the picture in its layer.
vec3 measured_radiance(vec3 p) {
    MeasuredView view = measured_view(seeing_view);
    vec2 place = view_pixel(view, (view.view_from_world * vec4(p, 1.0)).xyz) * exp2(-picture_lod);
    vec2 texel = clamp(place, vec2(0.5), view.extent * exp2(-picture_lod) - 0.5);
    return textureLod(view_radiance, vec3(texel / vec2(textureSize(view_radiance, 0).xy), float(seeing_view)), 0.0).rgb;
}
