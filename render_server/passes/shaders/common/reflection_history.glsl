// What the last frame traced of reflections. A record is what cones found, with the point and the mirrored direction that they were for. It
// moves from pixel to pixel as a whole: nothing is mixed, so nothing smears, and its errors do not add up. Needs geometry.glsl.
#include "common/reprojection.glsl"
#include "common/octahedral.glsl"

layout(rgba32ui) writeonly uniform uimage2D records_out;     // at pixel / STEP; point (world m) with stamp(), and direction (octahedral)
layout(rgba32ui) readonly uniform uimage2D last_records;
layout(rgba16f) readonly uniform image2D last_reflected;
uniform uint run_number;

// Of the half-angle of what a pixel reflects: the directions of two pixels that may show the same. Means over two discs so far
// apart differ by at most 2 / pi of it (16 %) of the contrast within them.
const float SAME_DIRECTION = 0.25;
const float SAME_POINT = 1.5;   // records' spacing at the surface's depth
const uint STAMP = 15u;         // bits of each coordinate that are the stamp's: the points' are off by 2e-6 of them

struct Seen { vec4 position; vec3 normal; vec3 mirrored; };   // a surface's point (w: depth), and the direction that it reflects

// Of the run that wrote a record, out of 4096: texels that the last one did not write keep records of earlier ones.
uvec3 stamp(uint run) { return uvec3(run, run >> 4, run >> 8) & STAMP; }

uvec3 stamped(uvec3 point, uint run) { return (point & ~STAMP) | stamp(run); }

void put_record(ivec2 pixel, Seen s) {
    uvec3 point = stamped(floatBitsToUint(s.position.xyz), run_number);
    imageStore(records_out, pixel / STEP, uvec4(point, packUnorm2x16(octahedral_uv(s.mirrored))));
}

// Squared distance of a record's direction from that of `s`; far away if it is of another surface or of an earlier run.
float misses_by(uvec4 record, Seen s) {
    vec3 away = uintBitsToFloat(record.xyz & ~STAMP) - s.position.xyz;
    vec3 turned = octahedral_direction(unpackUnorm2x16(record.w)) - s.mirrored;
    bool is_of_last = (record.xyz & STAMP) == stamp(run_number - 1u);
    return is_of_last && is_same_surface(away, s.position.w, s.normal, SAME_POINT * float(STEP)) ? dot(turned, turned) : 1e9;
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
    imageStore(records_out, pixel / STEP, uvec4(stamped(found.xyz, run_number), found.w));
    imageStore(reflected, pixel / STEP, imageLoad(last_reflected, place));
    return true;
}
