// Adds the flux of a texel of a reflective shadow map to the cells that the patch of surface which it stands for fills, each its
// share: texels as large as cells would fill some twice and leave others empty. Needs light_rays.glsl and inject_light.glsl.
const float LARGEST_PATCH = 8.0;   // cells along an axis: light may graze its surface

struct Patch { vec3 p; vec3 n; vec3 extents; };   // centre (world, m), normal, and size along the world's axes, m

// What the rays of a texel light of a plane (p, n): their side at p, along the rays onto the plane.
Patch lit_patch(LightView view, vec2 s, vec3 p, vec3 n) {
    mat3 axes = transpose(mat3(view.view_from_world));
    vec3 ray = axes * (view.range.z > 0.5 ? vec3(0.0, 0.0, 1.0) : vec3(s, 1.0));
    float facing = dot(n, ray), across = max(abs(facing), LEAST_COSINE) * (facing < 0.0 ? -1.0 : 1.0);
    vec3 u = axes[0] - ray * (dot(n, axes[0]) / across), v = axes[1] - ray * (dot(n, axes[1]) / across);
    return Patch(p, n, texel_side(view, (view.view_from_world * vec4(p, 1.0)).z) * (abs(u) + abs(v)));
}

// With the axis that a normal is nearest to as the last one, and back.
vec3 to_plane_axes(vec3 v, vec3 steep) { return steep.z >= max(steep.x, steep.y) ? v : steep.y >= steep.x ? v.zxy : v.yzx; }
vec3 from_plane_axes(vec3 v, vec3 steep) { return steep.z >= max(steep.x, steep.y) ? v : steep.y >= steep.x ? v.yzx : v.zxy; }

// As inject(), of a patch. It is split by cells along the two axes that its plane is nearest to, and its parts lie in that plane.
void inject_patch(Patch lit, vec3 axis, vec3 flux) {
    vec3 steep = abs(lit.n), n = to_plane_axes(lit.n, steep), q = to_plane_axes(volume_coordinate(lit.p) + 0.5 * axis, steep);
    vec2 extent = clamp(to_plane_axes(lit.extents, steep).xy / voxel_edge, 1e-3, LARGEST_PATCH), slope = -n.xy / n.z;
    vec2 low = q.xy - 0.5 * extent, high = low + extent;
    ivec2 first = max(ivec2(floor(low)), 0), last = min(ivec2(floor(high)), volume_size - 1);   // none outside the volume
    for (int j = first.y; j <= last.y; ++j)
        for (int i = first.x; i <= last.x; ++i) {
            vec2 from = max(low, vec2(i, j)), to = min(high, vec2(i, j) + 1.0), fraction = (to - from) / extent, middle = 0.5 * (from + to);
            vec3 part = vec3(middle, q.z + dot(slope, middle - q.xy));
            inject_at(from_plane_axes(part, steep), axis, flux * fraction.x * fraction.y);
        }
}
