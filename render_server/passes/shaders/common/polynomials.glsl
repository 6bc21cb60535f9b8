// Polynomial texture maps (docs/method.md 6.8): where on the map a pixel is and how that lies, packed by the geometry
// buffer in place of the other maps. Needs materials.glsl with MATERIAL_MAPS and basis.glsl.

const float MAP_STEPS = 4096.0;        // steps of a map's coordinate: two fit a float exactly
const float MIRRORED_TURN = 16.0;   // added to a turn where the map is mirrored on the surface

bool is_polynomial(int index) { return materials[index].flags.z > 0.0; }

// `rightwards`, `upwards`: along u and against v.
vec2 pack_place(vec2 uv, vec3 n, vec3 rightwards, vec3 upwards) {
    vec2 steps = min(floor(fract(uv) * MAP_STEPS), MAP_STEPS - 1.0);
    mat3 basis = basis_around(n);
    float turn = atan(dot(rightwards, basis[1]), dot(rightwards, basis[0]));
    bool mirrored = dot(cross(n, rightwards), upwards) < 0.0;
    return vec2(steps.x + MAP_STEPS * steps.y, mirrored ? turn + MIRRORED_TURN : turn);
}
