// Beams that leave the objects, each up to the first object that it meets; where real surfaces end them first is each camera's own
// (caustic_ends.comp.glsl).
struct SentBeam {
    vec4 from;        // world m; w: distance to the object that it meets, m; 1e30 none
    vec4 direction;   // unit length; w: its own standard deviation, relative to the distance
    vec4 flux;        // rgb
    vec4 start_x;     // RayDifferential to the next beams along both axes of the light's view
    vec4 turn_x;
    vec4 start_y;
    vec4 turn_y;
};
#ifdef APPENDS_SENT_BEAMS
layout(std430) buffer SentBeams { uint sent_count; SentBeam sent_beams[]; };
#else
layout(std430) readonly buffer SentBeams { uint sent_count; SentBeam sent_beams[]; };
#endif

// From one ray to its neighbour (Igehy 1999): at a distance t they are start + t turn apart.
struct RayDifferential { vec3 start; vec3 turn; };
