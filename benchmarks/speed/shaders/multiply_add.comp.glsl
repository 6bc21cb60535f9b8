// Multiplies and adds in registers alone: the machine's arithmetic. Four chains hide the latency of each.
// ROUNDS: how often each chain multiplies and adds a vec4.
layout(local_size_x = 256) in;

layout(std430) writeonly buffer Result { float result[]; };
uniform float factor;

void main() {
    vec4 a = vec4(gl_LocalInvocationID.x), b = a + 1.0, c = a + 2.0, d = a + 3.0;
    for (int i = 0; i < ROUNDS; i++) {
        a = a * factor + 0.5;
        b = b * factor + 0.5;
        c = c * factor + 0.5;
        d = d * factor + 0.5;
    }
    result[gl_GlobalInvocationID.x] = dot(a + b + c + d, vec4(1.0));
}
