// What begins a small volume and half steps of it (lpv_half_step.comp.glsl), all in one dispatch. A workgroup has a colour channel: it
// holds the totals of all cells of one colour in shared memory, lets those of the other take light from them, and holds these then.
// STARTS: the volume begins with injected light (lpv_start.comp.glsl); CHANGE: with the light of another one and what objects change of
// it (lpv_start_change.comp.glsl); BOUNCE: a bounce is added to it (lpv_add_bounce.comp.glsl); otherwise it goes on as it is.
#include "common/light_cells.glsl"
#include "common/light_step.glsl"
#ifdef BOUNCE
#include "common/added_bounce.glsl"
#elif defined(STARTS) || defined(CHANGE)
#include "common/injected_light.glsl"
#endif

layout(local_size_x = 1024) in;
layout(rgba32f) uniform image3D state;   // a cell's own light
layout(rgba32f) uniform image3D total;
#ifdef CHANGE
layout(rgba32f) readonly uniform image3D light_mu;
uniform usampler3D transmitted_real;   // without objects
#pragma texels rg32ui transmitted_real
#endif
uniform int colour;   // of the cells that the first half step changes
uniform int steps;    // half steps; where light is added, at least two, which store the totals of both colours

const int MOST_CELLS = 16;   // along an edge
const int THREADS = 1024;    // = local_size_x
const int ROUNDS = MOST_CELLS * MOST_CELLS * MOST_CELLS / 2 / THREADS;   // of all threads over the cells of a colour
shared vec4 held[MOST_CELLS * MOST_CELLS * MOST_CELLS / 2];

vec4 light_of(ivec3 cell);
#include "common/light_neighbours.glsl"

vec4 light_of(ivec3 cell) { return held[cell_index(cell, cells) >> 1]; }

int channel() { return int(gl_WorkGroupID.x); }

ivec3 texel_of(ivec3 cell) { return in_channel(cell, channel(), cells); }

// Number of the thread's cell in a round, among those of one colour.
int number_in(int j) { return int(gl_LocalInvocationID.x) + j * THREADS; }

bool is_cell(int i) { return i < cells * cells * cells / 2; }

ivec3 cell_of(int i, int wanted) {
    ivec3 c = cell_of_index(uint(2 * i), cells);
    c.x += ((c.x + c.y + c.z) & 1) ^ wanted;
    return c;
}

// Lets the whole workgroup see what each of its invocations stored.
void share() {
    memoryBarrierShared();
    barrier();
}

vec4 entering(ivec3 cell) { return entering(cell, neighbours_of(cell), 0); }

#ifdef CHANGE
void hold_mu(int wanted) {
    for (int i = number_in(0); is_cell(i); i += THREADS) held[i] = imageLoad(light_mu, texel_of(cell_of(i, wanted)));
    share();
}

// Of the cells of a colour, whose neighbours' light of mu is held.
void begin_changed(int wanted) {
    for (int i = number_in(0); is_cell(i); i += THREADS) {
        ivec3 cell = cell_of(i, wanted), texel = texel_of(cell);
        Neighbours real = neighbours_past(cell, has_geometry ? texelFetch(transmitted_real, cell, 0).xy : OPEN);
        Neighbours gained = Neighbours(real.low, real.high, -real.from_low, -real.from_high);
        vec4 change = injected_light(int(cell_index(cell, cells)), channel()) + entering(cell, gained, 0);
        imageStore(state, texel, imageLoad(light_mu, texel) + change);
    }
    share();
}

void begin() {
    for (int of_other = 0; of_other < 2; ++of_other) {
        hold_mu(colour ^ of_other);
        begin_changed(1 - (colour ^ of_other));
    }
}
#endif

#ifdef STARTS
// Stores a cell's own light and returns what it holds at first.
vec4 first_total(ivec3 cell, float returned) {
    vec4 light = injected_light(int(cell_index(cell, cells)), channel());
    imageStore(state, texel_of(cell), light);
    return light;
}
#elif defined(BOUNCE)
vec4 first_total(ivec3 cell, float returned) {
    ivec3 texel = texel_of(cell);
    vec4 light = added_light(int(cell_index(cell, cells)), channel(), returned);
    imageStore(state, texel, imageLoad(state, texel) + light);
    return imageLoad(total, texel) + light;
}
#elif !defined(CHANGE)
vec4 first_total(ivec3 cell, float returned) { return imageLoad(total, texel_of(cell)); }
#endif

#ifdef TAIL
// The sum of the parts in the order of workgroup_sum.glsl, in the memory that light takes then.
float measured_share() {
    int thread = int(gl_LocalInvocationID.x);
    if (thread < SHARE_PARTS) held[thread].xy = parts[thread];
    share();
    for (int stride = SHARE_PARTS / 2; stride > 0; stride /= 2) {
        if (thread < stride) held[thread].xy += held[thread + stride].xy;
        share();
    }
    float found = share_of(held[0].xy);
    share();
    return found;
}
#else
float measured_share() { return 0.0; }
#endif

#ifndef CHANGE
// The cells of the first colour too: what they hold is overwritten, but their own light counts.
void begin() {
    float returned = measured_share();
    for (int i = number_in(0); is_cell(i); i += THREADS) {
        first_total(cell_of(i, colour), returned);
        held[i] = first_total(cell_of(i, 1 - colour), returned);
    }
    share();
}
#endif

// Totals of both colours are stored by the last two half steps.
void half_step(int own, bool is_stored) {
    vec4 found[ROUNDS];
    for (int j = 0; j < ROUNDS; ++j) {
        int i = number_in(j);
        if (!is_cell(i)) continue;
        ivec3 cell = cell_of(i, own);
        found[j] = imageLoad(state, texel_of(cell)) + entering(cell);
    }
    share();
    for (int j = 0; j < ROUNDS; ++j) {
        int i = number_in(j);
        if (!is_cell(i)) continue;
        held[i] = found[j];
        if (is_stored) imageStore(total, texel_of(cell_of(i, own)), found[j]);
    }
    share();
}

void main() {
    begin();
    for (int left = steps; left > 0; --left) half_step(colour ^ ((steps - left) & 1), left <= 2);
}
