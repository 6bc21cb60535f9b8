uniform vec4 camera_pinhole;   // fx, fy, cx, cy of the picture (pixel centres at integers)
