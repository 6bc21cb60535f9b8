// Nodes of the meshes of a depth image, fine (z: 0) and coarse (1), one for each cell of stride x stride pixels, at its centre
// (scene/depth_mesh.py): their vertices, inverse depth, the step to their neighbours that slopes explain, and with several
// cameras whether another one shows the surface there larger.
#define FITS_DEPTH
#include "common/fitted_normal.glsl"
#pragma switch GRAZING
#pragma switch SEVERAL_DEPTHS
#ifdef SEVERAL_DEPTHS
#include "common/depth_views.glsl"
uniform int depth_view_number;   // of this camera
#endif

#include "common/pixel_group.glsl"
#include "common/node_grids.glsl"
uniform sampler2D node_rays;       // (x/z, y/z) of the cells' centres
uniform sampler2D grazing_depth;   // 1/m, of surfaces too oblique to measure; 0 elsewhere
uniform ivec2 node_strides;        // pixels
uniform mat4 world_from_camera;
layout(rgba32f) writeonly uniform image2D nodes_out;   // 1/m, 0 for a hole; 1/m; 1 if another camera shows it larger
layout(std430) writeonly buffer Vertices { float vertices[]; };   // VERTEX_FLOATS each (scene/gpu_mesh.py)

const int CELL_SAMPLES = 6, MOST_SAMPLES = CELL_SAMPLES * CELL_SAMPLES;
const uint VERTEX_FLOATS = 12u;
const float MAX_CELL_DISTANCE = 2.8284271;   // cells between the pixels of two neighbouring nodes, at most
const float MOST_SHIFT = 0.1;   // of w, from a pixel to the centre: outliers of the slope must not throw nodes off

int stride;                // of this mesh
uint keys[MOST_SAMPLES];   // of a cell's sampled pixels: bits of w, the lowest replaced by the sample's number

float fitted_depth(ivec2 pixel) {
    float w = texelFetch(inverse_depth, pixel, 0).r;
    return w > 0.0 && slope_at(pixel).z > 0.5 ? w : 0.0;
}

float grazing_at(ivec2 pixel) {
    bool inside = all(greaterThanEqual(pixel, ivec2(0))) && all(lessThan(pixel, textureSize(grazing_depth, 0)));
    return inside ? texelFetch(grazing_depth, pixel, 0).r : 0.0;
}

int samples_across() { return min(stride, CELL_SAMPLES); }

// Pixel of a cell that a sample looks at.
ivec2 sampled_pixel(ivec2 cell, int number) {
    int across = samples_across(), last = max(across - 1, 1);
    ivec2 place = ivec2(number % across, number / across);
    return cell * stride + (2 * place * (stride - 1) + last) / (2 * last);
}

// The valid pixel with the median w; an invalid one if none is valid.
ivec2 median_pixel(ivec2 cell, bool is_grazing) {
    ivec2 size = textureSize(inverse_depth, 0);
    int count = samples_across() * samples_across(), invalid = 0, chosen = 0;
    uint number_bits = count == 1 ? 0u : (2u << findMSB(count - 1)) - 1u;
    for (int i = 0; i < count; ++i) {
        ivec2 pixel = sampled_pixel(cell, i);
        float w = 0.0;
        if (all(lessThan(pixel, size))) w = is_grazing ? grazing_at(pixel) : fitted_depth(pixel);
        invalid += int(w == 0.0);
        keys[i] = (floatBitsToUint(w) & ~number_bits) | uint(i);
    }
    int middle = min((invalid + count) / 2, count - 1);
    for (int i = 0; i < count; ++i) {
        int rank = 0;
        for (int j = 0; j < count; ++j) rank += int(keys[j] < keys[i]);
        if (rank == middle) chosen = i;
    }
    return min(sampled_pixel(cell, chosen), size - 1);
}

#ifdef GRAZING
bool has_neighbour(ivec2 pixel, ivec2 step) { return max(grazing_at(pixel - step), grazing_at(pixel + step)) > 0.0; }

// Change of the grazing surfaces' w from pixel to pixel.
float grazing_slope(ivec2 pixel, ivec2 step) {
    float w = grazing_at(pixel), before = grazing_at(pixel - step), after = grazing_at(pixel + step);
    if (before > 0.0 && after > 0.0) return 0.5 * (after - before);
    return before > 0.0 ? w - before : after - w;
}
#endif

void store_vertex(uint node, vec3 place, vec3 normal, vec2 pixel) {
    float row[VERTEX_FLOATS] = float[](
        place.x, place.y, place.z, normal.x, normal.y, normal.z, pixel.x, pixel.y, 1.0, 1.0, 1.0, 0.0
    );
    for (uint i = 0u; i < VERTEX_FLOATS; ++i) vertices[VERTEX_FLOATS * node + i] = row[i];
}

void main() {
    int coarseness = int(gl_WorkGroupID.z);
    ivec2 cell = ivec2(gl_GlobalInvocationID.xy), cells = grid_size(coarseness), size = textureSize(inverse_depth, 0);
    if (any(greaterThanEqual(cell, cells))) return;
    stride = node_strides[coarseness];
    ivec2 texel = node_texel(coarseness, cell);
    vec2 ray = texelFetch(node_rays, texel, 0).xy;
    ivec2 pixel = median_pixel(cell, false);
    float chosen = fitted_depth(pixel), w = 0.0, slack = 0.0;
    vec3 normal = vec3(0.0);
    if (chosen > 0.0) {
        vec2 gradient = by_ray(pixel, slope_at(pixel).xy);
        w = chosen + clamp(dot(gradient, ray - ray_at(pixel)), -MOST_SHIFT * chosen, MOST_SHIFT * chosen);
        normal = plane_normal(chosen, gradient, ray_at(pixel));
    }
#ifdef GRAZING
    const ivec2 RIGHT = ivec2(1, 0), DOWN = ivec2(0, 1);
    ivec2 strip = median_pixel(cell, true);
    if (w == 0.0 && grazing_at(strip) > 0.0 && has_neighbour(strip, RIGHT) && has_neighbour(strip, DOWN)) {
        vec2 slope = vec2(grazing_slope(strip, RIGHT), grazing_slope(strip, DOWN));
        w = grazing_at(strip);
        normal = plane_normal(w, by_ray(strip, slope), ray_at(strip));
        slack = MAX_CELL_DISTANCE * float(stride) * length(slope);
    }
#endif
    ivec2 first = cell * stride, last = min(first + stride, size) - 1;
    vec3 world = (world_from_camera * vec4(vec3(ray, 1.0) / w, 1.0)).xyz;
    if (w <= 0.0) world = vec3(0.0);   // of triangles without area
    normal = mat3(world_from_camera) * normal;
    bool is_copy = false;
#ifdef SEVERAL_DEPTHS
    is_copy = w > 0.0 && is_shown_larger(depth_view_number, world, normal, coarseness);
#endif
    imageStore(nodes_out, texel, vec4(w, slack, float(is_copy), 0.0));
    store_vertex(uint(first_vertices[coarseness] + cell.y * cells.x + cell.x), world, normal, 0.5 * vec2(first + last));
}
