// What the last frame traced of reflections. A record is what cones found, with the point and the mirrored direction that they were for. It
// moves from pixel to pixel as a whole: nothing is mixed, so nothing smears, and its errors do not add up. Needs geometry.glsl.
#include "common/reprojection.glsl"
#include "common/octahedral.glsl"

// Three texels a record, in a row: point (world m) with stamp(), direction (octahedral), radiance times fraction and fraction (halves).
// Even runs write the upper half, odd ones the lower; each reads the other. (One image, because OpenGL guarantees no more than eight.)
layout(rg32ui) uniform uimage2D records;
uniform uint run_number;

// Of the half-angle of what a pixel reflects: the directions of two pixels that may show the same. Means over two discs so far
// apart differ by at most 2 / pi of it (16 %) of the contrast within them.
const float SAME_DIRECTION = 0.25;
const float SAME_POINT = 1.5;   // records' spacing at the surface's depth
const uint STAMP = 15u;         // bits of each coordinate that are the stamp's: the points' are off by 2e-6 of them

struct Seen { vec4 position; vec3 normal; vec3 mirrored; };   // a surface's point (w: depth), and the direction that it reflects

// Of the run that wrote a record, out of 4096: texels that the last one did not write keep records of earlier ones.
uvec3 stamp(uint run) { return uvec3(run, run >> 4, run >> 8) & STAMP; }

ivec2 record_place(ivec2 texel, uint run) {
    return ivec2(3 * texel.x, texel.y + int(run & 1u) * imageSize(records).y / 2);
}

struct Record { uvec3 point; uint direction; uvec2 value; };

Record last_record(ivec2 texel) {
    ivec2 place = record_place(texel, run_number - 1u);
    uvec2 first = imageLoad(records, place).xy, second = imageLoad(records, place + ivec2(1, 0)).xy;
    return Record(uvec3(first, second.x), second.y, imageLoad(records, place + ivec2(2, 0)).xy);
}

void put_record(ivec2 texel, Record r) {
    ivec2 place = record_place(texel, run_number);
    uvec3 point = (r.point & ~STAMP) | stamp(run_number);
    imageStore(records, place, uvec4(point.xy, 0u, 0u));
    imageStore(records, place + ivec2(1, 0), uvec4(point.z, r.direction, 0u, 0u));
    imageStore(records, place + ivec2(2, 0), uvec4(r.value, 0u, 0u));
}

void put_traced(ivec2 pixel, Seen s, vec4 value) {
    uvec2 halves = uvec2(packHalf2x16(value.rg), packHalf2x16(value.ba));
    put_record(pixel / STEP, Record(floatBitsToUint(s.position.xyz), packUnorm2x16(octahedral_uv(s.mirrored)), halves));
}

// Squared distance of a record's direction from that of `s`; far away if it is of another surface or of an earlier run.
float misses_by(Record record, Seen s) {
    vec3 away = uintBitsToFloat(record.point & ~STAMP) - s.position.xyz;
    vec3 turned = octahedral_direction(unpackUnorm2x16(record.direction)) - s.mirrored;
    bool is_of_last = (record.point & STAMP) == stamp(run_number - 1u);
    return is_of_last && is_same_surface(away, s.position.w, s.normal, SAME_POINT * float(STEP)) ? dot(turned, turned) : 1e9;
}

// Carries over the record around a point's place in the last picture whose direction is nearest to that of now, if it is within
// the fraction SAME_DIRECTION of `half_angle`.
bool carry_record(ivec2 pixel, Seen s, float half_angle) {
    vec2 at = last_pixel(s.position.xyz) / float(STEP) - 0.5;
    float least = SAME_DIRECTION * half_angle;
    least *= least;
    Record found = Record(uvec3(0u), 0u, uvec2(0u));
    bool serves = false;
    ivec2 size = imageSize(records) / ivec2(3, 2);
    for (int j = 0; j < 4; ++j) {
        ivec2 texel = ivec2(floor(at)) + ivec2(j & 1, j >> 1);
        if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, size))) continue;
        Record record = last_record(texel);
        float off = misses_by(record, s);
        if (off < least) { least = off; found = record; serves = true; }
    }
    if (!serves) return false;
    put_record(pixel / STEP, found);
    imageStore(reflected, pixel / STEP, vec4(unpackHalf2x16(found.value.x), unpackHalf2x16(found.value.y)));
    return true;
}
