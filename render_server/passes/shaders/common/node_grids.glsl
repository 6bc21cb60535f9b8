// Nodes of the fine mesh of a depth image and of its coarse one, one grid below the other in a texture, one behind the other in
// the buffers. Pairs: fine, coarse.
uniform ivec4 grid_sizes;       // columns and rows
uniform ivec2 first_vertices;

ivec2 grid_size(int coarseness) { return coarseness == 0 ? grid_sizes.xy : grid_sizes.zw; }

ivec2 node_texel(int coarseness, ivec2 node) { return node + ivec2(0, coarseness * grid_sizes.y); }
