// Evenly distributed 0..1 over any few neighbours on the integer grid (Jimenez 2014, interleaved gradient noise).
float even_noise(vec2 place) { return fract(52.9829189 * fract(dot(place, vec2(0.06711056, 0.00583715)))); }
