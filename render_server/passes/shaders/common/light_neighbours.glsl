// What enters a cell from its six neighbours through the faces between them, times the transmittance of the geometry volume. No
// light enters from outside the volume. Needs light_cells.glsl, light_step.glsl and light_of(texel), a neighbour's light.
uniform usampler3D transmitted;
#pragma texels rg32ui transmitted
uniform int cells;
uniform bool has_geometry;

struct Neighbours {
    ivec3 low, high;            // along each axis
    vec3 from_low, from_high;   // transmittance
};

const uvec2 OPEN = uvec2(0xffffffffu);   // nothing blocks

Neighbours neighbours_past(ivec3 cell, uvec2 open) {
    vec4 xy = unpackUnorm4x8(open.x);
    vec2 z = unpackUnorm4x8(open.y).xy;
    uvec3 has_low = uvec3(greaterThan(cell, ivec3(0))), has_high = uvec3(lessThan(cell, ivec3(cells - 1)));
    ivec3 low = cell - ivec3(has_low), high = cell + ivec3(has_high);
    return Neighbours(low, high, vec3(xy.xz, z.x) * vec3(has_low), vec3(xy.yw, z.y) * vec3(has_high));
}

Neighbours neighbours_of(ivec3 cell) {
    return neighbours_past(cell, has_geometry ? texelFetch(transmitted, cell, 0).xy : OPEN);
}

vec4 entering(ivec3 cell, Neighbours n, int channel) {
    ivec3 texel = in_channel(cell, channel, cells), low = in_channel(n.low, channel, cells), high = in_channel(n.high, channel, cells);
    vec4 sum = n.from_low.x * along_x(light_of(ivec3(low.x, texel.yz)), 1.0);
    sum += n.from_high.x * along_x(light_of(ivec3(high.x, texel.yz)), -1.0);
    sum += n.from_low.y * along_y(light_of(ivec3(texel.x, low.y, texel.z)), 1.0);
    sum += n.from_high.y * along_y(light_of(ivec3(texel.x, high.y, texel.z)), -1.0);
    sum += n.from_low.z * along_z(light_of(ivec3(texel.xy, low.z)), 1.0);
    sum += n.from_high.z * along_z(light_of(ivec3(texel.xy, high.z)), -1.0);
    return sum;
}
