// What enters a cell from its six neighbours through the faces between them, times the transmittance of the geometry volume. No
// light enters from outside the volume. Needs light_cells.glsl, light_step.glsl and light_of(place), a neighbour's light.
layout(std430) readonly buffer Transmitted { uvec2 transmitted[]; };
uniform int cells;
uniform bool has_geometry;

struct Neighbours {
    uvec3 low, high;             // places along each axis
    vec3 from_low, from_high;   // transmittance
};

Neighbours neighbours_of(ivec3 cell) {
    uint here = cell_index(cell, cells);
    uvec2 open = has_geometry ? transmitted[here] : uvec2(0xffffffffu);
    vec4 xy = unpackUnorm4x8(open.x);
    vec2 z = unpackUnorm4x8(open.y).xy;
    uvec3 apart = uvec3(1u, uint(cells), uint(cells * cells));
    uvec3 has_low = uvec3(greaterThan(cell, ivec3(0))), has_high = uvec3(lessThan(cell, ivec3(cells - 1)));
    return Neighbours(here - apart * has_low, here + apart * has_high, vec3(xy.xz, z.x) * vec3(has_low), vec3(xy.yw, z.y) * vec3(has_high));
}

// Of the channel whose cells begin at `base`.
vec4 entering(Neighbours n, uint base) {
    vec4 sum = n.from_low.x * along_x(light_of(base + n.low.x), 1.0);
    sum += n.from_high.x * along_x(light_of(base + n.high.x), -1.0);
    sum += n.from_low.y * along_y(light_of(base + n.low.y), 1.0);
    sum += n.from_high.y * along_y(light_of(base + n.high.y), -1.0);
    sum += n.from_low.z * along_z(light_of(base + n.low.z), 1.0);
    sum += n.from_high.z * along_z(light_of(base + n.high.z), -1.0);
    return sum;
}
