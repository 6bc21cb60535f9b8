// Workgroups of passes over a picture, 64 pixels each. In software in a row, which lies in memory as one: with squares, single passes
// take twice as long.
#ifdef SOFTWARE
layout(local_size_x = 64, local_size_y = 1) in;
#else
layout(local_size_x = 8, local_size_y = 8) in;
#endif
