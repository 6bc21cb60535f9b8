// What further bounces than those that the voxels hold change on real surfaces (docs/method.md 4.3): irradiance in cells of a
// coarse grid of each volume, for surfaces that face along each direction. Needs volume.glsl.
const int TAIL_CELLS = 8;   // along each edge of a volume
const float TAIL_FIXED_POINT = 1048576.0;   // as in voxel_store.glsl

// Sums of a cell, weighted by area: what one more bounce adds to the irradiance (three); the area; and in luminance, without
// sign, that amount, and how much of it returns to surfaces of the volume when these have reflected it.
const int TAIL_AREA = 3, TAIL_AMOUNT = 4, TAIL_RETURNED = 5;
const int TAIL_SUMS = 6;
const int TAIL_PLACES = 6 * TAIL_CELLS * TAIL_CELLS * TAIL_CELLS;   // of a volume

int tail_place(ivec3 cell, int k) { return ((k * TAIL_CELLS + cell.z) * TAIL_CELLS + cell.y) * TAIL_CELLS + cell.x; }

// Texel of a place: volumes side by side in x, directions one after the other in z.
ivec3 tail_texel(int number, int place) {
    ivec3 cell = ivec3(place, place / TAIL_CELLS, place / (TAIL_CELLS * TAIL_CELLS));
    return ivec3(cell.xy % TAIL_CELLS + ivec2(number * TAIL_CELLS, 0), cell.z);
}

#ifdef READS_TAIL
uniform sampler3D bounce_tail;   // rgb irradiance times area, a: area

// Change of irradiance at q (voxels) on a surface about n, of the directions that it faces.
vec3 tail_irradiance(vec3 q, vec3 n) {
    vec3 at = clamp(q * float(TAIL_CELLS) / float(volume_size), vec3(0.5), vec3(float(TAIL_CELLS) - 0.5));
    vec4 sum = vec4(0.0);
    for (int axis = 0; axis < 3; ++axis) {
        int k = 2 * axis + (n[axis] < 0.0 ? 1 : 0);
        vec3 texel = at + vec3(volume, 0, k) * float(TAIL_CELLS);
        sum += n[axis] * n[axis] * textureLod(bounce_tail, texel / vec3(textureSize(bounce_tail, 0)), 0.0);
    }
    return sum.a > 0.0 ? sum.rgb / sum.a : vec3(0.0);
}
#endif
