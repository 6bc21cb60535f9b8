// What the last frame traced of reflections. A record is what cones found, with the point and the mirrored direction that they were for. It
// moves from pixel to pixel as a whole: nothing is mixed, so nothing smears, and its errors do not add up. Needs geometry.glsl.
#include "common/reprojection.glsl"
#include "common/octahedral.glsl"

layout(rgba32ui) writeonly uniform uimage2D records_out;     // bits of the point (world m), and tag(); at pixel / STEP
layout(rgba32ui) readonly uniform uimage2D last_records;
layout(rgba16f) readonly uniform image2D last_reflected;
uniform uint run_number;

// Of the half-angle of what a pixel reflects: the directions of two pixels that may show the same. Means over two discs so far
// apart differ by at most 2 / pi of it (16 %) of the contrast within them.
const float SAME_DIRECTION = 0.25;
const float SAME_POINT = 1.5;   // records' spacing at the surface's depth
const float DIRECTION_STEPS = 1023.0;
const uint RUNS = 4096u;        // until a number comes again

struct Seen { vec4 position; vec3 normal; vec3 mirrored; };   // a surface's point (w: depth), and the direction that it reflects

// Direction of a record, and the run that wrote it: texels that a run did not write keep records of earlier ones.
uint tag(vec3 direction, uint run) {
    uvec2 steps = uvec2(round(octahedral_uv(direction) * DIRECTION_STEPS));
    return run % RUNS << 20 | steps.y << 10 | steps.x;
}

vec3 tagged_direction(uint tag) {
    return octahedral_direction(vec2(tag & 1023u, tag >> 10 & 1023u) / DIRECTION_STEPS);
}

void put_record(ivec2 pixel, Seen s) {
    imageStore(records_out, pixel / STEP, uvec4(floatBitsToUint(s.position.xyz), tag(s.mirrored, run_number)));
}

// Squared distance of a record's direction from that of `s`; far away if it is of another surface or of an earlier run.
float misses_by(uvec4 record, Seen s) {
    bool is_of_last = record.w >> 20 == (run_number - 1u) % RUNS;
    vec3 turned = tagged_direction(record.w) - s.mirrored;
    bool same = is_of_last && is_same_surface(uintBitsToFloat(record.xyz) - s.position.xyz, s.position.w, s.normal, SAME_POINT * float(STEP));
    return same ? dot(turned, turned) : 1e9;
}

// Carries over the record around a point's place in the last picture whose direction is nearest to that of now, if it is within
// the fraction SAME_DIRECTION of `half_angle`.
bool carry_record(ivec2 pixel, Seen s, float half_angle) {
    vec2 at = last_pixel(s.position.xyz) / float(STEP) - 0.5;
    float least = SAME_DIRECTION * half_angle;
    least *= least;
    uvec4 found = uvec4(0u);
    ivec2 place = ivec2(-1);
    for (int j = 0; j < 4; ++j) {
        ivec2 texel = ivec2(floor(at)) + ivec2(j & 1, j >> 1);
        if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, imageSize(last_records)))) continue;
        uvec4 record = imageLoad(last_records, texel);
        float off = misses_by(record, s);
        if (off < least) { least = off; found = record; place = texel; }
    }
    if (place.x < 0) return false;
    imageStore(records_out, pixel / STEP, uvec4(found.xyz, (found.w & 0xfffffu) | run_number % RUNS << 20));
    imageStore(reflected, pixel / STEP, imageLoad(last_reflected, place));
    return true;
}
