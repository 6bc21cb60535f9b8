// Orthonormal basis around n without a branch on its direction (Duff et al. 2017).
mat3 basis_around(vec3 n) {
    float s = n.z >= 0.0 ? 1.0 : -1.0;
    float a = -1.0 / (s + n.z);
    float b = n.x * n.y * a;
    return mat3(vec3(1.0 + s * n.x * n.x * a, s * b, -s * n.x), vec3(b, s + n.y * n.y * a, -n.y), n);
}

const float PI = 3.14159265358979;
const float GOLDEN_ANGLE = 2.39996322972865;
