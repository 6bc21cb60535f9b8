// Light of the objects, mixed where samples of a pixel show two surfaces of theirs: the second one's comes from a neighbour.
layout(rgba16f) readonly uniform image2D virtual_radiance;
layout(rg16f) readonly uniform image2D interior_edges;   // share of the second surface; neighbour of 3 x 3: 4 row + column

vec3 objects_radiance(ivec2 pixel) {
    vec3 own = imageLoad(virtual_radiance, pixel).rgb;
    vec2 edge = imageLoad(interior_edges, pixel).rg;
    int code = int(edge.g);
    ivec2 beside = clamp(pixel + ivec2(code & 3, code >> 2) - 1, ivec2(0), imageSize(virtual_radiance) - 1);
    return edge.r > 0.0 ? mix(own, imageLoad(virtual_radiance, beside).rgb, edge.r) : own;
}
