// Evenly distributed 0..1 over any few neighbours on the integer grid, such as 3 x 3 (Jimenez 2014).
float interleaved_gradient_noise(vec2 place) { return fract(52.9829189 * fract(dot(place, vec2(0.06711056, 0.00583715)))); }
