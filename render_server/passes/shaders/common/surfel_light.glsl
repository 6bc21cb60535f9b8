// What is known of each surfel's own light, front and back. SURFEL_LIGHTS_ACCESS: as in voxel_store.glsl; KEEPS_SURFEL_LIGHTS
// where it is empty. Vectors of an image in software, which stores them to buffers number by number.
const int RADIANCE_MU = 0;               // L_mu; w: 1 where the camera measured it
const int DIRECT_MU = 1, DIRECT_RHO = 2;       // irradiance of the lights without and with the objects
const int SURFEL_LIGHT_PARTS = 3;              // of each of a surfel's two sides

#ifdef SOFTWARE
layout(rgba32f) SURFEL_LIGHTS_ACCESS uniform imageBuffer SurfelLights;

vec4 surfel_light(uint side, int part) { return imageLoad(SurfelLights, SURFEL_LIGHT_PARTS * int(side) + part); }
#else
layout(std430) SURFEL_LIGHTS_ACCESS buffer SurfelLights { vec4 surfel_lights[]; };

vec4 surfel_light(uint side, int part) { return surfel_lights[SURFEL_LIGHT_PARTS * int(side) + part]; }
#endif

#ifdef KEEPS_SURFEL_LIGHTS
void keep_surfel_light(uint side, int part, vec4 light) {
#ifdef SOFTWARE
    imageStore(SurfelLights, SURFEL_LIGHT_PARTS * int(side) + part, light);
#else
    surfel_lights[SURFEL_LIGHT_PARTS * int(side) + part] = light;
#endif
}
#endif
