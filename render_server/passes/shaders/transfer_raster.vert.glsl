// An object's vertices and the light there, as the camera sees them through the raster pinhole.
uniform mat4 world_from_asset;
uniform mat4 clip_from_world;
in vec3 in_position;
in vec3 in_normal;
in vec4 in_light;
out vec3 world;
out vec3 normal;
out vec4 light;

void main() {
    vec4 place = world_from_asset * vec4(in_position, 1.0);
    world = place.xyz;
    normal = mat3(world_from_asset) * in_normal;
    light = in_light;
    gl_Position = clip_from_world * place;
}
