// The texels of the last frame's reduced grid that saw a point. Needs reprojection.glsl.
uniform sampler2D last_real_texels;     // world m of each texel's real surface; w: depth, 0 none
uniform sampler2D last_object_texels;   // the same of its object
uniform int scale;

const float TEXELS_APART = 8.0;

struct LastTexels { ivec2 base; vec4 weights; float total; };   // of 2 x 2; `weights` sum to 1 unless `total` is 0

LastTexels last_texels(vec4 position, vec3 normal, bool object) {
    vec2 at = last_pixel(position.xyz) / float(scale) - 0.5;
    LastTexels found = LastTexels(ivec2(floor(at)), vec4(0.0), 0.0);
    for (int j = 0; j < 4; ++j) {
        ivec2 texel = found.base + ivec2(j & 1, j >> 1);
        if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, textureSize(last_real_texels, 0)))) continue;
        vec4 seen = object ? texelFetch(last_object_texels, texel, 0) : texelFetch(last_real_texels, texel, 0);
        if (seen.w > 0.0 && is_same_surface(seen.xyz - position.xyz, position.w, normal, TEXELS_APART * float(scale)))
            found.weights[j] = bilinear(at, j) + 1e-3;
    }
    found.total = dot(found.weights, vec4(1.0));
    found.weights /= max(found.total, 1e-6);
    return found;
}
