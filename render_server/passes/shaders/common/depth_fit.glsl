// Inverse depth w, in which a plane is an affine function of the pixel (render_server/scene/depth_surface.py).
uniform vec2 jump_threshold;   // change of w to the next pixel beyond which both are not on one surface: per w, and at least

bool jumps(float from, float to) {
    return from > 0.0 && to > 0.0 && abs(to - from) > from * jump_threshold.x + jump_threshold.y;
}
