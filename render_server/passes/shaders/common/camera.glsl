// The camera of the picture (render_server/view.py).
layout(std140) uniform Camera {
    mat4 camera_from_world;
    mat4 world_from_camera;
    vec4 camera_pinhole;    // fx, fy, cx, cy of the picture (pixel centres at integers)
    vec4 raster_pinhole;    // the same of the objects' raster, which is slightly wider
    vec3 camera_position;   // optical centre, world m
    vec2 picture_size;      // width and height, pixels
};
