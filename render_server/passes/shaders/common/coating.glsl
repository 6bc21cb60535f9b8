// A clear coat over a sheen over a base (docs/method.md 4.12). Needs brdf.glsl, and materials.glsl with EXTENDED.
const vec3 COAT_F0 = vec3(0.04);            // of index 1.5
const float LEAST_SHEEN_ROUGHNESS = 0.1;    // smoother fibres show at outlines only, and would reflect more light than there is

// Directional albedo of a white sheen: a fit to its integrals, within 0.006 from cosine 0.05 on; above 1 at grazing angles.
float sheen_lobe_albedo(float roughness, float n_dot_v) {
    float r = max(roughness, LEAST_SHEEN_ROUGHNESS);
    vec4 x = vec4(1.0, sqrt(clamp(n_dot_v, 1e-3, 1.0)), clamp(n_dot_v, 1e-3, 1.0), 0.0);
    x.w = x.y * x.z;
    vec4 sum = vec4(0.1092, -0.2601, -0.9523, 0.1457) / r + vec4(0.0664, 1.9477, -1.834, -4.5614)
        + r * (vec4(-1.3117, -23.0122, 45.36, -12.3119)
            + r * (vec4(2.335, 40.8303, -89.5195, 39.6518) + r * vec4(-1.0642, -21.0002, 47.1956, -23.6168)));
    return exp(dot(sum, x));
}

float sheen_albedo(float roughness, float n_dot_v) { return min(sheen_lobe_albedo(roughness, n_dot_v), 1.0); }

// The mean over light from everywhere.
float mean_sheen_albedo(float roughness) {
    float r = max(roughness, LEAST_SHEEN_ROUGHNESS);
    return 0.0153 + r * (0.0175 + r * (0.6931 - 0.4242 * r));
}

// Smith's lambda of fibres, a fit (Estevez and Kulla 2017).
float sheen_lambda(float cosine, float alpha) {
    float t = (1.0 - alpha) * (1.0 - alpha), x = cosine < 0.5 ? cosine : 1.0 - cosine;
    vec4 p = mix(vec4(21.5473, 3.82987, 0.19823, -1.97760), vec4(25.3245, 3.32435, 0.16801, -1.27393), t);
    float e = mix(-4.32054, -4.85967, t);
    float here = p.x / (1.0 + p.y * pow(max(x, 1e-4), p.z)) + p.w * x + e;
    float middle = p.x / (1.0 + p.y * pow(0.5, p.z)) + p.w * 0.5 + e;
    return exp(cosine < 0.5 ? here : 2.0 * middle - here);
}

// BRDF times cosine of a white sheen: half-vectors that turn away from the normal (Estevez and Kulla 2017).
float sheen_times_cosine(vec3 n, vec3 v, vec3 l, float roughness) {
    float r = max(roughness, LEAST_SHEEN_ROUGHNESS), alpha = r * r;
    float n_dot_l = clamp(dot(n, l), 0.0, 1.0), n_dot_v = clamp(dot(n, v), 1e-3, 1.0);
    vec3 h = l + v;
    h *= inversesqrt(max(dot(h, h), 1e-12));
    float cosine = clamp(dot(n, h), 0.0, 1.0);
    float d = (2.0 + 1.0 / alpha) * pow(max(1.0 - cosine * cosine, 1e-6), 0.5 / alpha) / (2.0 * PI);
    float masking = 1.0 / ((1.0 + sheen_lambda(n_dot_v, alpha) + sheen_lambda(n_dot_l, alpha)) * 4.0 * n_dot_v);
    return d * masking / max(sheen_lobe_albedo(r, n_dot_v), 1.0);
}

float greatest_of(vec3 c) { return max(max(c.r, c.g), c.b); }

vec3 coat_normal(Coating over, vec3 n) { return over.normal == vec3(0.0) ? n : over.normal; }

// What the coat reflects of even light, towards one direction and in the mean.
float coat_reflectance(Coating over, float cosine) {
    return over.coat * specular_reflectance(COAT_F0, over.roughness, max(cosine, 1e-3)).r;
}

float mean_coat_reflectance(Coating over) { return over.coat * mean_specular_reflectance(COAT_F0, over.roughness).r; }

// What a surface reflects of even light towards v: its coat, the lobe of its base and its sheen; and what of the base both let out.
struct Reflected { float coat; vec3 lobe; vec3 sheen; float below; };

Reflected reflected_towards(Material m, vec3 n, vec3 v) {
    float coat = coat_reflectance(m.over, dot(coat_normal(m.over, n), v)), cosine = max(dot(n, v), 1e-3);
    vec3 sheen = m.over.sheen * sheen_albedo(m.over.sheen_roughness, cosine);
    float below = (1.0 - coat) * (1.0 - greatest_of(sheen));
    return Reflected(coat, below * specular_reflectance(m.f0, m.roughness, cosine), (1.0 - coat) * sheen, below);
}

// The coat's fraction of what both lobes reflect.
vec3 coat_fraction(Reflected r) { return r.coat / max(r.coat + r.lobe, vec3(1e-6)); }

// BRDF times cosine; `spread` as in specular_times_cosine. The coat dims the light to a diffuse base on its way in, too, as the
// base's own lobe does (brdf.glsl); other lobes only what leaves, as the extensions have it: so all keep the light.
vec3 coated_response(Material m, vec3 n, vec3 v, vec3 l, float cosine, vec2 spread) {
    Coating over = m.over;
    vec3 nc = coat_normal(over, n);
    Reflected seen = reflected_towards(m, n, v);
    float entered = (1.0 - coat_reflectance(over, dot(nc, l))) / (1.0 - mean_coat_reflectance(over));
    vec3 base = m.diffuse / PI * diffuse_under_lobe(m.f0, m.roughness, cosine, dot(n, v)) * (entered * cosine)
        + specular_times_cosine(n, v, l, m.f0, m.roughness, spread);
    return seen.below * base + (1.0 - seen.coat) * over.sheen * sheen_times_cosine(n, v, l, over.sheen_roughness)
        + over.coat * specular_times_cosine(nc, v, l, COAT_F0, over.roughness, spread);
}

// What coat and sheen let out of the base, in the mean.
float mean_below(Coating over) {
    return (1.0 - mean_coat_reflectance(over)) * (1.0 - greatest_of(over.sheen) * mean_sheen_albedo(over.sheen_roughness));
}

// Of light from everywhere, the part that a surface reflects, of its base's `base`.
vec3 mean_coated_reflectance(Material m, vec3 base) {
    float coat = mean_coat_reflectance(m.over);
    vec3 sheen = m.over.sheen * mean_sheen_albedo(m.over.sheen_roughness);
    return coat + (1.0 - coat) * sheen + mean_below(m.over) * base;
}
