// A field of samples around one object, on nested box grids (render_server/scene/occlusion_field.py), in the asset's
// frame: axes and unit of its file.
uniform vec3 object_position;       // of the asset's origin, world m
uniform mat3 world_from_object;     // rotation only
uniform float object_scale;         // m per unit of the asset
uniform vec3 field_centre;
uniform vec3 object_half;           // half of the object's bounding box about the centre
uniform float object_radius;
uniform vec3 shell_halves[6];       // half of each grid's edges, finest first
uniform int shells;
uniform int resolution;             // samples per edge of the finest field

const float BLEND_CELLS = 2.0;
const float LOW = 0.1;              // sine of the elevation up to which an object's light and shadow fade in

vec3 to_object(vec3 p) { return (p - object_position) * world_from_object / object_scale; }
vec3 turn_to_object(vec3 d) { return d * world_from_object; }
vec3 field_middle() { return object_position + world_from_object * (object_scale * field_centre); }

// Position of a point: in shell `fine` at `u` (-1..1), and the weight of `fine` against the next; -1 beyond all.
struct ShellPlace { int fine; vec3 u; vec3 u_next; float fraction; };

float outermost(vec3 u) { return max(abs(u.x), max(abs(u.y), abs(u.z))); }

ShellPlace shell_place(vec3 q) {
    ShellPlace place = ShellPlace(-1, vec3(0.0), vec3(0.0), 0.0);
    for (int s = shells - 1; s >= 0; --s) {
        vec3 u = (q - field_centre) / shell_halves[s];
        float m = outermost(u);
        if (m < 1.0) {
            float cells = (1.0 - m) * 0.5 * float(resolution - 1);
            place = ShellPlace(s, u, place.u, smoothstep(0.0, BLEND_CELLS, cells));
        }
    }
    return place;
}

// Samples include -1 and 1; slab `slab` of a shell's `slabs`, all along z.
vec4 slab_sample(sampler3D field, int n, vec3 u, int slab) {
    vec3 at = 0.5 * (clamp(u, -1.0, 1.0) + 1.0) * float(n - 1) + 0.5;
    at.z += float(n * slab);
    return textureLod(field, at / vec3(textureSize(field, 0)), 0.0);
}

vec4 field_sample(sampler3D field, ShellPlace place, int slabs, int slab) {
    int n = textureSize(field, 0).x;
    vec4 fine = slab_sample(field, n, place.u, place.fine * slabs + slab);
    if (place.fraction == 1.0) return fine;
    vec4 next = vec4(0.0);
    if (place.fine + 1 < shells) next = slab_sample(field, n, place.u_next, (place.fine + 1) * slabs + slab);
    return mix(next, fine, place.fraction);
}

// Nothing below a surface's horizon counts. Three bands of a cosine do not end there: light from less than LOW above
// it is faded, where a clamped cosine is below LOW^2.
float above_horizon(vec3 q, vec3 n) {
    vec3 direction = field_centre - q;
    float height = dot(n, direction) + dot(abs(n), object_half);
    float distance_to_box = length(max(abs(direction) - object_half, vec3(0.0)));
    return clamp(height / max(LOW * distance_to_box, 1e-3 * object_radius), 0.0, 1.0);
}
