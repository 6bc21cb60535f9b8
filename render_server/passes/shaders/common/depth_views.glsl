// Depth images of several cameras of one room at one moment (passes/depth_views.py): which of them shows a surface largest,
// and where they see nothing. The same rules as in scene/depth_views.py.
struct DepthView {
    mat4 view_from_world;
    vec4 pinhole;      // fx, fy, cx, cy (pixel centres at integers)
    ivec2 size;        // width and height, pixels
    vec2 jump_terms;   // threshold of a change of w beyond which two points are not on one surface: by w and pixel, and least
    vec3 eye;          // world, m
    bool bends;        // the picture is not a pinhole's
    ivec2 strides;     // pixels of a cell of the camera's meshes, fine and coarse
};

uniform sampler2D depth_view_cameras;        // a row each
uniform sampler2DArray depth_view_inverse;   // 1/m, a layer each, in its upper left corner; 0 unknown, negative without a plane
uniform sampler2DArray depth_view_rays;      // (x/z, y/z) of lenses that bend

const float NEAR_M = 0.02;       // nothing is seen nearer (render_server/view.py)
const float SAME_DEPTH = 0.02;   // relative: how far a point may be from what a camera sees there
const int LENS_STEPS = 4;

int depth_view_count() { return textureSize(depth_view_cameras, 0).y; }

vec4 depth_view_texel(int index, int column) { return texelFetch(depth_view_cameras, ivec2(column, index), 0); }

DepthView depth_view(int index) {
    mat4 matrix = mat4(
        depth_view_texel(index, 0), depth_view_texel(index, 1), depth_view_texel(index, 2), depth_view_texel(index, 3)
    );
    vec4 lens = depth_view_texel(index, 5), eye = depth_view_texel(index, 6), strides = depth_view_texel(index, 7);
    return DepthView(
        matrix, depth_view_texel(index, 4), ivec2(lens.xy), lens.zw, eye.xyz, eye.w > 0.5, ivec2(strides.xy)
    );
}

vec3 in_depth_view(DepthView view, vec3 p) { return (view.view_from_world * vec4(p, 1.0)).xyz; }

// The pixel that shows a point of the optical frame, by its ray; the lens's rays correct a pinhole's step by step.
ivec2 depth_view_pixel(int index, DepthView view, vec3 c) {
    vec2 ray = c.xy / c.z, beyond = vec2(view.size + 1), place = view.pinhole.xy * ray + view.pinhole.zw;
    for (int i = 0; i < (view.bends ? LENS_STEPS : 0); ++i) {
        ivec2 near = ivec2(clamp(floor(place + 0.5), vec2(0.0), vec2(view.size - 1)));
        place = vec2(near) + view.pinhole.xy * (ray - texelFetch(depth_view_rays, ivec3(near, index), 0).xy);
    }
    return ivec2(floor(clamp(place, -beyond, beyond) + 0.5));
}

// Inverse depth (as `depth_view_inverse`) that a camera shows at a point of its optical frame; 0 beside the picture.
float shown_inverse(int index, DepthView view, vec3 c, out ivec2 pixel) {
    pixel = ivec2(-1);
    if (c.z <= NEAR_M) return 0.0;
    pixel = depth_view_pixel(index, view, c);
    bool inside = all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, view.size));
    return inside ? texelFetch(depth_view_inverse, ivec3(pixel, index), 0).r : 0.0;
}

// On how many pixels a surface is shown (1/m^2): fx fy |n.c| / z^3; 0 from behind. Precise: cameras at one place must agree.
float pixels_per_area(DepthView view, vec3 p, vec3 n) {
    precise vec3 to_eye = view.eye - p;
    precise float facing = n.x * to_eye.x + n.y * to_eye.y + n.z * to_eye.z;
    precise vec3 c = in_depth_view(view, p);
    precise float z = max(c.z, NEAR_M);
    precise float shown = view.pinhole.x * view.pinhole.y * max(facing, 0.0) / (z * z * z);
    return shown;
}

// Whether a mesh of cells of `stride` pixels covers a pixel: planes are known all around, and no jump is near.
bool is_covered(int index, DepthView view, ivec2 pixel, int stride) {
    ivec2 first = max(pixel - stride, ivec2(0)), last = min(pixel + stride, view.size - 1);
    float least = 1e30, most = 0.0;
    for (int y = first.y; y <= last.y; ++y) {
        for (int x = first.x; x <= last.x; ++x) {
            float w = texelFetch(depth_view_inverse, ivec3(x, y, index), 0).r;
            if (w <= 0.0) return false;
            least = min(least, w);
            most = max(most, w);
        }
    }
    float w = texelFetch(depth_view_inverse, ivec3(pixel, index), 0).r;
    return most - least <= w * view.jump_terms.x * float(2 * stride) + view.jump_terms.y;
}

// Whether another camera than `own` shows a surface larger, and its mesh covers it; of those that show it alike, the first
// keeps it. Fine meshes: `coarseness` 0, coarse ones: 1.
bool is_shown_larger(int own, vec3 p, vec3 n, int coarseness) {
    float here = pixels_per_area(depth_view(own), p, n);
    for (int i = 0; i < depth_view_count(); ++i) {
        if (i == own) continue;
        DepthView view = depth_view(i);
        float there = pixels_per_area(view, p, n);
        if (i < own ? there < here : there <= here) continue;
        vec3 c = in_depth_view(view, p);
        ivec2 pixel;
        float w = abs(shown_inverse(i, view, c, pixel));
        bool shown = w > 0.0 && abs(w * c.z - 1.0) < SAME_DEPTH;
        if (shown && is_covered(i, view, pixel, view.strides[coarseness])) return true;
    }
    return false;
}

// Whether a point lies before what any camera sees: nothing is there.
bool is_in_free_space(vec3 p) {
    for (int i = 0; i < depth_view_count(); ++i) {
        DepthView view = depth_view(i);
        vec3 c = in_depth_view(view, p);
        ivec2 pixel;
        float w = abs(shown_inverse(i, view, c, pixel));
        if (w > 0.0 && w * c.z < 1.0 - SAME_DEPTH) return true;
    }
    return false;
}
