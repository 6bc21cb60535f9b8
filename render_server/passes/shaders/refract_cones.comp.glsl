// Cones of real surfaces whose axes meet a transparent body (docs/method.md 4.11): it bends and divides them, so that their light comes
// from where they leave it. Corrects E_rho of trace_cones, in which they go straight on, by what the picture, voxels and environment show
// there. Once direct light is known, because the nearest such places lie in the body's own shadow. One invocation per cone, because Mesa's
// software renderer silently ends all loops of a thread after 65535 iterations.
#define ENDS_NEAR
#define VOXELS
#include "common/brdf.glsl"
#include "common/octahedral.glsl"
#include "common/look.glsl"
#include "common/ray_mesh.glsl"
#include "common/diffuse_cones.glsl"
#include "common/low_res_grid.glsl"
#include "common/work_list.glsl"
const int MOST_PENDING = 3;          // paths that are still to be traced
const float LEAST_WEIGHT = 0.02;     // of a path that goes on
#include "common/refracted_paths.glsl"

layout(local_size_x = 64) in;
layout(rgba16f) writeonly uniform image2D cone_change;   // rgb change of E_rho, before its filter
#include "common/camera.glsl"
shared vec3 of_cone[64];

const int MOST_SURFACES = 8;   // that the paths of one cone meet

bool bends(MeshHit hit) {
    if (hit.triangle < 0) return false;
    int material = material_of_triangle(hit.triangle);
    return is_transparent(material) && materials[material].medium.w > 0.0;
}

bool leaves_body(MeshHit hit, vec3 d) {
    return dot(cross(face_at(3 * hit.triangle + 1).xyz, face_at(3 * hit.triangle + 2).xyz), d) > 0.0;
}

// Where rays from a real surface start: outside of a body into whose foot noise of depth lifts it.
vec3 start_of_rays(SurfacePoint s) {
    float depth = (camera_from_world * vec4(s.position, 1.0)).z;
    Ray down = Ray(s.position, -s.normal);
    MeshHit foot = hit_before(down, 3.0 * noise_sigma * depth * depth, false);
    bool lifted = foot.triangle >= 0 && leaves_body(foot, down.direction);
    vec3 start = s.position;
    if (lifted) start = leave(interface_at(foot, down, 0.0), down.direction);
    return start;
}

// What a path sees that has left a body, or is no longer followed; `object`: distance of the next surface of any object.
vec3 radiance_beyond(Path path, float object, float ratio) {
    ScreenHit hit = ScreenHit(0.0, vec2(0.0), 1.0, 0.0);
    if (path.medium < 0) hit = screen_hit(path.from, path.direction, ratio);
    vec4 seen = hit.fraction > 0.0 && hit.distance < object ? shown_at(hit, ratio) : vec4(0.0);
    float open = 0.0;
    if (seen.a < 1.0) seen.rgb += (1.0 - seen.a) * look_in_voxels(path.from, path.direction, ratio, open);
    return seen.rgb;
}

// Radiance that arrives along all paths of a ray that begins with `hit`.
vec3 radiance_through(Ray ray, MeshHit hit, float ratio) {
    vec3 sum = vec3(0.0);
    pending_count = 0;
    Path path = Path(ray.from, ray.direction, vec3(1.0), -1);
    int met = 0;
    do {   // one turn for the first surface, too, because drivers compile each call of a long function anew
        bool divides = met == 0 || (path.medium >= 0 && met < MOST_SURFACES && bends(hit));
        path.weight *= kept_over(path.medium, hit.triangle < 0 ? 0.0 : hit.distance);
        if (divides) split_path(interface_at(hit, Ray(path.from, path.direction), ratio * hit.distance), path, false);
        else sum += path.weight * radiance_beyond(path, hit.distance, ratio);
        ++met;
        if (pending_count == 0) break;
        path = pending[--pending_count];
        hit = closest_hit(Ray(path.from, path.direction));
    } while (true);
    return sum;
}

// The same of a cone from q (voxels), of which real things before the body hide some.
vec3 bent_radiance(vec3 q, Ray ray, MeshHit hit, float ratio) {
    int home = volume;
    bool differs;
    Crossed met = Crossed(vec3(0.0), 0.0);
    near_end = hit.distance / voxel_edge - 1.0;
    if (near_end > 0.0) march_near(mipmap_rho, q, ray.direction, 0.0, ratio, met, differs);
    near_end = ENDLESS;
    float open = 1.0 - blocked_fraction(met.coverage);
    vec3 radiance = met.c;
    if (open > 0.0) radiance += open * radiance_through(ray, hit, ratio);
    work_in_volume(home);
    return radiance;
}

// What bending changes of the radiance that cone k of a surface brings.
vec3 change_of_cone(SurfacePoint s, int k, ConeSet set) {
    float ratio = set.width * cone_ratio();
    vec3 d = basis_around(s.normal) * cone_direction(k, set);
    Ray ray = Ray(start_of_rays(s), d);
    MeshHit hit = closest_hit(ray);
    if (!bends(hit) || leaves_body(hit, d)) return vec3(0.0);
    vec3 q = volume_coordinate(s.position);
    March straight = march(q, d, ratio, true);
    return bent_radiance(q, ray, hit, ratio) - straight.c_rho - straight.t_rho * environment(d, atan(0.5 * cone_ratio()));
}

vec3 refracted_cone(ivec2 texel, int k) {
    SurfacePoint s = surface_point(texel);
    enter_volume(s.position);
    bool is_inside = inside_volume(volume_coordinate(s.position));
    return is_inside ? change_of_cone(s, k, cones_of(texel)) : vec3(0.0);
}

// The texels that low_res_grid listed.
void main() {
    int inside = int(gl_LocalInvocationIndex), place = quotient(inside, cone_count), k = inside - place * cone_count;
    int texels_a_group = quotient(64, cone_count);
    uint group = spread(counted_group(), gl_NumWorkGroups.x * gl_NumWorkGroups.y);
    uint i = group * uint(texels_a_group) + uint(place);
    bool listed = place < texels_a_group && i < listed_count();
    ivec2 texel = listed ? texel_of_index(texels[i], low_resolution_size.x) : ivec2(0);
    of_cone[inside] = listed ? refracted_cone(texel, k) : vec3(0.0);
    memoryBarrierShared();
    barrier();
    if (k != 0 || !listed) return;
    vec3 change = vec3(0.0);
    for (int j = inside; j < inside + cone_count; ++j) change += of_cone[j];
    imageStore(cone_change, texel, vec4(change * PI / float(cone_count), 0.0));
}
