// Rows of sources of light, one for each volume: two sources, of light gained and lost, then which fractions arrive in each
// volume. A source: vector flux and flux of each channel, then its place (xyz / w; world, m).
const int SOURCE_TEXELS = 4;
