// What is known of each surfel's own light, front and back. SURFEL_LIGHTS_ACCESS: as in voxel_store.glsl.
struct SurfelLight {
    vec4 radiance;      // L_mu; w: 1 where the camera measured it
    vec4 direct_mu;     // irradiance of the lights without the objects,
    vec4 direct_rho;    // and with them
};
layout(std430) SURFEL_LIGHTS_ACCESS buffer SurfelLights { SurfelLight surfel_lights[]; };   // two a surfel
