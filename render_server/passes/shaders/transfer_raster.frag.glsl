// Light at an object's fronts, and where they are (world m, w = 1); backs have no transfer.
uniform vec3 viewer_position;
in vec3 world;
in vec3 normal;
in vec4 light;
layout(location = 0) out vec4 out_light;
layout(location = 1) out vec4 out_position;

void main() {
    vec3 across = cross(dFdx(world), dFdy(world));
    if (dot(across, viewer_position - world) < 0.0) across = -across;
    if (dot(across, normal) < 0.0) discard;
    out_light = light;
    out_position = vec4(world, 1.0);
}
