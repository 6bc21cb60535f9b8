// The light that a bounce adds to a cell: the sums of all bounces, less those before it (FIRST: none).
// TAIL: and the bounces beyond it (docs/method.md 5.6), to the sums as well. Each sends about the same share of the light of the one
// before, so all of them add share / (1 - share) times the last one.
// CLEARS: the sums before it, which have served, for the next bounce. Needs light_cells.glsl.
#include "common/albedo_range.glsl"
#ifdef TAIL
layout(std430) buffer Injected { int injected[]; };
layout(std430) readonly buffer Parts { vec2 parts[]; };   // SHARE_PARTS of them (lpv_bounce_share.comp.glsl)
#else
layout(std430) readonly buffer Injected { int injected[]; };
#endif
#ifdef CLEARS
layout(std430) buffer Before { int before[]; };
#else
#ifndef FIRST
layout(std430) readonly buffer Before { int before[]; };
#endif
#endif

const int SHARE_PARTS = 64;

// At most what the brightest surface sends back. `amounts`: the sum of all parts.
float share_of(vec2 amounts) { return min(amounts.y / max(amounts.x, 1.0), ALBEDO_RANGE.y); }

int added(int at, float share) {
    int sum = injected[at];
#ifndef FIRST
    sum -= before[at];
#endif
#ifdef TAIL
    int tail = int(round(share / (1.0 - share) * float(sum)));
    injected[at] += tail;
    sum += tail;
#endif
#ifdef CLEARS
    before[at] = 0;
#endif
    return sum;
}

// Of the cell of that number.
vec4 added_light(int cell, int channel, float share) {
    int first = cell * INJECTED_SUMS + 4 * channel;
    vec4 light;
    for (int k = 0; k < 4; ++k) light[k] = float(added(first + k, share)) / INJECTED_STEPS;
    return light;
}
