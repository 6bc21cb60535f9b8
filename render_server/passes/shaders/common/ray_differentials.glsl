// What a ray stands for as it is refracted and mirrored: how place and direction differ along two axes of the picture (Igehy 1999, Tracing
// Ray Differentials). Needs refraction.glsl.

// Columns: the axes. By how much the ray beside this one starts (m) and goes elsewhere.
struct Footprint { mat2x3 place; mat2x3 turn; };

const float WIDEST = 2.0;      // of a footprint at distance 1: linear differences mean nothing beyond
const float FLATTEST_RAY = 1e-3;   // cosine: footprints on surfaces seen edge on would have no end

mat2x3 limited(mat2x3 turn) {
    return mat2x3(turn[0] * min(WIDEST / max(length(turn[0]), 1e-6), 1.0), turn[1] * min(WIDEST / max(length(turn[1]), 1e-6), 1.0));
}

// Diameter of the disc with the area of the parallelogram that both axes span.
float width_of(mat2x3 axes) { return 2.0 * sqrt(length(cross(axes[0], axes[1])) / PI); }

// Root mean square of the lengths of both axes: more than that, where one is longer.
float longer_width_of(mat2x3 axes) { return sqrt(0.5 * (dot(axes[0], axes[0]) + dot(axes[1], axes[1]))); }

float width_at(Footprint f, float way) { return width_of(f.place + way * f.turn); }

// Where the ray in direction d meets a surface, after a way (m).
Footprint footprint_at(Footprint f, vec3 d, vec3 face, float way) {
    mat2x3 place = f.place + way * f.turn;
    return Footprint(place - outerProduct(d, face * place / min(dot(face, d), -FLATTEST_RAY)), f.turn);
}

// How the smooth normal of a triangle turns over a footprint there.
mat2x3 turn_of_normal(Interface i, MeshHit hit, mat2x3 place) {
    if (i.normal == i.face) return mat2x3(0.0);
    int at = 3 * hit.triangle;
    vec3 e1 = face_at(at + 1).xyz, e2 = face_at(at + 2).xyz, n = cross(e1, e2);
    ivec3 rows = floatBitsToInt(vec3(face_at(at).w, face_at(at + 1).w, face_at(at + 2).w));
    vec2 u = cross(e2, n) * place / dot(n, n), v = cross(n, e1) * place / dot(n, n);   // barycentric
    mat2x3 change = outerProduct(vertex_vector(rows, 3, vec3(-1.0, 1.0, 0.0)), u) + outerProduct(vertex_vector(rows, 3, vec3(-1.0, 0.0, 1.0)), v);
    float size = dot(vertex_vector(rows, 3, vec3(1.0 - hit.place.x - hit.place.y, hit.place)), i.normal);   // negative: turned against the ray
    return (change - outerProduct(i.normal, i.normal * change)) / size;
}

mat2x3 mirrored_turn(Interface i, vec3 d, Footprint f) {
    vec2 cosine = i.normal * f.turn + d * i.turn;
    return limited(f.turn - 2.0 * (dot(d, i.normal) * i.turn + outerProduct(i.normal, cosine)));
}

// `through`: the refracted direction.
mat2x3 refracted_turn(Interface i, vec3 d, vec3 through, float eta, Footprint f) {
    if (through == d) return f.turn;
    float before = dot(d, i.normal), after = dot(through, i.normal);
    vec2 cosine = i.normal * f.turn + d * i.turn;
    float bends = eta * before - after;
    return limited(eta * f.turn - bends * i.turn - outerProduct(i.normal, (eta - eta * eta * before / min(after, -FLATTEST_RAY)) * cosine));
}
