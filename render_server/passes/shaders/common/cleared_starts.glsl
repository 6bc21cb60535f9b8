// Sets the first words of up to eight buffers to zero. Neighbouring invocations store neighbouring words, which a GPU joins;
// buffers need not end on a multiple of 16 bytes, as vectors would.
layout(std430) writeonly buffer Cleared { uint cleared[]; };
layout(std430) writeonly buffer Cleared1 { uint cleared_1[]; };
layout(std430) writeonly buffer Cleared2 { uint cleared_2[]; };
layout(std430) writeonly buffer Cleared3 { uint cleared_3[]; };
layout(std430) writeonly buffer Cleared4 { uint cleared_4[]; };
layout(std430) writeonly buffer Cleared5 { uint cleared_5[]; };
layout(std430) writeonly buffer Cleared6 { uint cleared_6[]; };
layout(std430) writeonly buffer Cleared7 { uint cleared_7[]; };
uniform ivec4 word_counts;
uniform ivec4 more_word_counts;   // of the last four

// Called by each of `stride` invocations, numbered by `first`.
void clear_starts(uint first, uint stride) {
    uvec4 counts = uvec4(word_counts), more = uvec4(more_word_counts);
    for (uint i = first; i < counts.x; i += stride) cleared[i] = 0u;
    for (uint i = first; i < counts.y; i += stride) cleared_1[i] = 0u;
    for (uint i = first; i < counts.z; i += stride) cleared_2[i] = 0u;
    for (uint i = first; i < counts.w; i += stride) cleared_3[i] = 0u;
    for (uint i = first; i < more.x; i += stride) cleared_4[i] = 0u;
    for (uint i = first; i < more.y; i += stride) cleared_5[i] = 0u;
    for (uint i = first; i < more.z; i += stride) cleared_6[i] = 0u;
    for (uint i = first; i < more.w; i += stride) cleared_7[i] = 0u;
}
