// Normal of the depth map at a pixel, in the optical frame and towards the camera; zero where unknown. FITS_DEPTH: from
// the plane that depth_columns fitted to its window; else from the slopes that numpy fitted.
uniform sampler2D picture_rays;    // (x/z, y/z)
#pragma texels rg32f picture_rays

vec2 ray_at(ivec2 pixel) { return texelFetch(picture_rays, pixel, 0).xy; }

// A plane n.P = d has w = (n/d).(x/z, y/z, 1), so n is along (gradient by ray, w - gradient.ray).
vec3 plane_normal(float w, vec2 gradient, vec2 ray) { return -normalize(vec3(gradient, w - dot(gradient, ray))); }

#ifdef FITS_DEPTH
uniform sampler2D inverse_depth;
uniform sampler2D window_fits;
uniform int window_radius;

const ivec2 SHIFTS[8] = ivec2[](
    ivec2(-1, 0), ivec2(1, 0), ivec2(0, -1), ivec2(0, 1), ivec2(-1, -1), ivec2(1, -1), ivec2(-1, 1), ivec2(1, 1)
);

// Of a window that crosses an edge, what one moved aside says that holds the pixel and does not.
vec3 slope_at(ivec2 pixel) {
    vec4 fit = texelFetch(window_fits, pixel, 0);
    ivec2 size = textureSize(window_fits, 0);
    for (int i = 0; i < (fit.w > 0.5 ? 8 : 0); ++i) {
        ivec2 at = pixel + window_radius * SHIFTS[i];
        vec4 other = texelFetch(window_fits, clamp(at, ivec2(0), size - 1), 0);
        bool inside = all(greaterThanEqual(at, ivec2(0))) && all(lessThan(at, size));
        if (inside && other.z > 0.5 && other.w < 0.5) return other.xyz;
    }
    return fit.xyz;
}

// Change of the ray coordinates by pixel.
mat2 rays_by_pixel(ivec2 pixel) {
    ivec2 last = textureSize(picture_rays, 0) - 1, low = max(pixel - 1, ivec2(0)), high = min(pixel + 1, last);
    vec2 across = texelFetch(picture_rays, ivec2(high.x, pixel.y), 0).xy - texelFetch(picture_rays, ivec2(low.x, pixel.y), 0).xy;
    vec2 down = texelFetch(picture_rays, ivec2(pixel.x, high.y), 0).xy - texelFetch(picture_rays, ivec2(pixel.x, low.y), 0).xy;
    return mat2(across / float(high.x - low.x), down / float(high.y - low.y));
}

// Turns a change by pixel into a change by ray coordinate.
vec2 by_ray(ivec2 pixel, vec2 slope) { return slope * inverse(rays_by_pixel(pixel)); }

vec3 fitted_normal(ivec2 pixel) {
    float w = texelFetch(inverse_depth, pixel, 0).r;
    vec3 slope = slope_at(pixel);
    bool known = w > 0.0 && slope.z > 0.5;
    return known ? plane_normal(w, by_ray(pixel, slope.xy), ray_at(pixel)) : vec3(0.0);
}
#else
uniform sampler2D slope_x;   // change of w by x/z and y/z; NaN where unknown
uniform sampler2D slope_y;
#pragma texels r32f slope_x slope_y

// `w`: 1/z of the pixel, 1/m.
vec3 fitted_normal(ivec2 pixel, float w) {
    vec2 slope = vec2(texelFetch(slope_x, pixel, 0).r, texelFetch(slope_y, pixel, 0).r);
    return isnan(slope.x) ? vec3(0.0) : plane_normal(w, slope, ray_at(pixel));
}
#endif
