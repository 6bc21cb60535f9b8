// Sets the first words of a buffer to zero. Neighbouring invocations store neighbouring words, which a GPU joins; buffers
// need not end on a multiple of 16 bytes, as vectors would.
layout(local_size_x = 256) in;
layout(std430) writeonly buffer Cleared { uint cleared[]; };
uniform uint word_count;

void main() {
    for (uint i = gl_GlobalInvocationID.x; i < word_count; i += gl_NumWorkGroups.x * 256u) cleared[i] = 0u;
}
