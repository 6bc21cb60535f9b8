// Textures by the light's direction, polynomials and stacks (docs/method.md 6.8, 6.9): where on the texture a pixel is and how
// that lies, packed by the geometry buffer in place of other maps. Needs materials.glsl with MATERIAL_MAPS and basis.glsl.

const float MAP_STEPS = 4096.0;        // steps of a map's coordinate: two fit a float exactly
const float MIRRORED_TURN = 16.0;   // added to a turn where the map is mirrored on the surface

bool is_by_light(int index) { return materials[index].flags.z > 0.0; }

bool is_stack(int index) { return materials[index].flags.w > 0.0; }

float pack_place(vec2 uv) {
    vec2 steps = min(floor(fract(uv) * MAP_STEPS), MAP_STEPS - 1.0);
    return steps.x + MAP_STEPS * steps.y;
}

vec2 unpack_place(float place) {
    float row = floor(place / MAP_STEPS);
    return (vec2(place - MAP_STEPS * row, row) + 0.5) / MAP_STEPS;
}

// `rightwards`, `upwards`: along u and against v.
float pack_turn(vec3 n, vec3 rightwards, vec3 upwards) {
    mat3 basis = basis_around(n);
    float turn = atan(dot(rightwards, basis[1]), dot(rightwards, basis[0]));
    bool mirrored = dot(cross(n, rightwards), upwards) < 0.0;
    return mirrored ? turn + MIRRORED_TURN : turn;
}
