// The normal of the object that a pixel shows; w: material. Needs geometry.glsl and shown_maps.glsl.
#ifdef EXTENDED
// `of_coat`: the coat's normal.
vec4 shown_normal(ivec2 raster, bool of_coat) {
    vec4 normal = texelFetch(virtual_raster_normal, raster, 0);
    vec3 above = coating_at(raster, int(normal.w)).normal;
    return of_coat && above != vec3(0.0) ? vec4(above, normal.w) : normal;
}
#else
vec4 shown_normal(ivec2 raster, bool of_coat) { return texelFetch(virtual_raster_normal, raster, 0); }
#endif
