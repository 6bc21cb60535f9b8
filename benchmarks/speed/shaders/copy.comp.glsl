// Moves every byte of one buffer into another: the machine's memory bandwidth.
layout(local_size_x = 256) in;

layout(std430) readonly buffer Source { uvec4 source[]; };
layout(std430) writeonly buffer Target { uvec4 target[]; };

void main() {
    target[gl_GlobalInvocationID.x] = source[gl_GlobalInvocationID.x];
}
