// What split injection holds in each slot, in fixed point. Of the light at hand: flux of V_delta and V_rho over pi h^2,
// and the area that it lights over h^2. Of all before: their radiance Phi / (pi A), and the greatest area.
const int DELTA = 0, RHO = 3, AREA = 6;
const int ALL_DELTA = 7, ALL_RHO = 10, ALL_AREA = 13, LIGHT_SUMS = 14;
