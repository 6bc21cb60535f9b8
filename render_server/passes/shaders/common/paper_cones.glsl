// The paper's nine diffuse cones ([P1] 3.2): the normal, four at 45 degrees, four on the diagonals between ((1,1,1) about
// the normal).
#include "common/march_joint.glsl"
#include "common/environment.glsl"
#include "common/basis.glsl"

const float START = 2.0;    // voxels along the normal, to leave the surface's own voxels
const int CONES = 9;
const float HALF_ANGLE = 0.4759;     // rad: a ninth of the hemisphere's solid angle each, cos = 8/9
const float RATIO = 1.0308;          // diameter / distance, 2 tan(HALF_ANGLE)
const float DIAGONAL = 0.57735026919;
const float RIGHT = 0.70710678119;
const float COSINE_SUM = 1.0 + 4.0 * RIGHT + 4.0 * DIAGONAL;

// Direction k about z; its z is its cosine weight.
vec3 cone_direction(int k) {
    if (k == 0) return vec3(0.0, 0.0, 1.0);
    float phi = float(k - 1) * PI / 4.0;
    float z = (k & 1) == 1 ? RIGHT : DIAGONAL;
    return vec3(sqrt(1.0 - z * z) * vec2(cos(phi), sin(phi)), z);
}

vec2 in_volume(vec3 q, vec3 d) { return box_interval(q, d, vec3(0.0), vec3(float(volume_size))); }

// (c, a) of the cone from q (voxels) through the volume at hand, and through others that are ahead; nothing is known of what
// stands between them.
vec4 march_on(sampler3D mipmap, vec3 q, vec3 d, float ratio) {
    vec2 within = in_volume(q, d);
    vec4 sum = march(mipmap, q, d, ratio, within);
#ifdef SEVERAL_VOLUMES
    int home = volume;
    vec3 from = volume_origin + q * voxel_edge;
    uint crossed = 1u << home;
    float t = enter_next(from, d, within.y * voxel_edge, crossed);   // m
    while (sum.a < OPAQUE && t < ENDLESS) {
        crossed |= 1u << volume;
        vec3 start = volume_coordinate(from);
        float end = in_volume(start, d).y;
        sum = accumulated(sum, march(mipmap, start, d, ratio, vec2(t / voxel_edge, end)));
        t = enter_next(from, d, end * voxel_edge, crossed);
    }
    work_in_volume(home);
#endif
    return sum;
}

// E of the nine cones; unoccluded uniform light would give pi L.
vec3 diffuse(sampler3D mipmap, vec3 q, vec3 n, bool with_environment) {
    mat3 basis = basis_around(n);
    vec3 e = vec3(0.0);
    for (int k = 0; k < CONES; ++k) {
        vec3 local = cone_direction(k);
        vec3 d = basis * local;
        vec4 c = march_on(mipmap, q, d, RATIO);
        if (with_environment) c.rgb += (1.0 - c.a) * environment(d, HALF_ANGLE);
        e += local.z * c.rgb;
    }
    return e * PI / COSINE_SUM;
}
