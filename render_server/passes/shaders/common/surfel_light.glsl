// Each surfel's own light, front and back.
struct SurfelLight {
    vec4 radiance;      // L_mu; w: 1 where the camera measured it
    vec4 direct_mu;     // irradiance of the lights without the objects,
    vec4 direct_rho;    // and with them
};
layout(std430) buffer SurfelLights { SurfelLight surfel_lights[]; };   // two per surfel
