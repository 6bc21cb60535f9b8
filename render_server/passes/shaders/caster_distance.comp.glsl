// The squared distance, in cells of CELL x CELL texels of a light view's depth map, from any point of a cell to the nearest cell that
// shows anything: separable, as in Felzenszwalb and Huttenlocher 2012. Distances are between the cells' borders, so they are never
// too large. FIND: finds the cells that show anything, and the distances within each row of cells; otherwise goes on across the rows.
// A workgroup per row or column of a tile.
layout(local_size_x = 64) in;
layout(r32f) writeonly uniform image2D distance_out;
uniform int tile_cells;   // an edge
#ifdef FIND
uniform sampler2D depth_map;
uniform int tile_size;    // texels an edge
#else
layout(r32f) readonly uniform image2D row_distance;
#endif
const float FAR = 1e9;
const int THREADS = 64;   // = local_size_x
shared float cells[MOST_CELLS];

#ifdef FIND
ivec2 cell_at(int place) { return ivec2(int(gl_WorkGroupID.x) * tile_cells + place, gl_WorkGroupID.y); }

// Of a cell that shows anything 0, of others FAR.
float known_distance(ivec2 cell) {
    ivec2 tile = cell / tile_cells, low = (cell - tile * tile_cells) * CELL;
    ivec2 count = min(ivec2(CELL), tile_size - low);
    float nearest = 1.0;
    for (int y = 0; y < count.y; ++y)
        for (int x = 0; x < count.x; ++x)
            nearest = min(nearest, texelFetch(depth_map, tile * tile_size + low + ivec2(x, y), 0).r);
    return nearest < 1.0 ? 0.0 : FAR;
}
#else
ivec2 cell_at(int place) { return ivec2(gl_WorkGroupID.x, int(gl_WorkGroupID.y) * tile_cells + place); }

float known_distance(ivec2 cell) { return imageLoad(row_distance, cell).r; }
#endif

void main() {
    int first = int(gl_LocalInvocationID.x);
    for (int i = first; i < tile_cells; i += THREADS) cells[i] = known_distance(cell_at(i));
    memoryBarrierShared();
    barrier();
    for (int place = first; place < tile_cells; place += THREADS) {
        float least = FAR;
        for (int i = 0; i < tile_cells; ++i) {
            float gap = max(abs(float(i - place)) - 1.0, 0.0);
            least = min(least, cells[i] + gap * gap);
        }
        imageStore(distance_out, cell_at(place), vec4(least));
    }
}
