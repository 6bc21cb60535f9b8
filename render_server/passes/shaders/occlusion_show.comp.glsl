// One object's occlusion for view `volume`: cells from which it occludes many directions, in red by how many.
#include "common/object_field.glsl"
#include "common/volume.glsl"

layout(local_size_x = 4, local_size_y = 4, local_size_z = 4) in;
layout(rgba16f) uniform image3D shown;
uniform sampler3D occlusion;
uniform int slabs;            // per shell
uniform bool has_field;
uniform bool first;           // the image is still empty

const float WHOLE = 0.28209479;     // Y_0: the first coefficient is Y_0 times the solid angle, as a fraction of the sphere
const float LEAST_FRACTION = 1.0 / 16.0;

void main() {
    ivec3 cell = ivec3(gl_GlobalInvocationID);
    if (any(greaterThanEqual(cell, ivec3(volume_size)))) return;
    float fraction = 0.0, before = first ? 0.0 : imageLoad(shown, cell).r;
    ShellPlace place = shell_place(to_object(volume_origin + voxel_edge * (vec3(cell) + 0.5)));
    if (has_field && place.fine >= 0) fraction = WHOLE * field_sample(occlusion, place, slabs, 0).r;
    fraction = max(before, fraction >= LEAST_FRACTION ? fraction : 0.0);
    imageStore(shown, cell, vec4(fraction, 0.0, 0.0, fraction > 0.0 ? 1.0 : 0.0));
}
