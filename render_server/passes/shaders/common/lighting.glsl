// The number of lights, and the layers of the residual environment (render_server/passes/lights.py).
layout(std140) uniform Lighting {
    int light_count;
    int environment_layers;
    float environment_first_half_angle;   // rad, of layer 0; the last is pi/2, cosine-weighted
};
