// Least and greatest albedo of diffuse surfaces, as scene/albedo.py has them: none reflects more than it receives.
const vec2 ALBEDO_RANGE = vec2(0.02, 0.95);
