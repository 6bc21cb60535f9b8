// Voxels that hold the objects of the volume at hand (Shading.scene). Needs volume.glsl.
uniform mat4 object_lows;    // a column for each volume: least and greatest corner, voxels
uniform mat4 object_highs;

vec3 object_low() { return object_lows[volume].xyz; }

vec3 object_high() { return object_highs[volume].xyz; }
