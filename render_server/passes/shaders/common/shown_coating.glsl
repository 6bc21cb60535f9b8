// Coat and base of the object that a pixel shows, for passes that trace a lobe of each. Needs brdf.glsl, geometry.glsl and shown_maps.glsl
// with EXTENDED.
#include "common/coating.glsl"
layout(rgba8) readonly uniform image2D virtual_raster_tint;   // an image, because OpenGL guarantees no more than sixteen samplers

Material coated_material(ivec2 raster) {
    return material_at(raster, int(texelFetch(virtual_raster_normal, raster, 0).w), imageLoad(virtual_raster_tint, raster));
}
