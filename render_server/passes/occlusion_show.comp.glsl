// One object's occlusion for view `volume`: cells from which it hides a share of all directions, in red by that share.
#include "passes/common/object_field.glsl"
#include "passes/common/volume.glsl"

layout(local_size_x = 4, local_size_y = 4, local_size_z = 4) in;
layout(binding = 0, rgba16f) uniform image3D shown;
layout(binding = 1) uniform sampler3D occlusion;
uniform int slabs;            // a shell
uniform bool has_field;
uniform bool first;           // nothing lies in the image yet

const float WHOLE = 0.28209479;     // Y_0: the first coefficient is Y_0 times the solid angle, this share of the sphere's
const float LEAST_SHARE = 1.0 / 16.0;

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (any(greaterThanEqual(cell, ivec3(volume_size)))) return;
    float share = 0.0, before = first ? 0.0 : imageLoad(shown, cell).r;
    ShellPlace place = shell_place(to_object(volume_origin + voxel_edge * (vec3(cell) + 0.5)));
    if (has_field && place.fine >= 0) share = WHOLE * field_sample(occlusion, place, slabs, 0).r;
    share = max(before, share >= LEAST_SHARE ? share : 0.0);
    imageStore(shown, cell, vec4(share, 0.0, 0.0, share > 0.0 ? 1.0 : 0.0));
}
